"""Commands ``python -m runtime bench …``: those of the table of benchmarks, and some of its own."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.benchmarks import BENCHMARKS, CHANGES, FEW_NODES, NODES, Benchmark, Progress, latency

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
ALL_NODES, SOME_NODES = (",".join(map(str, numbers)) for numbers in (NODES, FEW_NODES))
Plots = Annotated[Path | None, typer.Option(help="Folder for box and scaling plots (PNG).")]


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
    _latency(json, nodes, plots, case="small", only=only or (), **counts)


@app.command()
def large(
    json: Json = None,
    shared: Annotated[
        bool, typer.Option("--shared", help="Pass the array by reference instead of copying it.")
    ] = False,
    nodes: Nodes = SOME_NODES,
    samples: SampleCount = 2_000,
    warm_up: WarmUp = 200,
    repeats: Repeats = 3,
    only: Only = None,
    plots: Plots = None,
) -> None:
    """Measure the same with 1080×1080 float32 (4.67 MB) in each ping."""
    case = "large-shared" if shared else "large"
    counts = {"samples": samples, "warm_up": warm_up, "repeats": repeats}
    _latency(json, nodes, plots, case=case, only=only or (), **counts)


def _add_command(name: str, benchmarks: Sequence[Benchmark]) -> None:
    """Add the command that runs benchmarks of the table, with the options of all."""

    def command(json: Path | None, **values: float) -> None:
        from rich.console import Console

        from bench.results import write_json

        measured = []
        with _status() as say:
            for benchmark in benchmarks:
                say(benchmark.name.replace("_", " "))
                measured.append(benchmark.run(values, say))
        for benchmark, rows in zip(benchmarks, measured, strict=True):
            Console().print(benchmark.table.terminal(rows))
        if json is not None:
            write_json(json, [row for rows in measured for row in rows])

    # Typer reads a command's options from its signature.
    parameters = {"json": inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=None)}
    annotations: dict[str, Any] = {"json": Json, "return": None}
    for option in (option for benchmark in benchmarks for option in benchmark.options):
        if option.name not in parameters:
            parameters[option.name] = parameters["json"].replace(
                name=option.name, default=option.default
            )
            setting = typer.Option(min=option.least, help=option.help)
            annotations[option.name] = Annotated[type(option.default), setting]
    command.__annotations__ = annotations
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [p.replace(annotation=annotations[p.name]) for p in parameters.values()]
    )
    app.command(name, help=benchmarks[0].help)(command)


for _name in [benchmark.name for benchmark in BENCHMARKS if not benchmark.command]:
    _add_command(_name, [b for b in BENCHMARKS if _name in (b.name, b.command)])


@app.command("all")
def everything(
    out: Annotated[Path, typer.Option(help="Folder for results.json and plots.")],
    page: Annotated[
        Path | None, typer.Option(help="The page of results; RESULTS.md in the folder.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer nodes, rounds, samples.")] = False,
) -> None:
    """Run every benchmark, and write the page of results."""
    from bench.page import write
    from bench.results import measure_everything

    path = page or out / "RESULTS.md"
    with _status() as say:
        write(measure_everything(quick=quick, progress=say), out, path)
    print(path)


@app.command()
def compare(
    before: Annotated[Path, typer.Argument(help="A result file.")],
    after: Annotated[Path, typer.Argument(help="Another.")],
) -> None:
    """Print the speed changes between two result files beyond the noise of both."""
    from rich.console import Console

    from bench.results import compare as changes_between

    changes = changes_between(before, after)
    real = [change for change in changes if change["real"]]
    if real:
        Console().print(CHANGES.terminal(real))
    print(f"{len(real)} of {len(changes)} figures changed beyond the noise")


def _latency(json: Path | None, nodes: str, plots: Path | None, **options: Any) -> None:
    from rich.console import Console

    from bench.driver import measure_all
    from bench.results import write_json

    numbers = _numbers(nodes)
    with _status() as say:
        outcome = measure_all(nodes=numbers, progress=say, **options)
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
def _status() -> Iterator[Progress]:
    """Show a status line of the current work, on a terminal only."""
    from rich.console import Console

    with Console(stderr=True).status("…") as status:
        yield lambda what, share=None: status.update(
            what if share is None else f"{share:4.0%}  {what}"
        )
