"""Foxglove: a live view over a WebSocket."""

from visnav_foxglove.node import FoxgloveServer

__all__ = ["FoxgloveServer"]
