"""Data sets in the layouts of EuRoC and TUM RGB-D, recorded while a run goes on.

`node` listens; `euroc` and `tum_rgbd` are the layouts, `recording` what they have in common,
`rig` the choice of sensors, `rows` and `images` the files.
"""

from nodes.dataset.node import DatasetConfig, DatasetWriter

__all__ = ["DatasetConfig", "DatasetWriter"]
