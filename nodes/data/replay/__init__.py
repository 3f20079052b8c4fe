"""Recordings and data sets in the place of a simulator.

`node` finds the right reader and sends the events again; `choice` selects them, `ahead` reads in a
thread. `reader` is what the readers have in common: `recorded` (ours), `rosbag`, `euroc`,
`tum_rgbd` and `kitti`.
"""

from nodes.data.replay.node import Replay
from nodes.data.replay.reader import ReplayConfig

__all__ = ["Replay", "ReplayConfig"]
