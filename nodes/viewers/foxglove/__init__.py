"""Foxglove: a live view over a WebSocket (the extra `foxglove`)."""

from nodes.viewers.foxglove.node import FoxgloveServer

__all__ = ["FoxgloveServer"]
