"""Recordings and data sets in the place of a simulator.

`node` says what was said; `choice` is what of it, `ahead` reads in a thread. `reader` is what
formats have in common, `formats` finds the right one of `recorded` (ours), `rosbag`, `euroc` and
`tum_rgbd`.
"""

from nodes.replay.node import Replay
from nodes.replay.settings import ReplayConfig

__all__ = ["Replay", "ReplayConfig"]
