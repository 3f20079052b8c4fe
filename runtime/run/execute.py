"""A whole run, from settings to results: loop, clock, signals, logging, progress and files."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import logging
import signal
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from events import Event, PoseEstimate, TrajectoryEstimate
from runtime.channels.sender import Sender, Tap
from runtime.channels.wire import Digest
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError, VisnavError
from runtime.logs import executor, file_handler, lines_of, logging_to
from runtime.node import Node
from runtime.run import event_loop, results
from runtime.run.node_runner import log_error, with_place, wrap
from runtime.run.results import Folder
from runtime.run.summarise import summarise
from runtime.run.supervisor import Supervisor
from runtime.run.watchdogs import LoopWatchdog, ProgressWatchdog
from runtime.summary import Stall, Summary
from runtime.time import lockstep
from runtime.time.clock import Clock, RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop

log = logging.getLogger("visnav.runtime")
events_log = logging.getLogger("visnav.events")

Watch = Callable[[Supervisor], contextlib.AbstractContextManager[None]]
"""Given the supervisor, returns a context that lasts as long as the run: a monitor, a trace."""


def execute(
    config: Config,
    out: Path | Folder | None = None,
    *,
    handlers: list[logging.Handler] | None = None,
    log_events: bool = False,
    watch: Watch | None = None,
    only: Collection[str] = (),
    digest: Digest | None = None,
    complete: Callable[[Summary], Summary] = lambda summary: summary,
) -> Summary:
    """Run a configuration to its end.

    Args:
        out: Folder for results, or its path; `None` writes nothing.
        only: Nodes to run here; the others run in other processes. All, if empty.
        complete: Called with the summary before it is written; returns what is.

    Raises:
        VisnavError: Something went wrong; what was recorded until then is complete, and what is to
            be written after a run has been.
    """
    handlers = list(handlers or [])
    programs = any(spec.node.starts_programs for spec in config.nodes)
    with contextlib.ExitStack() as stack:
        stack.enter_context(lines_of(object()))
        folder = Folder(out) if isinstance(out, Path) else out
        if folder is not None:
            stack.enter_context(folder)
            results.write_config(folder.path, config)
            handlers.append(file_handler(folder.path / "log.txt"))
        code = {} if folder is None else code_of_estimators(config, only)
        run = _Run(config, folder, log_events, watch, only, digest, code)
        stack.enter_context(logging_to(handlers, config.run.log, run.now))
        if folder is not None and folder.earlier is not None:
            log.info("the folder of the earlier run is now %s", folder.earlier)
        with contextlib.ExitStack() as private:
            if folder is not None and programs:
                from runtime.run.private_results import private_results

                run.private = private.enter_context(private_results(folder.path))
            summary = complete(event_loop.run_to_end(run.loop, run.main(), run.escaped))
        if folder is not None:
            run.conclude(folder.path, summary)
    if run.supervisor.state.error is not None:
        raise run.supervisor.state.error
    return summary


def code_of_estimators(config: Config, only: Collection[str] = ()) -> dict[str, str]:
    """Return the hash of the files of each node that may send estimates, by its name."""
    from runtime.run.made_from import code_of  # only runs that leave results need it

    estimates = (PoseEstimate, TrajectoryEstimate)
    return {
        spec.name: code_of(spec)
        for spec in config.nodes
        if (not only or spec.name in only)
        and any(issubclass(port.event, estimates) for port in spec.node.declared.outputs.values())
    }


def make_loop(run: RunConfig) -> asyncio.AbstractEventLoop:
    """Return a new event loop for the run's clock, or raise `UnsupportedInterpreterError`."""
    if run.clock == "lockstep":
        lockstep.check_interpreter()
        return LockstepLoop(speed=None if run.speed in {None, "max"} else run.speed)  # type: ignore[arg-type]
    try:
        import uvloop
    except ImportError:  # a platform that it does not serve
        loop = asyncio.new_event_loop()
    else:
        loop = uvloop.new_event_loop()
    # Named, so that the command line knows whose threads may be left behind.
    loop.set_default_executor(executor("node"))
    return loop


def make_clock(run: RunConfig, loop: asyncio.AbstractEventLoop) -> Clock:
    """Return the run's clock, at 0."""
    if isinstance(loop, LockstepLoop):
        return LockstepClock(loop)
    return RealClock(loop, speed=1.0 if run.speed is None else run.speed)  # type: ignore[arg-type]


