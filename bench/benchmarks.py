"""Table of all benchmarks: commands, options, columns of figures, sections of the page of results.

Command line, terminal tables, ``results.json`` and page read it. A benchmark's row of figures is a
dict, as it stands in JSON; it may hold more figures than its table shows.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rich.table import Table as TerminalTable

    from bench.system import CaseName

Row = dict[str, Any]
Progress = Callable[..., None]  # takes the current work and, if known, the share that is done


class Column(NamedTuple):
    """Column of a table: a figure of its rows, under a heading.

    Attributes:
        spec: As of `format`; ``us``: a time with three significant figures; ``MB``: bytes, shown
            as megabytes; with ``?`` before it, nothing stands where the figure is 0.
    """

    heading: str
    key: str
    spec: str = ""

    def cell(self, row: Row) -> str:
        """Return the text for a row; empty if the row lacks the figure."""
        value = row.get(self.key)
        if value is None or (self.spec.startswith("?") and not value):
            return ""
        spec = self.spec.removeprefix("?")
        if spec == "us":
            return f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f}"
        return f"{value / 1e6:,.0f}" if spec == "MB" else format(value, spec)


class Table(NamedTuple):
    """Layout of a table.

    Attributes:
        title: What is measured, as a sentence without its end.
        texts: Leading columns of words; the others hold numbers.
    """

    title: str
    columns: Sequence[Column]
    texts: int = 1

    def terminal(self, rows: Sequence[Row]) -> TerminalTable:
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

    def markdown(self, rows: Sequence[Row]) -> Iterator[str]:
        """Yield the table's lines in Markdown, and an empty line."""
        yield f"| {' | '.join(column.heading for column in self.columns)} |"
        yield f"|{'---|' * self.texts}{'--:|' * (len(self.columns) - self.texts)}"
        for row in rows:
            yield f"| {' | '.join(column.cell(row) for column in self.columns)} |"
        yield ""


class Option(NamedTuple):
    """Option of a command; its type is that of its default.

    Attributes:
        help: Empty where another benchmark of the same command has it.
        least: Smallest value.
        whole: Value in a run of all benchmarks, if that is not the default.
        quick: The same of a quick run.
    """

    name: str
    default: float
    help: str
    least: float = 1
    whole: float | None = None
    quick: float | None = None

    def in_all(self, *, quick: bool) -> float:
        """Return the value in a run of all benchmarks."""
        value = self.quick if quick else self.whole
        return self.default if value is None else value


class Benchmark(NamedTuple):
    """Benchmark with one table of figures.

    Attributes:
        name: Field of its rows in ``results.json``.
        measure: Function that returns the rows, as ``module:function``; it takes the options by
            their names, and `progress`.
        columns: As for `columns_of`; `title` and `texts` are as of `Table`.
        section: Heading on the page under which it stands; empty: it has no table there.
        help: Of the command of the same name.
        command: Another command that runs it, whose options include those of this.
        single: Whether ``results.json`` has its only row instead of a list.
    """

    name: str
    measure: str
    title: str
    columns: str
    section: str = ""
    help: str = ""
    options: Sequence[Option] = ()
    command: str = ""
    texts: int = 1
    single: bool = False

    @property
    def table(self) -> Table:
        """Layout of the table."""
        return Table(self.title, columns_of(self.columns), self.texts)

    def run(self, options: Mapping[str, Any], progress: Progress) -> list[Row]:
        """Measure; options that are others' are left out."""
        module, _, function = self.measure.partition(":")
        measure = getattr(importlib.import_module(f"bench.{module}"), function)
        own = {option.name: options[option.name] for option in self.options}
        rows: list[Row] = measure(progress=progress, **own)
        return rows


def columns_of(text: str) -> list[Column]:
    """Return the columns of a line as ``heading: key spec | heading: key``."""
    columns = []
    for column in text.split(" | "):
        heading, _, figure = column.partition(": ")
        key, _, spec = figure.partition(" ")
        columns.append(Column(heading, key, spec))
    return columns


