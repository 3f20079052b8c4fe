"""Data sets in the layouts of EuRoC, TUM RGB-D and TUM monoVO, recorded while a run goes on.

`node` listens; `euroc`, `tum_rgbd` and `tum_mono` are the layouts, `recording` what they have in
common, files of rows and of images included, and `rig` is the choice of sensors.
"""

from nodes.data.dataset.node import DatasetConfig, DatasetWriter

__all__ = ["DatasetConfig", "DatasetWriter"]
