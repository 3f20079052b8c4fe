"""Is B better than A? Two versions compared over equal flights.

Read in this order: `statistics` (pairs, the test, the interval and the verdict), `flying` (which
flights, when they are enough, and the page). The command is `runtime.tools.cli.sweep`.
"""

from runtime.tools.comparison.flying import Compared, compare, read_folder
from runtime.tools.comparison.statistics import (
    ERROR,
    USUAL,
    Comparison,
    Key,
    compare_rows,
    compare_values,
)

__all__ = [
    "ERROR", "USUAL", "Compared", "Comparison", "Key", "compare", "compare_rows", "compare_values",
    "read_folder",
]  # fmt: skip