@dataclass
class _Run:
    config: Config
    folder: Folder | None
    log_events: bool
    watch: Watch | None
    only: Collection[str]
    digest: Digest | None
    code: dict[str, str]
    supervisor: Supervisor = field(init=False)
    clock: Clock | None = None
    private: Path | None = None
    """Output folder of nodes starting no programs; `None` for the run's folder."""

    def __post_init__(self) -> None:
        run = self.config.run
        self.loop = make_loop(run)
        wanted = run.clock == "lockstep" if run.digest is None else run.digest
        self.digest = self.digest or (Digest() if wanted else None)

    def now(self) -> int:
        """Return the time of the run's clock (ns); 0 before there is a clock."""
        return self.clock.now() if self.clock is not None else 0

    async def main(self) -> Summary:
        """Run the nodes to their end, and return the run's summary."""
        loop, run = asyncio.get_running_loop(), self.config.run
        event_loop.install(loop)
        clock = self.clock = make_clock(run, loop)
        out = None if self.folder is None else self.folder.path
        taps: list[Tap] = [self.digest] if self.digest else []
        if self.log_events:
            taps.append(_log_event)
        self.supervisor = supervisor = Supervisor(
            self.config, clock, taps, self.private or out, self.only, out
        )
        supervisor.state.code = self.code
        if self.folder is not None:
            supervisor.before_first_update = self.folder.flown
        # In lockstep nothing comes of it but a longer wait; the table at the end has it, too.
        level = logging.DEBUG if run.clock == "lockstep" else logging.WARNING
        watchdog = LoopWatchdog(loop, run.stall, functools.partial(_report_stall, level))
        progress = ProgressWatchdog(supervisor.state, loop, run.progress_limit)
        with (
            _signals_stop(supervisor, loop),
            _no_long_collections(),
            progress,
            (self.watch or contextlib.nullcontext)(supervisor),
        ):
            watchdog.start()
            try:
                await supervisor.main()
            finally:
                watchdog.stop()
            summary = summarise(
                supervisor.state,
                digest=self.digest,
                stalls=watchdog.stalls,
                longest_stalls=watchdog.longest,
            )
            try:
                summary = await supervisor.others.leave(summary)
            except Exception as error:
                self.failed(wrap("the other processes", error))
        clock.close()
        return summary

    def escaped(self, error: BaseException) -> None:
        """Hand an exception of the loop to the supervisor; without any, re-raise."""
        if not hasattr(self, "supervisor"):  # a Ctrl-C before there was anything to end
            raise error
        self.loop.call_soon(self.supervisor.escaped, error)

    def failed(self, error: Exception) -> None:
        """Log an error; the first becomes the error of the run."""
        first = self.supervisor.state.error is None
        if isinstance(error, NodeError):
            log_error(error, last=first)
        else:
            log.error("%s", error, extra={"reported": first})
        if first:
            self.supervisor.state.error = error

    def conclude(self, out: Path, summary: Summary) -> None:
        """Write the summary, then call all `after_run` functions, also after errors."""
        if summary.error is None and self.supervisor.state.error is not None:
            error = with_place(self.supervisor.state.error)
            summary = msgspec.structs.replace(summary, error=error)
        try:
            results.write_summary(out, summary)
        except VisnavError as error:
            self.failed(error)
        for call in self.supervisor.state.afterwards:
            owner = getattr(call, "__self__", None)
            name = owner.name if isinstance(owner, Node) else call.__module__ or "runtime"
            try:
                call(out)
            except BaseException as error:
                self.failed(wrap(name, error))


@contextlib.contextmanager
def _signals_stop(supervisor: Supervisor, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
    """Let the first SIGINT, SIGTERM or SIGHUP end the run in order, and the second at once.

    An ignored SIGHUP stays so: the run was begun under nohup.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}

    def stop(number: int, _: Any) -> None:
        for handled in before:
            signal.signal(handled, signal.SIG_DFL)
        supervisor.state.stop_requested = names[signal.Signals(number)]
        loop.call_soon_threadsafe(supervisor.stop, supervisor.state.stop_requested)

    def interrupt(*_: Any) -> None:  # whoever blocks the loop; see `runtime.run.watchdogs`
        error, supervisor.state.interruption = supervisor.state.interruption, None
        if error is not None:
            raise error

    before = {number: signal.getsignal(number) or signal.SIG_DFL for number in names}
    # Not so the others: a shell has what it puts in the background ignore SIGINT, too.
    if before[signal.SIGHUP] is signal.SIG_IGN:
        del before[signal.SIGHUP]
    for number in before:
        signal.signal(number, stop)
    usual = signal.signal(signal.SIGUSR2, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.signal(signal.SIGUSR2, usual)


_FROZEN_AT_IMPORT = gc.get_freeze_count()  # Python 3.12 itself has frozen some


@contextlib.contextmanager
def _no_long_collections() -> Iterator[None]:
    """Exclude existing objects from garbage collection, whose pauses delay ticks.

    A program that has excluded its own before is left to it: its choice outlives the run.
    """
    if gc.get_freeze_count() > _FROZEN_AT_IMPORT:
        yield
        return
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
