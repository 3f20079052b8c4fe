"""Signals in this process: which end a run and which do not, and who handles them afterwards."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import pytest

from runtime import Duration, Node, NodeConfig
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError, NodeTimeoutError
from runtime.run.execute import execute
from runtime.summary import Summary
from runtime.testing import spec
from tests.runtime.samples_runs import supervisor_of

REASONS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}
pytestmark = pytest.mark.timeout(20)


class SignalledConfig(NodeConfig):
    """Which signal arrives, if any, and whether the node fails."""

    number: int = 0
    fails: bool = False


class Signalled(Node[SignalledConfig]):
    """Is running when a signal arrives, and looks at who handles signals as the run ends."""

    at_the_end: ClassVar[dict[signal.Signals, Any]] = {}

    async def run(self) -> None:
        if self.config.fails:
            raise RuntimeError("out of order")
        if self.config.number:
            signal.raise_signal(self.config.number)
        await self.clock.sleep(3600.0)

    async def on_shutdown(self) -> None:
        Signalled.at_the_end = {number: signal.getsignal(number) for number in REASONS}


def fly(node: type[Node[Any]] = Signalled, clock: Any = "lockstep", **settings: Any) -> Summary:
    run = RunConfig(duration=Duration(7200 if clock == "lockstep" else 10), clock=clock)
    return execute(Config(run=run, nodes=(spec(node, "node", settings),)))


def of_the_program(number: int, frame: object) -> None:
    """Handle signals as the program that starts a run does."""


@pytest.fixture
def handle() -> Iterator[Callable[[signal.Signals, Any], object]]:
    """Return a function to handle a signal for the length of a test."""
    numbers = [*REASONS, signal.SIGUSR2]
    before = {number: signal.getsignal(number) for number in numbers}
    yield signal.signal
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("name", "clock"),
    [("SIGINT", "lockstep"), ("SIGTERM", "lockstep"), ("SIGHUP", "lockstep"), ("SIGINT", "real")],
)
def test_a_signal_ends_a_run_in_order_and_the_next_one_the_process(name: str, clock: str) -> None:
    """From the first on, whichever it is, signals do what they do in any program."""
    number = signal.Signals[name]
    summary = fly(number=number, clock=clock)
    assert (summary.reason, summary.error) == (REASONS[number], None)
    assert Signalled.at_the_end == dict.fromkeys(REASONS, signal.SIG_DFL)


@pytest.mark.parametrize("fails", [False, True])
def test_after_a_run_signals_are_the_programs_again(
    fails: bool, handle: Callable[[signal.Signals, Any], object]
) -> None:
    numbers = [*REASONS, signal.SIGUSR2]
    for number in numbers:
        handle(number, of_the_program)
    if fails:
        with pytest.raises(NodeError, match="out of order"):
            fly(fails=True)
    else:
        fly(number=signal.SIGTERM)
    assert {signal.getsignal(number) for number in numbers} == {of_the_program}


def test_a_run_under_nohup_outlives_its_terminal(
    handle: Callable[[signal.Signals, Any], object],
) -> None:
    handle(signal.SIGHUP, signal.SIG_IGN)
    assert fly(number=signal.SIGHUP).reason == "duration"
    assert fly(number=signal.SIGTERM).reason == "SIGTERM"
    assert Signalled.at_the_end[signal.SIGHUP] is signal.SIG_IGN
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_a_run_that_a_shell_put_into_the_background_hears_ctrl_c(
    handle: Callable[[signal.Signals, Any], object],
) -> None:
    handle(signal.SIGINT, signal.SIG_IGN)
    assert fly(number=signal.SIGINT).reason == "Ctrl-C"
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_run_in_a_thread_leaves_signals_to_its_program(
    handle: Callable[[signal.Signals, Any], object],
) -> None:
    for number in REASONS:
        handle(number, of_the_program)
    thread = threading.Thread(target=fly)
    thread.start()
    thread.join()
    assert set(Signalled.at_the_end.values()) == {of_the_program}


class Blocking(Node):
    """Blocks the loop until the run interrupts it, as it does with a node beyond its limit."""

    async def run(self) -> None:
        signal.raise_signal(signal.SIGUSR2)  # which is not for this node: it goes on
        supervisor_of(self).state.interruption = NodeTimeoutError(
            self.name, "expected it to give back the loop"
        )
        try:
            signal.raise_signal(signal.SIGUSR2)
        finally:
            signal.raise_signal(signal.SIGUSR2)  # a late one, which interrupts nobody again


def test_a_node_that_blocks_the_loop_is_interrupted_once() -> None:
    with pytest.raises(NodeTimeoutError, match="node: expected it to give back the loop") as caught:
        fly(Blocking)
    assert caught.value.__context__ is None
