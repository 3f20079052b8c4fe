"""Data sets in the layouts of EuRoC, TUM RGB-D and TUM monoVO, recorded while a run goes on.

`node` listens; `euroc` and `tum` are the layouts, `recording` is what they have in common.
"""

from nodes.data.dataset.node import DatasetConfig, DatasetWriter

__all__ = ["DatasetConfig", "DatasetWriter"]
