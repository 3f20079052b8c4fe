"""Commands ``python -m runtime bench …``, a benchmark each."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from bench.system import CaseName

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Measure latency and throughput on this machine.",
)

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file, too.")]
Nodes = Annotated[str, typer.Option(help="Numbers of nodes, with commas.")]
SampleCount = Annotated[
    int, typer.Option(min=30, help="Round trips of each measurement; fewer for slow systems.")
]
WarmUp = Annotated[int, typer.Option(min=0, help="Round trips left out before them.")]
Repeats = Annotated[int, typer.Option(min=1, help="Rounds, each in an order of its own.")]
Only = Annotated[
    list[str] | None, typer.Option("--system", help="Only systems with this in their name.")
]
Plots = Annotated[Path | None, typer.Option(help="Folder for box and scaling plots (PNG).")]

ALL_NODES = "2,4,8,10,16,32,50,64,100,128"


@app.command()
def small(
    json: Json = None,
    nodes: Nodes = ALL_NODES,
    samples: SampleCount = 20_000,
    warm_up: WarmUp = 2_000,
    repeats: Repeats = 3,
    only: Only = None,
    plots: Plots = None,
) -> None:
    """Measure the round trip from node 1 to N-1 listeners; the last listener replies."""
    counts = {"samples": samples, "warm_up": warm_up, "repeats": repeats}
    _latency("small", json, nodes, only, plots, **counts)


@app.command()
def large(
    json: Json = None,
    shared: Annotated[
        bool, typer.Option("--shared", help="Pass the array by reference instead of copying it.")
    ] = False,
    nodes: Nodes = "2,16,128",
    samples: SampleCount = 2_000,
    warm_up: WarmUp = 200,
    repeats: Repeats = 3,
    only: Only = None,
    plots: Plots = None,
) -> None:
    """Measure the same with 1080×1080 float32 (4.67 MB) in each ping."""
    case: CaseName = "large-shared" if shared else "large"
    counts = {"samples": samples, "warm_up": warm_up, "repeats": repeats}
    _latency(case, json, nodes, only, plots, **counts)


@app.command()
def stall(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of each run.")] = 6.0,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each mode, interleaved.")] = 3,
    rate: Annotated[float, typer.Option(min=0.1, help="Hertz of the camera.")] = 10.0,
    size: Annotated[int, typer.Option(min=16, help="Width and height of its images.")] = 512,
) -> None:
    """Measure 400 Hz tick lateness: no camera, camera inline, camera beside the loop."""
    from bench.stall import measure

    options: dict[str, Any] = {"seconds": seconds, "repeats": repeats, "rate": rate, "size": size}
    _show(json, stall=lambda say: measure(progress=say, **options))


@app.command()
def throughput(json: Json = None) -> None:
    """Measure events and images a second, through handlers, streams and workers."""
    from bench.throughput import measure

    _show(json, throughput=lambda _: measure())


@app.command()
def idle(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=0.5, help="Length of the run.")] = 10.0,
) -> None:
    """Measure the processor time of a single 100 Hz timer node."""
    from bench.throughput import measure_idle

    _show(json, idle=lambda _: [measure_idle(seconds)])


@app.command()
def lockstep(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Simulated, of each run.")] = 30.0,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each, interleaved.")] = 5,
) -> None:
    """Measure simulated seconds a second beside a bare loop, and where a frame's time goes."""
    from bench.lockstep import measure, measure_parts

    _show(
        json,
        lockstep=lambda say: measure(seconds=seconds, repeats=repeats, progress=say),
        parts=lambda _: measure_parts(seconds=seconds / 3, repeats=repeats),
    )


@app.command()
def frame(
    json: Json = None,
    places: Annotated[int, typer.Option(min=1, help="Views of each world.")] = 5,
    repeats: Annotated[int, typer.Option(min=1, help="Starts of each run.")] = 5,
) -> None:
    """Measure a drawn frame by world and lens, and the time from a start to the first image."""
    from bench.frame import measure, measure_first_image

    _show(
        json,
        frame=lambda say: measure(places=places, progress=say),
        first_image=lambda _: measure_first_image(repeats=repeats),
    )


@app.command()
def bridge(
    json: Json = None,
    samples: Annotated[
        int, typer.Option(min=100, help="Round trips with small events; a quarter with images.")
    ] = 2000,
    repeats: Annotated[int, typer.Option(min=30, help="Images encoded for ROS.")] = 300,
) -> None:
    """Measure events between two processes against raw Zenoh, and ROS image encoding."""
    from bench.bridge import measure, measure_ros_images

    _show(
        json,
        bridge=lambda say: measure(samples, say),
        ros_images=lambda _: measure_ros_images(repeats),
    )


@app.command()
def link(
    json: Json = None,
    samples: Annotated[int, typer.Option(min=30, help="Frames each way, in turns.")] = 1000,
) -> None:
    """Measure a frame to a program outside and back, beside a call of a worker."""
    from bench.outside import measure_link

    _show(json, link=lambda _: measure_link(samples))


