"""Command ``run``, and the commands for a live run or its trace: top, web, set and trace."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from runtime.tools.cli.commands import (
    Json,
    JUnit,
    Overrides,
    Quiet,
    of_verdict,
    warn,
    writing,
)

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from runtime.config.model import Config
    from runtime.run.execute import Watch
    from runtime.run.supervisor import Supervisor
    from runtime.tools.monitor.observer import LastRecords
    from runtime.tools.tracing.write import Trace


_LAST_WAIT = 1.0  # real seconds for all threads together to end by themselves


class Log(Enum):
    """Values of ``--log``: a level, or ``events``."""

    trace = "trace"
    debug = "debug"
    info = "info"
    warning = "warning"
    error = "error"
    events = "events"


def run(
    config: Annotated[
        Path | None, typer.Argument(help="The file that says what to run; none with --from.")
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="BUNDLE",
            help="Repeat the run of a bundle, and say whether the digests agree; exit code 1 if "
            "they do not.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; runs/<name>/<time> if not given.")
    ] = None,
    overrides: Overrides = None,
    log: Annotated[
        Log | None,
        typer.Option(help='Least level to print, or "events" for every event that is sent.'),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="NODE,…",
            help="Run just these nodes here; other processes, also elsewhere, run the others.",
        ),
    ] = None,
    quiet: Quiet = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print all tables at the end, as `show` does.")
    ] = False,
    junit: JUnit = None,
    json: Json = None,
    trace: Annotated[
        Path | None,
        typer.Option(help="Write a trace for ui.perfetto.dev; compressed if it ends with .gz."),
    ] = None,
    top: Annotated[
        bool, typer.Option("--top", help="Show the monitor's screen instead of a progress bar.")
    ] = False,
    web: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, metavar="PORT", help="Show the monitor as a page, on this port."
        ),
    ] = None,
    twice: Annotated[
        bool,
        typer.Option(
            "--twice", help="Run it twice, and say whether it repeats; exit code 1 if it does not."
        ),
    ] = False,
    flight: Annotated[
        str, typer.Option(hidden=True, help='For sweeps: "use" a recorded flight, or "record" it.')
    ] = "",
) -> None:
    """Run the nodes of a file until they, its duration or Ctrl-C end the run.

    Results go to runs/<name>/<time> (with --only, runs/<name>-<first node>/<time>): summary.json,
    log.txt, the resolved config.toml, and whatever the nodes write. The link runs/<name>/latest
    leads to the newest run that had a first update. An earlier run in the folder given by --out is
    renamed to FOLDER.<its time>. Printed is who passed, and how well; --verbose and `show` print
    all else. Ends with 0, also after Ctrl-C, SIGTERM, SIGHUP or a closed window (a second Ctrl-C is
    immediate); with 1 if a threshold of the run was not met, or it was run twice and differed; with
    2 if something failed. With --from it ends with 0 if all digests agree, whatever the thresholds;
    a bundle runs the programs and the code that it names: repeat those that you trust.
    """
    from runtime.config.reading import load_configuration
    from runtime.errors import CommandError
    from runtime.run.execute import execute
    from runtime.run.results import Folder
    from runtime.tools.cli.brief import print_failures, print_lines, print_tables
    from runtime.tools.twice import run_twice

    if "VISNAV_LIFELINE" in os.environ:
        from runtime.tools.sweep.process import end_with_the_sweep

        end_with_the_sweep()
    changes = list(overrides or [])
    if log is not None and log is not Log.events:
        changes.append(f"run.log={log.value}")
    bundled = None
    with writing((config or bundle or Path("run")).stem, junit, json) as outcomes:
        if config is not None and bundle is None:
            settings = load_configuration(config, changes)
        elif bundle is not None and config is None and only is None:
            from runtime.tools.paper.repeat import configuration, read_bundle

            bundled = read_bundle(bundle)
            settings, notes = configuration(bundled, changes)
            for note in notes:
                warn(note)
        else:
            options = {"a file": config, "--from": bundle, "--only": only}
            options_given = [name for name, value in options.items() if value is not None]
            raise CommandError(
                "run: expected a file, or a bundle with --from and without --only, found "
                f"{' and '.join(options_given) or 'neither'}"
            )
        nodes_here = chosen(settings, only)
        check_before_run(settings, nodes_here)
        name = "-".join([settings.run.name, *nodes_here[:1]])
        folder = Folder(out or Path("runs") / name, by_time=out is None)
        handlers, watch = observed(
            settings, name, quiet=quiet, trace=trace, top=top, web=web, flight=flight
        )
        try:
            summary = (run_twice if twice else execute)(
                settings,
                folder,
                handlers=handlers,
                log_events=log is Log.events,
                watch=watch,
                only=nodes_here,
            )
        except Exception:
            if out is None and (more := folder.path / "log.txt").is_file():
                print(f"{more} says more", file=sys.stderr)
            raise
        outcomes += of_verdict(name, summary.verdict, summary.wall_seconds)
    if verbose:
        print_tables(summary)
    if quiet:
        print_failures(summary)
    else:
        print_lines(summary, folder.path)
    code = 1 if summary.verdict is not None and summary.verdict.passed is False else 0
    if bundled is not None:
        from runtime.tools.paper.repeat import compare_runs

        agreement = compare_runs(bundled, summary)
        code = 0 if agreement.agrees else 1
        for line in () if quiet and agreement.agrees else agreement.lines:
            print(line)
    if summary.twice is not None and not summary.twice.repeats:
        code = 1
    leave_behind(code)


def chosen(settings: Config, only: str | None) -> list[str]:
    """Return the nodes of ``--only``, in file order; none if all; `ConfigError` if unknown."""
    from runtime.errors import ConfigError, expect_known

    if only is None:
        return []
    names = [spec.name for spec in settings.nodes]
    selected = [name.strip() for name in only.split(",") if name.strip()]
    for name in selected:
        listed = f"--only {only}: expected nodes of the file ({', '.join(names)})"
        expect_known(name, names, f"{listed}, found {name}")
    if not selected:
        raise ConfigError("--only: expected names of nodes with commas between, found none")
    return [] if set(selected) == set(names) else [name for name in names if name in selected]


def check_before_run(settings: Config, only: Collection[str] = ()) -> None:
    """Check the file before the run: print the warnings, raise `ConfigError` for errors."""
    from runtime.errors import ConfigError
    from runtime.tools.preflight import of_file

    findings = of_file(settings, only)
    for warning in findings.warnings:
        warn(warning)
    if findings.errors:
        raise ConfigError("; ".join(findings.errors))


def leave_behind(code: int, last: str = "") -> NoReturn:
    """End the process with a last line, even if work of a node never returns; Python would wait."""
    from runtime.run import event_loop

    threads = [t for t in threading.enumerate() if t.name.startswith(("offload", "node", "zenoh"))]
    deadline = time.monotonic() + _LAST_WAIT
    for thread in threads:
        thread.join(max(deadline - time.monotonic(), 0.0))
    stuck = [thread.name for thread in threads if thread.is_alive()]
    stuck += dict.fromkeys(task.get_name() for task in event_loop.LEFT)
    if stuck:
        print(f"warning: still busy, left behind: {', '.join(stuck)}", file=sys.stderr)
    if last:
        print(last, file=sys.stderr)
    if stuck:
        with contextlib.suppress(OSError):  # a closed pipe
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def observed(
    settings: Config,
    name: str,
    *,
    quiet: bool,
    trace: Path | None,
    top: bool,
    web: int | None,
    flight: str = "",
) -> tuple[list[logging.Handler], Watch]:
    """Return where the log records of a run go, and its observers: `handlers` and `watch`.

    Args:
        name: By which to find it: the run's, and more if it is one process of several.
    """
    from rich.console import Console

    from runtime.logs import terminal_handler
    from runtime.tools.cli.brief import progress
    from runtime.tools.monitor.observer import LastRecords
    from runtime.tools.tracing.write import tracing

    records = LastRecords()
    handlers: list[logging.Handler] = [records]
    watches: list[Watch] = []
    if not top:
        console = Console(stderr=True)  # one for both: the bar makes room for log lines
        handlers.append(terminal_handler(console))
        if not quiet:
            watches.append(progress(settings.run, console))
    watches.append(lambda supervisor: _monitored(supervisor, settings, name, records, top, web))
    if trace is not None:
        watches.append(lambda supervisor: tracing(supervisor, trace, name))
    if flight:
        from runtime.tools.flights import recorded

        if (played := recorded(settings, record=flight == "record")) is not None:
            watches.append(played)

    @contextlib.contextmanager
    def watching(supervisor: Supervisor) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for watch in watches:
                stack.enter_context(watch(supervisor))
            yield

    return handlers, watching


@contextlib.contextmanager
def _monitored(
    supervisor: Supervisor,
    settings: Config,
    name: str,
    records: LastRecords,
    top: bool,
    web: int | None,
) -> Iterator[None]:
    from runtime.tools.monitor.observer import Observer
    from runtime.tools.monitor.server import serving

    with contextlib.ExitStack() as stack:
        observer = Observer(supervisor, settings, records)
        # The screens end after the server, by which they know that the run is over.
        screens = stack.enter_context(contextlib.ExitStack())
        path = stack.enter_context(serving(observer, name))
        if path is not None and top:
            screens.enter_context(_beside("top", str(path), "--leave"))
        if path is not None and web is not None:
            screens.enter_context(_beside("web", str(path), "--port", str(web)))
        yield


@contextlib.contextmanager
def _beside(*arguments: str) -> Iterator[None]:
    """Run a `runtime` command in a separate process, to draw without delaying the run."""
    command = [sys.executable, "-m", "runtime", *arguments]
    # The screen has the terminal and gets its Ctrl-C; the page outlives one, to show the end.
    group = None if arguments[0] == "top" else 0
    with subprocess.Popen(command, process_group=group) as process:  # noqa: S603  # our own module
        over = threading.Event()
        threading.Thread(target=_print_when_closed, args=(process, over), daemon=True).start()
        try:
            yield
        finally:
            over.set()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.terminate()


def _print_when_closed(process: subprocess.Popen[bytes], over: threading.Event) -> None:
    process.wait()
    if not over.is_set():
        print("the monitor was closed; the run goes on, Ctrl-C ends it", file=sys.stderr)


DEFAULT_PORT = 8420
Run = Annotated[str | None, typer.Argument(help="Name of the run; needed if there are several.")]


def top(
    run: Run = None,
    leave: Annotated[bool, typer.Option("--leave", help="Quit when the run ends.")] = False,
) -> None:
    """Monitor and control a run in a terminal.

    It shows estimators with their errors so far, their paths from above, nodes, channels, clock,
    settings and log. Keys pause the run, step it, change its speed or a setting, restart a node
    and end the run. Quitting does not affect the run.
    """
    from runtime.tools.monitor.protocol import Client, find
    from runtime.tools.monitor.screen import Screen

    _check_terminal()
    Screen(Client(find(run)), leave).run()


def _check_terminal() -> None:
    import codecs
    import sys

    from runtime.errors import CommandError

    drawn_on = sys.__stderr__  # by Textual
    if drawn_on is None or not (sys.stdin.isatty() and drawn_on.isatty()):
        raise CommandError('expected a terminal, found none; "python -m runtime web" needs none')
    if codecs.lookup(drawn_on.encoding).name != "utf-8":
        raise CommandError(
            f"expected a terminal in UTF-8, found {drawn_on.encoding}: set LC_ALL=C.UTF-8 if it is"
        )


def web(
    run: Run = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="On this machine; 0 for any.")
    ] = DEFAULT_PORT,
    token: Annotated[
        str | None, typer.Option(help="What the address must hold; made up if not given.")
    ] = None,
) -> None:
    """Monitor a run on a live page, with the same figures and commands as top, and its images.

    The page is served on this machine only, only to those who have the address that is printed,
    and until the run ends.
    """
    from runtime.errors import CommandError
    from runtime.tools.monitor.protocol import find
    from runtime.tools.monitor.web import PageServer, serve

    path = find(run)
    try:
        server = PageServer(port, path, token)
    except OSError as error:
        raise CommandError(
            f"--port {port}: expected a port that is free, found: {error.strerror}"
        ) from None
    serve(server)


def set_(
    change: Annotated[str, typer.Argument(metavar="NODE.KEY=VALUE", help="As for run --set.")],
    run: Annotated[
        str | None, typer.Option(help="Name of the run; needed if there are several.")
    ] = None,
) -> None:
    """Change a setting of a node while its run goes on.

    The value is checked as in the file. The change is an event of the run, so that its log, its
    digest and its recordings have it. "python -m runtime nodes" says which settings can change.
    """
    from runtime.tools.monitor.protocol import Set, ask, find

    path = find(run)
    print(f"run {path.stem.rpartition('-')[0]}: {ask(path, Set(text=change))}")


def trace(file: Annotated[Path, typer.Argument(help="A trace that run --trace wrote.")]) -> None:
    """Show the latency from sensors to set-points, and how much of the loop each node had.

    A path is the events from an exposure to a set-point: → where one follows from another (it
    bears its stamp, or was sent on hearing it), ⇢ where a node goes at a rate of its own, and it
    was the newest that it had heard. Latencies begin at the exposure.
    """
    from rich.console import Console

    from runtime.tools.tracing.write import read_trace

    trace = read_trace(file)
    console = Console()
    for table in tables(trace, console.encoding):
        console.print(table)
    clock = trace.about.get("clock", "?")
    console.print(
        f"run {trace.about.get('run', '?')!r} on the {clock} clock; ui.perfetto.dev shows the rest",
        highlight=False,
    )


def tables(trace: Trace, encoding: str = "utf-8") -> Iterator[Table | Text]:
    """Return the paths of a trace, and its nodes, as a terminal of this encoding can show them."""
    from rich.text import Text

    from runtime.tools.cli.brief import table_of
    from runtime.tools.tracing.write import node_loads, paths, quantile

    def quantiles(ms: list[float]) -> list[str]:
        return [f"{value:.2f}" for value in (quantile(ms, 0.5), quantile(ms, 0.99), max(ms))]

    routes = paths(trace)
    for number, route in enumerate(routes, 1):
        yield Text(f"path {number}: {_for(encoding, route.path)}")
    if routes:
        yield table_of(
            "from sensor to set-point",
            ("path", "times", "run p50 ms", "p99", "max", "real p50 ms", "p99", "max"),
            [
                (number, len(route.run_ms), *quantiles(route.run_ms), *quantiles(route.real_ms))
                for number, route in enumerate(routes, 1)
            ],
        )
    else:
        yield Text("no set-point was sent that a sensor led to")
    loads = [
        (
            _for(encoding, load.node),
            load.steps,
            f"{load.busy_ms:.1f}",
            f"{load.share:.1%}",
            f"{load.longest_ms:.3f}",
            _for(encoding, load.longest),
        )
        for load in node_loads(trace)
    ]
    yield table_of("on the loop", ("node", "steps", "loop ms", "share", "longest ms", "in"), loads)


def _for(encoding: str, text: str) -> str:
    """Return a text with all characters foreign to an encoding replaced."""
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        text = text.replace("→", "->").replace("⇢", "~>")
        return text.encode(encoding, "replace").decode(encoding)
    return text
