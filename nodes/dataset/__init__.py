"""Data sets in the layouts of EuRoC, TUM RGB-D and TUM monoVO, recorded while a run goes on.

`node` listens; `euroc`, `tum_rgbd` and `tum_mono` are the layouts, `recording` what they have in
common, `rig` the choice of sensors, `rows` and `images` the files.
"""

from nodes.dataset.node import DatasetConfig, DatasetWriter

__all__ = ["DatasetConfig", "DatasetWriter"]
