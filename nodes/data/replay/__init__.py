"""Recordings and data sets in the place of a simulator.

`node` finds the right reader, reads ahead in a thread and sends the events again. `reader` is what
the readers have in common: `recorded` (ours), `rosbag`, and in `folders` `euroc`, `tum_rgbd` and
`kitti`.
"""

from nodes.data.replay.node import Replay
from nodes.data.replay.reader import ReplayConfig

__all__ = ["Replay", "ReplayConfig"]