class RoundTrip(NamedTuple):
    """Case of a round trip between nodes, which all systems are measured with.

    Attributes:
        title: Heading of the page's section.
        nodes: Numbers of nodes in a run of all benchmarks; `quick_nodes` in a quick one.
        repeats: Rounds in a run of all benchmarks, unless it is quick.
    """

    name: CaseName
    title: str
    nodes: Sequence[int]
    quick_nodes: Sequence[int]
    samples: int = 1_000
    warm_up: int = 100
    repeats: int = 2


NODES = (2, 4, 8, 10, 16, 32, 50, 64, 100, 128)
FEW_NODES = (2, 16, 128)

ROUND_TRIPS = (
    RoundTrip("small", "Small message", NODES, FEW_NODES, 20_000, 2_000, 3),
    RoundTrip("large", "Large message (4.67 MB), copied", FEW_NODES, (2,)),
    RoundTrip("large-shared", "Large message, by reference or shared memory", FEW_NODES, (2,)),
)

CHANGES = Table(
    "Changes",
    columns_of(
        "what: what | before µs: before_us us | after µs: after_us us | ratio: ratio .2f | "
        "noise: noise .2f"
    ),
)

_LATE = (
    "p50 µs: late_p50_us .0f | p99 µs: late_p99_us .0f | max µs: late_max_us .0f | "
    "ratio of p99: ratio_p99 .2f"
)
_TICK = " | ".join(f"tick {column}" for column in _LATE.split(" | "))

_TIME, _IMAGES, _RAYS = "Simulated time", "Images", "Rays"
_BESIDE = "Between processes, and beside the loop"

SECTIONS = {
    "Stalls": "",
    _TIME: "1 kHz physics, 400 Hz control, 200 Hz IMU; a camera of 512×512 RGB-D at 30 Hz.",
    _IMAGES: (
        "Both renderers in turns, from the same places of each world's tour, in a flight that "
        "turns."
    ),
    _RAYS: "",
    "Throughput": "",
    _BESIDE: "Each of these tables is a run of its own, whose sides were measured in turns.",
}
"""Sections of the page before those of the cases: heading, and the text before its tables."""

