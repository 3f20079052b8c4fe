"""Recordings and data sets in the place of a simulator."""

from nodes.data.replay.node import Replay
from nodes.data.replay.reader import ReplayConfig

__all__ = ["Replay", "ReplayConfig"]
