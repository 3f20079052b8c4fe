"""Foxglove: a live view over a WebSocket (the extra `foxglove`).

Read in this order: `node` (which events it takes, and where they are passed on), `publishing` (what
becomes of each event), `messages` (Foxglove's own, and ROS's as CDR), `server` (settings, the only
import of foxglove, and which pages may connect).
"""

from nodes.viewers.foxglove.node import FoxgloveServer

__all__ = ["FoxgloveServer"]
