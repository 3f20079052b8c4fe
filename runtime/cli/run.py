"""``run``: from a file to a folder of results."""

from __future__ import annotations

import os
import sys
import threading
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.cli.common import ConfigFile, Overrides

if TYPE_CHECKING:
    from rich.console import Console

    from runtime.config import Config
    from runtime.summary import Summary, Verdict


class Log(Enum):
    """What ``--log`` takes: a level, or ``events``."""

    trace = "trace"
    debug = "debug"
    info = "info"
    warning = "warning"
    error = "error"
    events = "events"


def run(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Folder for results; runs/<name> if not given.")
    ] = None,
    overrides: Overrides = None,
    log: Annotated[
        Log | None,
        typer.Option(help='Least level to print, or "events" for every event that is sent.'),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress bar and no table at the end.")
    ] = False,
) -> None:
    """Run the nodes of a file until they, its duration or Ctrl-C end the run.

    Results go to runs/<name>: summary.json, log.txt, the resolved config.toml, and whatever the
    nodes write. Ends with 0, also after Ctrl-C, SIGTERM or a closed window (a second Ctrl-C is
    immediate); with 1 if a threshold of the run was not met; with 2 if something failed.
    """
    from runtime.cli.progress import progress
    from runtime.config import load
    from runtime.execute import execute
    from runtime.logs import terminal_handler

    changes = list(overrides or [])
    if log is not None and log is not Log.events:
        changes.append(f"run.log={log.value}")
    settings = load(config, changes)
    warn_unconnected(settings)
    folder = out or Path("runs") / settings.run.name
    summary = execute(
        settings,
        folder,
        handlers=[terminal_handler()],
        log_events=log is Log.events,
        watch=None if quiet else progress(settings.run),
    )
    if not quiet:
        report(summary, folder)
    code = 0 if summary.verdict is None or summary.verdict.passed else 1
    leave_threads_behind(code)
    raise typer.Exit(code)


def warn_unconnected(settings: Config) -> None:
    """Print a line for each input that no node can send to."""
    from runtime.graph import unconnected

    nodes = [(spec.name, spec.node) for spec in settings.nodes]
    for node, port, event in unconnected(nodes):
        print(f"warning: {node}.{port}: expects {event}, and no node sends it", file=sys.stderr)


def report(summary: Summary, folder: Path) -> None:
    """Print the table at the end of a run."""
    from rich.console import Console

    from runtime.cli.tables import run_tables

    console = Console()
    for table in run_tables(summary):
        console.print(table)
    speed = summary.sim_seconds / max(summary.wall_seconds, 1e-9)
    digest = summary.digest or "off"
    if summary.digest and summary.not_deterministic:
        digest += f" (not promised, because of {', '.join(summary.not_deterministic)})"
    if summary.verdict is not None:
        _judge(console, summary.verdict)
    console.print(
        f"{summary.sim_seconds:.1f} s on the {summary.clock} clock in "
        f"{summary.wall_seconds:.1f} s ({speed:.1f} × real time), ended by: {summary.reason}\n"
        f"digest {digest}   results in [bold]{folder}[/bold]",
        highlight=False,
    )


def _judge(console: Console, verdict: Verdict) -> None:
    """Print who passed, and what those failed that did not."""
    for name, figures in verdict.estimators.items():
        passed = "[green]passed[/green]" if figures["passed"] else "[red]failed[/red]"
        reasons = "; ".join(str(reason) for reason in figures.get("failed", ()))
        console.print(f"{name} {passed}{': ' + reasons if reasons else ''}", highlight=False)


def leave_threads_behind(code: int) -> None:
    """End the process if offloaded work of a node never returns; else Python would wait for it."""
    threads = [t for t in threading.enumerate() if t.name.startswith(("offload", "node"))]
    for thread in threads:
        thread.join(1.0)
    if stuck := [thread.name for thread in threads if thread.is_alive()]:
        print(f"warning: still busy, left behind: {', '.join(stuck)}", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
