"""The observers of a run: progress bar, trace and monitor, each a context around the run."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from runtime.config.model import Config
    from runtime.run.supervisor import Supervisor
    from runtime.tools.monitor.observer import LastRecords

Watch = Callable[["Supervisor"], contextlib.AbstractContextManager[None]]
"""What `execute` takes as `watch`."""


class Observers:
    """The observers of one run.

    Args:
        name: By which to find it: the run's, and more if it is one process of several.
        quiet: Whether there is to be no progress bar.
        top: Whether to show the monitor's screen in this terminal.
        web: Port on which to show it as a page.

    Attributes:
        handlers: Where log records go.
        watch: What `execute` takes.
    """

    def __init__(
        self,
        settings: Config,
        name: str,
        *,
        quiet: bool,
        trace: Path | None,
        top: bool,
        web: int | None,
    ) -> None:
        from rich.console import Console

        from runtime.logs import terminal_handler
        from runtime.tools.cli.tables import progress
        from runtime.tools.monitor.observer import LastRecords

        records = LastRecords()
        self.handlers: list[logging.Handler] = [records]
        watches: list[Watch] = []
        if not top:
            console = Console(stderr=True)  # one for both: the bar makes room for log lines
            self.handlers.append(terminal_handler(console))
            if not quiet:
                watches.append(progress(settings.run, console))
        watches.append(_monitored(settings, name, records, top, web))
        if trace is not None:
            watches.append(_traced(trace, name))
        self.watch = _together(watches)


def _together(watches: list[Watch]) -> Watch:
    """Return one that does what all do, in order."""

    @contextlib.contextmanager
    def watching(supervisor: Supervisor) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for watch in watches:
                stack.enter_context(watch(supervisor))
            yield

    return watching


def _traced(path: Path, name: str) -> Watch:
    from runtime.tools.tracing.record import tracing

    return lambda supervisor: tracing(supervisor, path, name)


def _monitored(
    settings: Config, name: str, records: LastRecords, top: bool, web: int | None
) -> Watch:
    from runtime.tools.monitor.observer import Observer
    from runtime.tools.monitor.server import serving

    @contextlib.contextmanager
    def monitored(supervisor: Supervisor) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            observer = Observer(supervisor, settings, records)
            # The screens end after the server, by which they know that the run is over.
            screens = stack.enter_context(contextlib.ExitStack())
            path = stack.enter_context(serving(observer, name))
            if path is not None and top:
                screens.enter_context(_beside("top", str(path), "--leave"))
            if path is not None and web is not None:
                screens.enter_context(_beside("web", str(path), "--leave", "--port", str(web)))
            yield

    return monitored


@contextlib.contextmanager
def _beside(*arguments: str) -> Iterator[None]:
    """Run a command of ours in a process of its own, so that drawing does not hold up the run."""
    command = [sys.executable, "-m", "runtime", *arguments]
    # The screen has the terminal and gets its Ctrl-C; the page outlives one, to show the end.
    group = None if arguments[0] == "top" else 0
    with subprocess.Popen(command, process_group=group) as process:  # noqa: S603  # our own module
        over = threading.Event()
        threading.Thread(target=_tell_when_gone, args=(process, over), daemon=True).start()
        try:
            yield
        finally:
            over.set()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.terminate()


def _tell_when_gone(process: subprocess.Popen[bytes], over: threading.Event) -> None:
    process.wait()
    if not over.is_set():
        print("the monitor was closed; the run goes on, Ctrl-C ends it", file=sys.stderr)
