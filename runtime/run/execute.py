"""A whole run, from settings to results: loop, clock, signals, logging, progress and files."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import gc
import logging
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from events import Event
from runtime.channels.digest import Digest
from runtime.channels.sender import Sender, Tap
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError, VisnavError
from runtime.logs import file_handler, logging_to
from runtime.node import Node
from runtime.run import event_loop, results
from runtime.run.node_runner import log_error, with_place, wrap
from runtime.run.results import private_results
from runtime.run.summarise import summarise
from runtime.run.supervisor import Supervisor
from runtime.run.watchdogs import LoopWatchdog, ProgressWatchdog
from runtime.summary import Stall, Summary
from runtime.time import lockstep
from runtime.time.clock import Clock, RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop

log = logging.getLogger("visnav.runtime")
events_log = logging.getLogger("visnav.events")


def execute(
    config: Config,
    out: Path | results.Folder | None = None,
    *,
    handlers: list[logging.Handler] | None = None,
    log_events: bool = False,
    watch: Callable[[Supervisor], contextlib.AbstractContextManager[None]] | None = None,
    only: Collection[str] = (),
    stand_ins: Mapping[str, type[Node[Any]]] = MappingProxyType({}),
    digest: Digest | None = None,
    complete: Callable[[Summary], Summary] = lambda summary: summary,
) -> Summary:
    """Run a configuration to its end.

    Args:
        out: Folder for results, or its path; `None` writes nothing.
        watch: Given the supervisor, returns a context that lasts as long as the run: a progress
            bar, a monitor.
        only: Nodes to run here; the others run in other processes. All, if empty.
        stand_ins: Classes that run in the place of some nodes' own, by the node's name.
        complete: Called with the summary before it is written; returns what is.

    Raises:
        VisnavError: Something went wrong; what was recorded until then is complete, and what is to
            be written after a run has been.
    """
    handlers = list(handlers or [])
    programs = any(spec.node.starts_programs for spec in config.nodes)
    with contextlib.ExitStack() as stack:
        folder = results.Folder(out) if isinstance(out, Path) else out
        if folder is not None:
            stack.enter_context(folder)
            results.write_config(folder.path, config)
            handlers.append(file_handler(folder.path / "log.txt"))
        run = _Run(config, folder, log_events, watch, only, stand_ins, digest)
        stack.enter_context(logging_to(handlers, config.run.log, run.now))
        if folder is not None and folder.earlier is not None:
            log.info("the folder of the earlier run is now %s", folder.earlier)
        with contextlib.ExitStack() as private:
            if folder is not None and programs:
                run.private = private.enter_context(private_results(folder.path))
            summary = complete(event_loop.run_to_end(run.loop, run.main(), run.escaped))
        if folder is not None:
            run.conclude(folder.path, summary)
    if run.supervisor.state.error is not None:
        raise run.supervisor.state.error
    return summary


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
    loop.set_default_executor(concurrent.futures.ThreadPoolExecutor(thread_name_prefix="node"))
    return loop


def make_clock(run: RunConfig, loop: asyncio.AbstractEventLoop) -> Clock:
    """Return the run's clock, at 0."""
    if isinstance(loop, LockstepLoop):
        return LockstepClock(loop)
    return RealClock(loop, speed=1.0 if run.speed in {None, "max"} else run.speed)  # type: ignore[arg-type]


class _Run:
    supervisor: Supervisor
    private: Path | None = None
    """Output folder of nodes starting no programs; `None` for the run's folder."""

    def __init__(
        self,
        config: Config,
        folder: results.Folder | None,
        log_events: bool,
        watch: Callable[[Supervisor], contextlib.AbstractContextManager[None]] | None,
        only: Collection[str],
        stand_ins: Mapping[str, type[Node[Any]]],
        digest: Digest | None,
    ) -> None:
        self.loop = make_loop(config.run)
        self._clock: Clock | None = None
        self._config = config
        self._folder = folder
        self._watch = watch or contextlib.nullcontext
        self._only = only
        self._stand_ins = stand_ins
        wanted = config.run.clock == "lockstep" if config.run.digest is None else config.run.digest
        self._digest = digest or (Digest() if wanted else None)
        self._taps: list[Tap] = [self._digest] if self._digest else []
        if log_events:
            self._taps.append(_log_event)

    def now(self) -> int:
        """Return the time of the run's clock (ns); 0 before there is a clock."""
        return self._clock.now() if self._clock is not None else 0

    async def main(self) -> Summary:
        """Run the nodes to their end, and return the run's summary."""
        loop, run = asyncio.get_running_loop(), self._config.run
        event_loop.install(loop)
        clock = self._clock = make_clock(run, loop)
        out = None if self._folder is None else self._folder.path
        self.supervisor = supervisor = Supervisor(
            self._config, clock, self._taps, self.private or out, self._only, self._stand_ins, out
        )
        if self._folder is not None:
            supervisor.state.before_first_update = self._folder.flown
        # In lockstep nothing comes of it but a longer wait; the table at the end has it, too.
        level = logging.DEBUG if run.clock == "lockstep" else logging.WARNING
        watchdog = LoopWatchdog(loop, run.stall, functools.partial(_report_stall, level))
        progress = ProgressWatchdog(supervisor.state, loop, run.progress_limit)
        with (
            _signals_stop(supervisor, loop),
            _no_long_collections(),
            progress,
            self._watch(supervisor),
        ):
            watchdog.start()
            try:
                await supervisor.main()
            finally:
                watchdog.stop()
            summary = summarise(
                supervisor.state,
                digest=self._digest,
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
        """Write the summary, then call all `after_run` functions, whatever goes wrong."""
        if summary.error is None and self.supervisor.state.error is not None:
            error = with_place(self.supervisor.state.error)
            summary = msgspec.structs.replace(summary, error=error)
        try:
            results.write_summary(out, summary)
        except VisnavError as error:
            self.failed(error)
        for call in self.supervisor.state.after_run:
            owner = getattr(call, "__self__", None)
            name = owner.name if isinstance(owner, Node) else getattr(call, "__module__", "runtime")
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
        for each in before:
            signal.signal(each, signal.SIG_DFL)
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


@contextlib.contextmanager
def _no_long_collections() -> Iterator[None]:
    """Exclude existing objects from garbage collection, whose pauses delay ticks."""
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
