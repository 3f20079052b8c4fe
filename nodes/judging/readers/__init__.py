"""Readers of trajectories that other programs wrote: files, topics of bags, folders.

One table (`nodes.judging.readers.table`), a row for each container or layout, read from the entry
points ``visnav.readers``. A row's `read` gives a `Source`: poses as they stand, and the axes that
the source declares, if it does (`nodes.judging.readers.axes`).
"""

from nodes.judging.readers.axes import AXES, Axes, AxesName
from nodes.judging.readers.conversion import to_common_axes
from nodes.judging.readers.source import Collected, Options, Reader, Source, Start
from nodes.judging.readers.table import complaints, of_body, read, read_truth, readers

__all__ = [
    "AXES",
    "Axes",
    "AxesName",
    "Collected",
    "Options",
    "Reader",
    "Source",
    "Start",
    "complaints",
    "of_body",
    "read",
    "read_truth",
    "readers",
    "to_common_axes",
]
