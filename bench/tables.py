"""Benchmarks' figures as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table

if TYPE_CHECKING:
    from bench.stall import StallRow


def stall_table(rows: Sequence[StallRow]) -> Table:
    """Return the table of lateness by mode, with ratios to the first row."""
    table = Table(
        *("camera", "p50", "p99", "max", "ratio", "missed", "mean", "median", "sd"),
        *("frames", "fetch"),
        title="lateness of a 400 Hz tick (µs; ratio of p99), time between ticks (ms), fetch (ms)",
        title_justify="left",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(
            row.mode,
            f"{row.late_p50_us:.0f}",
            f"{row.late_p99_us:.0f}",
            f"{row.late_max_us:.0f}",
            f"{row.late_p99_us / rows[0].late_p99_us:.2f}",
            f"{row.missed}",
            f"{row.update_mean_ms:.2f}",
            f"{row.update_median_ms:.2f}",
            f"{row.update_sd_ms:.2f}",
            f"{row.frames}",
            f"{row.fetch_ms_median:.1f}" if row.frames else "",
        )
    return table
