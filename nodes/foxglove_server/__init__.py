"""Foxglove: a live view over a WebSocket (the extra `foxglove`).

Read in this order: `settings` (what the file says), `node` (what is heard, and where it is passed
on), `publishing` (topics, and what becomes of each event), `scene` (paths and vehicles to draw),
`server` (the only import of foxglove).
"""

from nodes.foxglove_server.node import FoxgloveServer

__all__ = ["FoxgloveServer"]
