"""Is B better than A? Two versions compared over equal flights.

Read in this order: `statistics` (pairs, the test, the interval and the verdict), `flying` (which
flights, when they are enough, and the page). The command is `runtime.tools.cli.sweep`.
"""

from runtime.tools.comparison.flying import (
    COMPARISONS,
    Compared,
    compare,
    draw_slopes,
    read_folder,
    read_slopes,
)
from runtime.tools.comparison.statistics import (
    ERROR,
    USUAL,
    Comparison,
    Key,
    compare_rows,
    compare_values,
)

__all__ = [
    "COMPARISONS", "ERROR", "USUAL", "Compared", "Comparison", "Key", "compare", "compare_rows",
    "compare_values", "draw_slopes", "read_folder", "read_slopes",
]  # fmt: skip