@app.command()
def held(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=2.0, help="Simulated, of each flight.")] = 8.0,
    repeats: Annotated[int, typer.Option(min=1, help="Flights of each side, in turns.")] = 5,
) -> None:
    """Measure a lockstep flight with odometry in an outside program, and in a worker."""
    from bench.outside import measure_held

    _show(json, held=lambda say: measure_held(seconds=seconds, repeats=repeats, progress=say))


@app.command()
def recording(
    json: Json = None,
    seconds: Annotated[float, typer.Option(min=3.0, help="Length of each run.")] = 6.0,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each kind, in turns.")] = 5,
    rate: Annotated[float, typer.Option(min=1.0, help="Hertz of the camera.")] = 30.0,
) -> None:
    """Measure the lateness of a 400 Hz tick with and without a recorder."""
    from bench.lateness import measure_recording

    options: dict[str, Any] = {"seconds": seconds, "repeats": repeats, "rate": rate}
    _show(json, recording=lambda say: measure_recording(progress=say, **options))


@app.command()
def flood(
    json: Json = None,
    windows: Annotated[
        int, typer.Option(min=4, help="Of a second each, every other flooded.")
    ] = 30,
    rate: Annotated[float, typer.Option(min=1, help="Messages a second of a flood.")] = 10_000.0,
) -> None:
    """Measure how late a 400 Hz tick is while ROS 2 messages flood in."""
    from bench.flood import measure

    _show(json, flood=lambda say: measure(windows=windows, rate=rate, progress=say))


@app.command()
def airsim(
    json: Json = None,
    rounds: Annotated[int, typer.Option(min=1, help="Windows of a second of each case.")] = 10,
) -> None:
    """Measure how quickly AirSim's server answers, and how late a 400 Hz tick is meanwhile."""
    from bench.airsim import measure

    _show(json, airsim=lambda say: measure(rounds=rounds, progress=say))


@app.command("all")
def everything(
    out: Annotated[Path, typer.Option(help="Folder for results.json and plots.")],
    page: Annotated[
        Path | None, typer.Option(help="The page of results; RESULTS.md in the folder.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer nodes, rounds, samples.")] = False,
) -> None:
    """Run every benchmark, and write the page of results."""
    from bench.page import measure, write

    path = page or out / "RESULTS.md"
    with _status() as say:
        write(measure(quick=quick, progress=say), out, path)
    print(path)


@app.command()
def compare(
    before: Annotated[Path, typer.Argument(help="A result file.")],
    after: Annotated[Path, typer.Argument(help="Another.")],
) -> None:
    """Print the speed changes between two result files beyond the noise of both."""
    from rich.console import Console

    from bench.results import compare as changes_between
    from bench.tables import TABLES

    changes = changes_between(before, after)
    real = [change for change in changes if change.real]
    if real:
        Console().print(TABLES["changes"].terminal(real))
    print(f"{len(real)} of {len(changes)} figures changed beyond the noise")


def _latency(
    case: CaseName,
    json: Path | None,
    nodes: str,
    only: list[str] | None,
    plots: Path | None,
    **counts: int,
) -> None:
    from rich.console import Console

    from bench.driver import measure_all
    from bench.results import write_json
    from bench.tables import latency

    numbers = _numbers(nodes)
    with _status() as say:
        outcome = measure_all(case, nodes=numbers, only=only or (), progress=say, **counts)
    if plots is not None:
        from bench.page import draw

        draw(outcome.rows, plots, numbers)
    table, rows = latency(outcome.rows)
    Console().print(table.terminal(rows))
    for system, reason in outcome.missing.items():
        print(f"not measured: {system}: {reason}")
    if json is not None:
        write_json(json, outcome.rows, missing=outcome.missing, versions=outcome.versions)


def _numbers(nodes: str) -> list[int]:
    from runtime.errors import ConfigError

    try:
        counts = [int(n) for n in nodes.split(",")]
    except ValueError:
        counts = []
    if not counts or min(counts) < 2:
        raise ConfigError(f"--nodes: expected numbers above 1 with commas, found {nodes!r}")
    return counts


@contextlib.contextmanager
def _status() -> Iterator[Callable[..., None]]:
    """Show a status line of the current work, on a terminal only."""
    from rich.console import Console

    with Console(stderr=True).status("…") as status:
        yield lambda what, share=None: status.update(
            what if share is None else f"{share:4.0%}  {what}"
        )


def _show(json: Path | None, **benchmarks: Callable[[Callable[..., None]], list[Any]]) -> None:
    from rich.console import Console

    from bench.results import write_json
    from bench.tables import TABLES

    measured = {}
    with _status() as say:
        for name, measure in benchmarks.items():
            say(name.replace("_", " "))
            measured[name] = measure(say)
    for name, rows in measured.items():
        Console().print(TABLES[name].terminal(rows))
    if json is not None:
        write_json(json, [row for rows in measured.values() for row in rows])
