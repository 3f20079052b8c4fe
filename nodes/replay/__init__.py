"""Recordings and data sets in the place of a simulator.

`node` sends the events again; `choice` selects them, `ahead` reads in a thread. `reader` is what
formats have in common, `formats` finds the right one of `recorded` (ours), `rosbag`, `euroc` and
`tum_rgbd`.
"""

from nodes.replay.node import Replay
from nodes.replay.settings import ReplayConfig

__all__ = ["Replay", "ReplayConfig"]
