"""Data sets in the layouts of EuRoC, TUM RGB-D and TUM monoVO, recorded while a run goes on."""

from nodes.data.dataset.node import DatasetConfig, DatasetWriter

__all__ = ["DatasetConfig", "DatasetWriter"]
