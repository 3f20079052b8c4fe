"""Benchmarks' figures as tables for the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.table import Table

if TYPE_CHECKING:
    from bench.bridge import BridgeRow
    from bench.compare import Change
    from bench.driver import Row
    from bench.flood import FloodRow
    from bench.idle import IdleRow
    from bench.lockstep import LockstepRow
    from bench.parts import PartRow
    from bench.recording import RecordingRow
    from bench.ros_images import RosImageRow
    from bench.stall import StallRow
    from bench.throughput import ThroughputRow


def _table(title: str, *columns: str, texts: int = 1) -> Table:
    """Return a table whose columns after the first `texts` hold numbers."""
    table = Table(
        *columns, title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for column in table.columns[texts:]:
        column.justify = "right"
    return table


def latency_table(rows: Sequence[Row]) -> Table:
    """Return medians by system and number of nodes, the quickest first."""
    nodes = sorted({row.nodes for row in rows})
    case = rows[0].case if rows else "nothing"
    table = _table(
        f"{case}: median round trip (µs) by number of nodes",
        *("system", "mode", *map(str, nodes)),
        texts=2,
    )
    by_system: dict[tuple[str, str], dict[int, float]] = {}
    for row in rows:
        by_system.setdefault((row.system, row.mode), {})[row.nodes] = row.median_us
    for (system, mode), medians in sorted(by_system.items(), key=lambda s: min(s[1].values())):
        table.add_row(system, mode, *(number(medians.get(n)) for n in nodes))
    return table


def missing_lines(missing: Mapping[str, str]) -> Iterator[str]:
    """Return a line for each system that was not measured."""
    for system, reason in missing.items():
        yield f"not measured: {system}: {reason}"


def stall_table(rows: Sequence[StallRow]) -> Table:
    """Return lateness by mode, with ratios to the first row."""
    table = _table(
        "lateness of a 400 Hz tick (µs; ratio of p99), time between ticks (ms), fetch (ms)",
        *("camera", "p50", "p99", "max", "ratio", "missed", "mean", "median", "sd"),
        *("frames", "fetch"),
    )
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


def throughput_table(rows: Sequence[ThroughputRow]) -> Table:
    """Return what gets through."""
    table = _table("throughput", "what", "at once", "µs each", "per second", "MB per second")
    for row in rows:
        table.add_row(
            row.case,
            f"{row.batch}",
            number(row.per_event_us),
            f"{row.events_per_second:,.0f}",
            f"{row.bytes_per_second / 1e6:,.0f}" if row.bytes_per_second else "",
        )
    return table


def idle_table(row: IdleRow) -> Table:
    """Return what idling costs."""
    table = _table("one timer node", "Hz", "seconds", "ticks", "% of a core", texts=0)
    table.add_row(f"{row.hz:g}", f"{row.seconds:.1f}", f"{row.ticks}", f"{row.cpu_percent:.2f}")
    return table


def lockstep_table(rows: Sequence[LockstepRow]) -> Table:
    """Return the speeds of simulated time."""
    table = _table("lockstep", "case", "simulated s per s", "runtime's share")
    for row in rows:
        share = "" if row.share is None else f"{row.share:.0%}"
        table.add_row(row.case, f"{row.speed:.1f}", share)
    return table


def parts_table(rows: Sequence[PartRow]) -> Table:
    """Return where the processor time of a frame goes."""
    table = _table("processor time of a frame, by part", "part", "ms", "share")
    for row in rows:
        table.add_row(row.part, f"{row.ms:.1f}", f"{row.share:.0%}")
    return table


def bridge_table(rows: Sequence[BridgeRow]) -> Table:
    """Return what a run in two processes adds to Zenoh."""
    table = _table(
        "between two processes: median round trip (µs), events a second",
        *("event", "bytes", "ours", "zenoh", "ratio", "p99", "zenoh's", "per second", "zenoh's"),
    )
    for row in rows:
        table.add_row(
            row.case,
            f"{row.bytes:,}",
            number(row.ours_us),
            number(row.zenoh_us),
            f"{row.ratio:.2f}",
            number(row.ours_p99_us),
            number(row.zenoh_p99_us),
            f"{row.ours_per_second:,.0f}",
            f"{row.zenoh_per_second:,.0f}",
        )
    return table


def ros_images_table(rows: Sequence[RosImageRow]) -> Table:
    """Return what encoding images for ROS costs."""
    table = _table(
        "encoding for ROS 2 (µs)", "image", "bytes", "ours", "rosbags", "ratio", "p99", "rosbags'"
    )
    for row in rows:
        table.add_row(
            row.case,
            f"{row.bytes:,}",
            number(row.ours_us),
            number(row.rosbags_us),
            f"{row.ratio:.2f}",
            number(row.ours_p99_us),
            number(row.rosbags_p99_us),
        )
    return table


def flood_table(rows: Sequence[FloodRow]) -> Table:
    """Return lateness with and without a flood."""
    table = _table(
        "lateness of a 400 Hz tick (µs), and its ratio to the quiet second before",
        *("window", "messages per second", "p50", "p99", "max", "ratio of p50", "of p99"),
    )
    for row in rows:
        table.add_row(
            row.case,
            f"{row.messages_per_second:,.0f}",
            f"{row.late_p50_us:.0f}",
            f"{row.late_p99_us:.0f}",
            f"{row.late_max_us:.0f}",
            f"{row.ratio_p50:.2f}",
            f"{row.ratio_p99:.2f}",
        )
    return table


def recording_table(rows: Sequence[RecordingRow]) -> Table:
    """Return lateness with and without a recorder."""
    table = _table(
        "lateness of a 400 Hz tick (µs), and the pairs' ratio of p99",
        *("run", "p50", "p99", "max", "ratio", "frames", "MB", "dropped"),
    )
    for row in rows:
        table.add_row(
            row.case,
            f"{row.late_p50_us:.0f}",
            f"{row.late_p99_us:.0f}",
            f"{row.late_max_us:.0f}",
            f"{row.ratio_p99:.2f}",
            f"{row.frames}",
            f"{row.megabytes:.0f}",
            f"{row.dropped}",
        )
    return table


def changes_table(changes: Sequence[Change]) -> Table:
    """Return what changed."""
    table = _table("changes", "what", "before µs", "after µs", "ratio", "noise")
    for change in changes:
        table.add_row(
            change.what,
            number(change.before_us),
            number(change.after_us),
            f"{change.ratio:.2f}",
            f"{change.noise:.2f}",
        )
    return table


def number(value: float | None) -> str:
    """Return a time with three significant figures."""
    if value is None:
        return ""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
