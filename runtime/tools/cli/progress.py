"""The progress bar: simulated time, speed, frames. Drawn by a thread; the loop knows nothing."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from runtime.config.model import RunConfig
from runtime.run.summarise import count_events
from runtime.run.supervisor import Supervisor
from runtime.time.schedule import SECOND

_PERIOD = 0.2
_LINE_PERIOD = 10.0
"""Seconds between two updates: of the bar, and of the lines where there is no terminal."""


def progress(
    run: RunConfig, console: Console
) -> Callable[[Supervisor], contextlib.AbstractContextManager[None]]:
    """Return what `execute` takes as `watch`.

    Args:
        run: The run's settings.
        console: Where to draw. What else is printed there, such as log lines, appears above the
            bar.
    """
    return lambda supervisor: _watching(run, supervisor, console)


@contextlib.contextmanager
def _watching(run: RunConfig, supervisor: Supervisor, console: Console) -> Iterator[None]:
    end = threading.Event()
    show = _draw if console.is_terminal else _print
    thread = threading.Thread(
        target=show, args=(run, supervisor, console, end), name="progress", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def _draw(run: RunConfig, supervisor: Supervisor, console: Console, end: threading.Event) -> None:
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}")
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(run.name, total=run.duration or None, text="starting")
        while not end.wait(_PERIOD):
            seconds, text = _state(run, supervisor)
            bar.update(task, completed=seconds, text=text)


def _print(run: RunConfig, supervisor: Supervisor, console: Console, end: threading.Event) -> None:
    while not end.wait(_LINE_PERIOD):
        console.print(f"{run.name}: {_state(run, supervisor)[1]}", highlight=False)


def _state(run: RunConfig, supervisor: Supervisor) -> tuple[float, str]:
    if supervisor.state.first_update is None:
        return 0.0, "starting"
    seconds = supervisor.state.clock.now() / SECOND
    speed = seconds / max(time.monotonic() - supervisor.state.first_update, 1e-9)
    limit = f" of {run.duration:g}" if run.duration else ""
    try:
        frames = count_events(supervisor.state)[0]["Image"]
    except RuntimeError:  # a table of counts grew while this thread read it
        frames = 0
    return seconds, f"{seconds:5.1f}{limit} s  {speed:.1f} × real time  {frames} frames"
