"""Foxglove: a live view over a WebSocket (the extra `foxglove`).

Read in this order: `settings`, `node` (which events it takes, and where they are passed on),
`publishing` (what becomes of each event), `ros_topics` (ROS's messages, as CDR), `messages`
(Foxglove's own), `server` (the only import of foxglove) and `gate` (which pages may connect).
"""

from nodes.viewers.foxglove.node import FoxgloveServer

__all__ = ["FoxgloveServer"]
