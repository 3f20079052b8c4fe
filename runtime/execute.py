"""One whole run, from settings to results: loop, clock, signals, logging, progress and files."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import logging
import shutil
import signal
import threading
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomli_w

from events import Event
from runtime import steps
from runtime.clock import Clock
from runtime.config import Config, RunConfig, to_builtins
from runtime.digest import Digest
from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.logs import file_handler, logging_to
from runtime.realtime import RealClock
from runtime.sender import Sender, Tap
from runtime.summary import Summary, summarise
from runtime.supervisor import Supervisor
from runtime.watchdog import Stall, Watchdog

log = logging.getLogger("visnav.runtime")
events_log = logging.getLogger("visnav.events")


def execute(
    config: Config,
    out: Path | None = None,
    *,
    handlers: list[logging.Handler] | None = None,
    log_events: bool = False,
    watch: Callable[[Supervisor], contextlib.AbstractContextManager[None]] | None = None,
    only: Collection[str] = (),
) -> Summary:
    """Run a configuration to its end.

    Args:
        config: What to run.
        out: Folder for results, made if missing; `None` writes nothing.
        handlers: Where log records go, besides ``log.txt`` in `out`.
        log_events: Log every event that is sent.
        watch: Given the supervisor, returns a context that lasts as long as the run: a progress
            bar, a monitor.
        only: Nodes to run here; the others run in other processes. All, if empty.

    Raises:
        VisnavError: Something went wrong; what was recorded until then is complete.
    """
    handlers = list(handlers or [])
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        _clear(out)
        (out / "config.toml").write_text(tomli_w.dumps(to_builtins(config)), encoding="utf-8")
        handlers.append(file_handler(out / "log.txt"))
    loop = make_loop(config.run)
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        summary, after, error = runner.run(_run(config, out, handlers, log_events, watch, only))
    if out is not None:
        encoded = msgspec.json.format(msgspec.json.encode(summary), indent=2)
        (out / "summary.json").write_bytes(encoded + b"\n")
        for call in after:
            call(out)
    if error is not None:
        raise error
    return summary


def _clear(out: Path) -> None:
    """Remove what an earlier run has left, lest it pass for this one's; recordings stay."""
    if (out / "config.toml").is_file():
        for name in ("summary.json", "report.html"):
            (out / name).unlink(missing_ok=True)
        for name in ("evaluation", "trajectories", "frames", "plots"):
            shutil.rmtree(out / name, ignore_errors=True)


def make_loop(run: RunConfig) -> asyncio.AbstractEventLoop:
    """Return a new loop for the clock that a run asks for."""
    if run.clock == "lockstep":
        return LockstepLoop(speed=None if run.speed in {None, "max"} else run.speed)  # type: ignore[arg-type]
    try:
        import uvloop
    except ImportError:  # a platform that it does not serve
        return asyncio.new_event_loop()
    return uvloop.new_event_loop()


def make_clock(run: RunConfig, loop: asyncio.AbstractEventLoop) -> Clock:
    """Return the run's clock, at 0."""
    if isinstance(loop, LockstepLoop):
        return LockstepClock(loop)
    return RealClock(loop, speed=1.0 if run.speed in {None, "max"} else run.speed)  # type: ignore[arg-type]


async def _run(
    config: Config,
    out: Path | None,
    handlers: list[logging.Handler],
    log_events: bool,
    watch: Callable[[Supervisor], contextlib.AbstractContextManager[None]] | None,
    only: Collection[str],
) -> tuple[Summary, list[Callable[[Path], Any]], Exception | None]:
    loop = asyncio.get_running_loop()
    steps.install(loop)
    clock = make_clock(config.run, loop)
    wanted = config.run.clock == "lockstep" if config.run.digest is None else config.run.digest
    digest = Digest() if wanted else None
    taps: list[Tap] = [digest] if digest else []
    if log_events:
        taps.append(_log_event)
    supervisor = Supervisor(config, clock, taps, out, only)
    # In lockstep nothing comes of it but a longer wait; the table at the end has it, too.
    level = logging.DEBUG if config.run.clock == "lockstep" else logging.WARNING
    watchdog = Watchdog(loop, config.run.stall, functools.partial(_report_stall, level))
    with (
        logging_to(handlers, config.run.log, clock.now),
        _signals_stop(supervisor, loop),
        _no_long_collections(),
        watch(supervisor) if watch else contextlib.nullcontext(),
    ):
        watchdog.start()
        try:
            await supervisor.main()
        finally:
            watchdog.stop()
        summary = summarise(
            supervisor,
            name=config.run.name,
            sim_ns=clock.now(),
            digest=digest,
            stalls=watchdog.stalls,
            longest_stalls=watchdog.longest,
        )
        if supervisor.peers is not None:
            summary = await supervisor.peers.part(summary)
            await supervisor.peers.close()
        clock.close()
    return summary, supervisor.after, supervisor.error


@contextlib.contextmanager
def _signals_stop(supervisor: Supervisor, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
    """Let the first SIGINT or SIGTERM end the run in order, and the second end it at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}

    def stop(number: int, _: Any) -> None:
        for each in names:
            signal.signal(each, signal.SIG_DFL)
        loop.call_soon_threadsafe(supervisor.stop, names[signal.Signals(number)])

    before = {number: signal.signal(number, stop) for number in names}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _no_long_collections() -> Iterator[None]:
    """Leave what is there already out of garbage collections, which delay ticks."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _report_stall(level: int, stall: Stall) -> None:
    log.log(
        level, "the loop stood for %.0f ms: %s, %s", stall.seconds * 1e3, stall.node, stall.line
    )


def _log_event(sender: Sender[Any] | None, event: Event) -> None:
    fields = (
        f"{name}={_brief(getattr(event, name))}"
        for name in event.__struct_fields__
        if name not in {"stamp", "source"}
    )
    events_log.info(
        "%s %s %s: %s",
        sender.name if sender else "announced",
        type(event).__name__,
        event.source,
        " ".join(fields),
    )


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return "(" + ", ".join(f"{v:.4g}" for v in value) + ")"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