BENCHMARKS = (
    Benchmark(
        "stall",
        "stall:measure",
        "Lateness of a 400 Hz tick while a 512×512 RGB-D camera runs at 10 Hz; ms between ticks",
        f"camera: mode | {_LATE} | mean ms: update_mean_ms .2f | "
        "median: update_median_ms .2f | sd: update_sd_ms .2f | missed: missed | "
        "frames: frames | fetch ms: fetch_ms_median ?.1f",
        "Stalls",
        "Measure 400 Hz tick lateness: no camera, camera inline, camera beside the loop.",
        (
            Option("seconds", 6.0, "Length of each run.", 0.5, quick=2.0),
            Option("repeats", 3, "Runs of each mode, interleaved.", whole=5, quick=2),
            Option("rate", 10.0, "Hertz of the camera.", 0.1),
            Option("size", 512, "Width and height of its images.", 16),
        ),
    ),
    Benchmark(
        "throughput",
        "throughput:measure",
        "Throughput",
        "what: case | at once: batch | µs each: per_event_us us | "
        "a second: events_per_second ,.0f | MB a second: bytes_per_second ?MB",
        "Throughput",
        "Measure events and images a second, through handlers, streams and workers.",
    ),
    Benchmark(
        "idle",
        "throughput:measure_idle",
        "One timer node",
        "Hz: hz g | seconds: seconds .1f | ticks: ticks | % of a core: cpu_percent .2f",
        help="Measure the processor time of a single 100 Hz timer node.",
        options=(Option("seconds", 10.0, "Length of the run.", 0.5, quick=3.0),),
        single=True,
        texts=0,
    ),
    Benchmark(
        "lockstep",
        "lockstep:measure",
        "Simulated time",
        "case: case | simulated seconds a second: speed .1f | "
        "the runtime's own share of the time: share .0%",
        _TIME,
        "Measure simulated seconds a second beside a bare loop, and where a frame's time goes.",
        (
            Option("seconds", 30.0, "Simulated, of each run.", 1.0),
            Option("repeats", 5, "Runs of each, interleaved.", quick=2),
        ),
    ),
    Benchmark(
        "parts",
        "lockstep:measure_parts",
        "Processor time of a frame (all processes; RGB-D with noise, odometry, evaluation)",
        "part: part | ms: ms .1f | share: share .0%",
        _TIME,
        options=(Option("seconds", 30.0, ""), Option("repeats", 5, "", quick=1)),
        command="lockstep",
    ),
    Benchmark(
        "frame",
        "frame:measure",
        "A drawn frame on one core: 512×512 colour, depth and object numbers, by the project's "
        "rasteriser and by MuJoCo's renderer (OpenGL in software)",
        "world: world | camera: camera | ms: raster_ms .1f | MuJoCo's: mujoco_ms ?.1f | "
        "ratio: ratio ?.1f",
        _IMAGES,
        "Measure a drawn frame by world and lens, and the time from a start to the first image.",
        (Option("places", 5, "Views of each world.", quick=1),),
        texts=2,
    ),
    Benchmark(
        "first_image",
        "frame:measure_first_image",
        "From the start of the command `run` to the first image",
        "world: world | seconds: seconds .2f",
        _IMAGES,
        options=(Option("repeats", 5, "Starts of each run.", quick=1),),
        command="frame",
    ),
    Benchmark(
        "rays",
        "rays:measure",
        "A lidar's turn of 16 × 1024 rays in a room of triangles, on one core: the project's "
        "trees, MuJoCo and Embree (float32; not the same bits everywhere)",
        "triangles: triangles ,d | µs a ray: ours_us us | MuJoCo's: mujoco_us us | "
        "Embree's: embree_us us | ratio to Embree's: ratio .2f | seconds of the build: "
        "seconds .2f | Embree's: embree_seconds .2f",
        _RAYS,
        "Measure rays that meet meshes, beside MuJoCo and Embree (embreex).",
        (Option("rounds", 9, "Turns from each of three places.", quick=2),),
        texts=0,
    ),
    Benchmark(
        "memory",
        "memory:measure",
        "A flight in a scan of a million triangles with four images of 4096² texels: memory of all "
        "processes together (Pss: shared pages count once), two of which draw",
        "start: start | triangles: triangles ,d | MB in flight: flight MB | "
        "of the run's process: main MB | most MB: peak MB | "
        "seconds to the first image: seconds .1f",
        _IMAGES,
        "Measure the memory of all processes of a run in a large scan.",
        (Option("seconds", 3.0, "Simulated, of each flight.", 1.0, quick=1.0),),
    ),
    Benchmark(
        "bridge",
        "bridge:measure",
        "A run in two processes on one machine, beside bare Zenoh sessions in the same two",
        "event: case | bytes: bytes , | round trip µs: ours_us us | Zenoh's: zenoh_us us | "
        "ratio: ratio .2f | a second: ours_per_second ,.0f | "
        "Zenoh's: zenoh_per_second ,.0f | p99 µs: ours_p99_us us | Zenoh's: zenoh_p99_us us",
        _BESIDE,
        "Measure events between two processes against raw Zenoh, and ROS image encoding.",
        (
            Option(
                "samples",
                2000,
                "Round trips with small events; a quarter with images.",
                100,
                quick=200,
            ),
        ),
    ),
    Benchmark(
        "link",
        "outside:measure_link",
        "An RGB-D frame to a program and its answer back, through the native interface and by "
        "a worker's call",
        "frame: case | bytes: bytes , | µs: link_us us | worker's: worker_us us | ratio: ratio .2f",
        _BESIDE,
        "Measure a frame to a program outside and back, beside a call of a worker.",
        (Option("samples", 1000, "Frames each way, in turns.", 30, quick=100),),
    ),
    Benchmark(
        "held",
        "outside:measure_held",
        "A flight in lockstep with 512×512 RGB-D at 30 Hz, with an odometry in a program "
        "outside and in a worker: simulated seconds a second",
        "way: case | flights each: rounds | outside: outside_speed .2f | "
        "worker: worker_speed .2f | ratio: ratio .2f | equal estimates: equal",
        _BESIDE,
        "Measure a lockstep flight with odometry in an outside program, and in a worker.",
        (
            Option("seconds", 8.0, "Simulated, of each flight.", 2.0, quick=2.0),
            Option("repeats", 5, "Flights of each side, in turns.", quick=1),
        ),
    ),
    Benchmark(
        "ros_images",
        "bridge:measure_ros_images",
        "An image as a message of ROS 2, by the bridge and by rosbags' `serialize_cdr`",
        "image: case | bytes: bytes , | µs: ours_us us | rosbags': rosbags_us us | "
        "ratio: ratio .2f | p99 µs: ours_p99_us us | rosbags': rosbags_p99_us us",
        _BESIDE,
        options=(Option("repeats", 300, "Images encoded for ROS.", 30, quick=50),),
        command="bridge",
    ),
    Benchmark(
        "recording",
        "lateness:measure_recording",
        "Lateness of a 400 Hz tick while a run with 512×512 RGB-D at 30 Hz is recorded",
        f"run: case | {_LATE} | frames: frames | MB: megabytes .0f | dropped: dropped",
        _BESIDE,
        "Measure the lateness of a 400 Hz tick with and without a recorder.",
        (
            Option("seconds", 6.0, "Length of each run.", 3.0, whole=5.0, quick=3.0),
            Option("repeats", 5, "Runs of each kind, in turns.", whole=9, quick=1),
            Option("rate", 30.0, "Hertz of the camera.", 1.0),
        ),
    ),
    Benchmark(
        "flood",
        "flood:measure",
        "Lateness of a 400 Hz tick while messages of ROS 2 come from another process",
        f"window: case | messages a second: messages_per_second ,.0f | {_LATE} | "
        "of p50: ratio_p50 .2f",
        _BESIDE,
        "Measure how late a 400 Hz tick is while ROS 2 messages flood in.",
        (
            Option("windows", 30, "Of a second each, every other flooded.", 4, quick=4),
            Option("rate", 10_000.0, "Messages a second of a flood."),
        ),
    ),
    Benchmark(
        "airsim",
        "airsim:measure",
        "A client of AirSim's that asks again as soon as it has its answer, and a 400 Hz tick "
        "meanwhile; AirSim itself is reported to give 3 to 20 images a second (not measured "
        "here)",
        "what it asks for: case | a second: per_second ,.0f | round trip µs: median_us us | "
        f"p99 µs: p99_us us | {_TICK}",
        _BESIDE,
        "Measure how quickly AirSim's server answers, and how late a 400 Hz tick is meanwhile.",
        (Option("rounds", 10, "Windows of a second of each case.", quick=1),),
    ),
)
"""Benchmarks in the order of their commands and of their fields in ``results.json``."""


def latency(rows: Sequence[Row]) -> tuple[Table, list[Row]]:
    """Return the table of medians by system and number of nodes, and its rows, quickest first."""
    by_system: dict[tuple[str, str], Row] = {}
    for row in rows:
        names = {"system": row["system"], "mode": row["mode"], "least": row["median_us"]}
        known = by_system.setdefault((row["system"], row["mode"]), names)
        known[str(row["nodes"])] = row["median_us"]
        known["least"] = min(known["least"], row["median_us"])
    nodes = [Column(str(n), str(n), "us") for n in sorted({row["nodes"] for row in rows})]
    case = rows[0]["case"] if rows else "nothing"
    columns = [Column("system", "system"), Column("mode", "mode"), *nodes]
    table = Table(f"{case}: median round trip (µs) by number of nodes", columns, texts=2)
    return table, sorted(by_system.values(), key=lambda system: system["least"])
