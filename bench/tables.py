"""Benchmarks' figures as tables: each is described once, and shown in the terminal and the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rich.table import Table as TerminalTable

    from bench.driver import Row


class Column(NamedTuple):
    """Column of a table: an attribute or key of its rows, under a heading.

    Attributes:
        spec: As of `format`; ``us``: a time with three significant figures; with ``?`` before it,
            nothing stands where the figure is 0.
    """

    heading: str
    key: str
    spec: str = ""

    def cell(self, row: Any) -> str:
        """Return the text for a row; empty if the row lacks the figure."""
        value = row.get(self.key) if isinstance(row, dict) else getattr(row, self.key)
        if value is None or (self.spec.startswith("?") and not value):
            return ""
        spec = self.spec.removeprefix("?")
        return number(value) if spec == "us" else format(value, spec)


class Table(NamedTuple):
    """Layout of a table.

    Attributes:
        title: What is measured, as a sentence without its end.
        texts: Leading columns of words; the others hold numbers.
    """

    title: str
    columns: Sequence[Column]
    texts: int = 1

    def terminal(self, rows: Sequence[Any]) -> TerminalTable:
        """Return the table for a terminal."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Table as TerminalTable

        headings = [column.heading for column in self.columns]
        table = TerminalTable(
            *headings, title=self.title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
        )
        for column in table.columns[self.texts :]:
            column.justify = "right"
        for row in rows:
            table.add_row(*(column.cell(row) for column in self.columns))
        return table

    def markdown(self, rows: Sequence[Any]) -> Iterator[str]:
        """Yield the table's lines in Markdown, and an empty line."""
        yield f"| {' | '.join(column.heading for column in self.columns)} |"
        yield f"|{'---|' * self.texts}{'--:|' * (len(self.columns) - self.texts)}"
        for row in rows:
            yield f"| {' | '.join(column.cell(row) for column in self.columns)} |"
        yield ""


def _table(title: str, columns: str, texts: int = 1) -> Table:
    """Return a table; its columns are a line as ``heading: key spec | heading: key``."""
    found = []
    for column in columns.split(" | "):
        heading, _, figure = column.partition(": ")
        key, _, spec = figure.partition(" ")
        found.append(Column(heading, key, spec))
    return Table(title, found, texts)


_LATE = (
    "p50 µs: late_p50_us .0f | p99 µs: late_p99_us .0f | max µs: late_max_us .0f | "
    "ratio of p99: ratio_p99 .2f"
)
_TICK = " | ".join(f"tick {column}" for column in _LATE.split(" | "))

TABLES = {
    "stall": _table(
        "Lateness of a 400 Hz tick while a 512×512 RGB-D camera runs at 10 Hz; ms between ticks",
        f"camera: mode | {_LATE} | mean ms: update_mean_ms .2f | median: update_median_ms .2f | "
        "sd: update_sd_ms .2f | missed: missed | frames: frames | "
        "fetch ms: fetch_ms_median ?.1f",
    ),
    "throughput": _table(
        "Throughput",
        "what: case | at once: batch | µs each: per_event_us us | "
        "a second: events_per_second ,.0f | MB a second: megabytes_per_second ?,.0f",
    ),
    "idle": _table(
        "One timer node",
        "Hz: hz g | seconds: seconds .1f | ticks: ticks | % of a core: cpu_percent .2f",
        texts=0,
    ),
    "lockstep": _table(
        "Simulated time",
        "case: case | simulated seconds a second: speed .1f | "
        "the runtime's own share of the time: share .0%",
    ),
    "frame": _table(
        "A drawn frame on one core: 512×512 colour, depth and object numbers, by the project's "
        "rasteriser and by MuJoCo's renderer (OpenGL in software)",
        "world: world | camera: camera | ms: raster_ms .1f | MuJoCo's: mujoco_ms ?.1f | "
        "ratio: ratio ?.1f",
        texts=2,
    ),
    "first_image": _table(
        "From the start of the command `run` to the first image",
        "world: world | seconds: seconds .2f",
    ),
    "parts": _table(
        "Processor time of a frame (all processes; RGB-D with noise, odometry, evaluation)",
        "part: part | ms: ms .1f | share: share .0%",
    ),
    "bridge": _table(
        "A run in two processes on one machine, beside bare Zenoh sessions in the same two",
        "event: case | bytes: bytes , | round trip µs: ours_us us | Zenoh's: zenoh_us us | "
        "ratio: ratio .2f | a second: ours_per_second ,.0f | "
        "Zenoh's: zenoh_per_second ,.0f | p99 µs: ours_p99_us us | Zenoh's: zenoh_p99_us us",
    ),
    "link": _table(
        "An RGB-D frame to a program and its answer back, through the native interface and by "
        "a worker's call",
        "frame: case | bytes: bytes , | µs: link_us us | worker's: worker_us us | ratio: ratio .2f",
    ),
    "held": _table(
        "A flight in lockstep with 512×512 RGB-D at 30 Hz, with an odometry in a program "
        "outside and in a worker: simulated seconds a second",
        "way: case | flights each: rounds | outside: outside_speed .2f | "
        "worker: worker_speed .2f | ratio: ratio .2f | equal estimates: equal",
    ),
    "ros_images": _table(
        "An image as a message of ROS 2, by the bridge and by rosbags' `serialize_cdr`",
        "image: case | bytes: bytes , | µs: ours_us us | rosbags': rosbags_us us | "
        "ratio: ratio .2f | p99 µs: ours_p99_us us | rosbags': rosbags_p99_us us",
    ),
    "recording": _table(
        "Lateness of a 400 Hz tick while a run with 512×512 RGB-D at 30 Hz is recorded",
        f"run: case | {_LATE} | frames: frames | MB: megabytes .0f | dropped: dropped",
    ),
    "flood": _table(
        "Lateness of a 400 Hz tick while messages of ROS 2 come from another process",
        f"window: case | messages a second: messages_per_second ,.0f | {_LATE} | "
        "of p50: ratio_p50 .2f",
    ),
    "airsim": _table(
        "A client of AirSim's that asks again as soon as it has its answer, and a 400 Hz tick "
        "meanwhile; AirSim itself is reported to give 3 to 20 images a second (not measured "
        "here)",
        "what it asks for: case | a second: per_second ,.0f | round trip µs: median_us us | "
        f"p99 µs: p99_us us | {_TICK}",
    ),
    "changes": _table(
        "Changes",
        "what: what | before µs: before_us us | after µs: after_us us | ratio: ratio .2f | "
        "noise: noise .2f",
    ),
}
"""Tables by benchmark, named as the fields of `bench.page.Results`."""


def latency(rows: Sequence[Row]) -> tuple[Table, list[dict[str, Any]]]:
    """Return the table of medians by system and number of nodes, and its rows, quickest first."""
    by_system: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        known = by_system.setdefault(
            (row.system, row.mode), {"system": row.system, "mode": row.mode, "least": row.median_us}
        )
        known[str(row.nodes)] = row.median_us
        known["least"] = min(known["least"], row.median_us)
    nodes = [Column(str(n), str(n), "us") for n in sorted({row.nodes for row in rows})]
    case = rows[0].case if rows else "nothing"
    columns = [Column("system", "system"), Column("mode", "mode"), *nodes]
    table = Table(f"{case}: median round trip (µs) by number of nodes", columns, texts=2)
    return table, sorted(by_system.values(), key=lambda system: system["least"])


def number(value: float) -> str:
    """Return a time with three significant figures."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
