"""What nodes ask a run for: tasks, ticks, threads, workers, and entries of its summary."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

from runtime import Duration, Input, Node, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError, WorkerDiedError
from runtime.host import Sibling
from runtime.run.execute import execute
from runtime.run.instruments import Instrument
from runtime.run.node_services import siblings
from runtime.summary import Summary
from runtime.testing import spec
from runtime.time.clock import Ticker
from tests.runtime.samples import Ping, Speaker
from tests.runtime.samples_loop import look
from tests.runtime.samples_runs import supervise, supervisor_of
from tests.runtime.samples_workers import Plant, plain

pytestmark = pytest.mark.timeout(20)


def summary_of(node: type[Node[Any]]) -> Summary:
    run = RunConfig(duration=Duration(1))
    return execute(Config(run=run, nodes=(spec(node, "node"),)))


def test_what_is_noted_and_concluded_stands_in_the_summary() -> None:
    class Notes(Node):
        async def run(self) -> None:
            facts = {"bias": 0.5}
            self.note_truth("drone/imu", facts)
            facts["bias"] = 99.0  # it is written as it was noted
            self.note_environment("renderer", "software")
            self.conclude("vo", {"ate_rmse_m": 0.25})
            self.conclude("drone", {"collisions": 1}, passed=False, flight=True)

    summary = summary_of(Notes)
    assert summary.truth == {"drone/imu": {"bias": 0.5}}
    assert summary.environment["renderer"] == "software"
    assert summary.verdict is not None
    assert summary.verdict.estimators == {"vo": {"passed": True, "ate_rmse_m": 0.25}}
    assert summary.verdict.flights == {"drone": {"passed": False, "collisions": 1}}


class Ticking(Node):
    """Has ticks of its own from a phase on."""

    phase: ClassVar[str] = "on_startup"
    fails: ClassVar[bool] = False
    ticks: ClassVar[list[float]] = []

    async def on_startup(self) -> None:
        self.tick_from("on_startup")

    async def on_ready(self) -> None:
        self.tick_from("on_ready")

    async def run(self) -> None:
        await self.clock.sleep(0.125)
        self.tick_from("run")
        await self.clock.sleep(0.125)
        if self.fails and not self.restarts:
            raise RuntimeError("out of order")

    def tick_from(self, phase: str) -> None:
        if phase == self.phase:
            self.every(2, self.note, "note")

    def note(self, tick: Tick) -> None:
        self.ticks.append(tick.stamp / 1e9)


@pytest.mark.parametrize("phase", ["on_startup", "on_ready", "run"])
@pytest.mark.parametrize("fails", [False, True])
def test_ticks_begin_with_the_update_of_their_node(
    phase: str, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once each, whenever they are asked for; so they do after a restart."""
    monkeypatch.setattr(Ticking, "phase", phase)
    monkeypatch.setattr(Ticking, "fails", fails)
    Ticking.ticks.clear()
    supervise([spec(Ticking, "t", on_error="restart")], duration=1.6)
    first = 0.125 if phase == "run" else 0.0
    again = 0.75 + first  # half a second after the failure
    expected = [first, again, again + 0.5] if fails else [first + 0.5 * k for k in range(4)]
    assert Ticking.ticks == [stamp for stamp in expected if stamp < 1.6]


def test_tickers_of_a_name_are_told_apart_and_a_stopped_one_leaves_its_own() -> None:
    class Several(Node):
        tickers: ClassVar[list[Ticker]] = []

        async def run(self) -> None:
            self.tickers[:] = [self.every(hz, self.look) for hz in (1, 2, 4)]
            self.tickers[1].stopped = True
            self.tickers.append(self.every(8, self.look))

        def look(self, tick: Tick) -> None: ...

    ticks = summary_of(Several).ticks
    assert [ticker.name for ticker in Several.tickers] == [
        *("node.look", "node.look_2", "node.look_3", "node.look_2"),
    ]
    assert {name: summary.hz for name, summary in ticks.items()} == {
        "node.look": 1,
        "node.look_2": 8,
        "node.look_3": 4,
    }


def test_a_tick_during_a_coroutine_tick_is_missed_and_counted() -> None:
    class Slow(Node):
        served: ClassVar[list[int]] = []

        @every(hz=4)
        async def work(self, tick: Tick) -> None:
            self.served.append(tick.index)
            await self.clock.sleep(0.3)

    ticks = summary_of(Slow).ticks["node.work"]
    assert Slow.served == [0, 2]
    assert ticks.missed == 2


def test_what_a_coroutine_tick_raises_is_its_nodes_fault() -> None:
    class Weak(Node):
        @every(hz=4)
        async def work(self, tick: Tick) -> None:
            raise LookupError("no wires")

    with pytest.raises(NodeError, match="node: LookupError: no wires"):
        summary_of(Weak)


class Busy(Node):
    """Gives threads more to do than they can begin, until the run is over."""

    release: ClassVar[threading.Event]
    begun: ClassVar[list[str]] = []
    full: ClassVar[threading.Event]

    async def run(self) -> None:
        for _ in range(12):
            self.start(self.work())
        await asyncio.to_thread(self.full.wait, 10)
        self.stop("enough")

    async def work(self) -> None:
        await self.offload(self.wait)

    def wait(self) -> None:
        self.begun.append(threading.current_thread().name)
        if len(self.begun) == 8:
            self.full.set()
        self.release.wait(10)


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_run_ends_without_waiting_for_threads_and_begins_no_more_work(clock: str) -> None:
    """Eight calls are under way; the command line knows their threads by name."""
    Busy.release, Busy.full = threading.Event(), threading.Event()
    Busy.begun.clear()
    outcome = supervise([spec(Busy, "busy")], clock=clock, shutdown_limit=0.01)
    still_waiting = [t for t in threading.enumerate() if t.name in Busy.begun]
    Busy.release.set()
    assert outcome.reason == "enough"
    assert len(still_waiting) == 8
    for thread in still_waiting:
        assert thread.name.startswith("offload")
        thread.join(10)
    assert len(Busy.begun) == 8


def test_tasks_that_have_ended_are_kept_no_longer() -> None:
    class Starts(Node):
        left: ClassVar[list[int]] = []

        async def run(self) -> None:
            for _ in range(10):
                self.start(self.beside())
            runner = supervisor_of(self).state.runners["s"]
            self.left.append(len(runner.tasks))
            await self.clock.sleep(0.5)
            self.left.append(len(runner.tasks))

        async def beside(self) -> None:
            await asyncio.sleep(0)

    supervise([spec(Starts, "s")])
    assert Starts.left == [11, 1]  # with `run` itself


class Steps(Instrument):
    """Notes whose steps it sees."""

    def __init__(self) -> None:
        self.seen: set[str] = set()

    def wrap_call(self, node: str, what: str, call: Callable[[Any], Any]) -> Callable[[Any], Any]:
        self.seen.add(f"{node}.{what}")
        return call


def test_an_instrument_sees_what_is_started_later_by_its_own_name() -> None:
    steps = Steps()

    class Later(Node):
        async def run(self) -> None:
            supervisor_of(self).instruments.attach(steps)
            self.start(self.beside())
            self.every(1, self.look)

        async def beside(self) -> None: ...

        def look(self, tick: Tick) -> None: ...

    look([spec(Later, "later")])
    assert {"later.beside", "later.look"} <= steps.seen


class FakeWorker:
    """Stands for a worker's process."""

    made: ClassVar[list[FakeWorker]] = []

    def __init__(self, name: str, *_: object, **options: Any) -> None:
        self.name, self.options = name, options
        self.is_ready = self.closed = False
        self.called: Any = None
        self.made.append(self)

    async def ready(self) -> None:
        self.is_ready = True

    def close(self) -> None:
        self.closed = True


class Gardener(Node):
    """Has a worker, whatever makes it."""

    factory: ClassVar[Any] = Plant
    does: ClassVar[Callable[[Any, Any], object]] = lambda _node, _worker: None

    async def run(self) -> None:
        make: Any = FakeWorker
        supervisor_of(self).services.make_worker = make
        worker: Any = await self.worker(type(self).factory, latency=0.25)
        assert worker is FakeWorker.made[-1]
        assert FakeWorker.made[-1].is_ready
        type(self).does(self, worker)


def with_worker(
    monkeypatch: pytest.MonkeyPatch, does: Callable[[Any, Any], object], factory: Any = Plant
) -> FakeWorker:
    monkeypatch.setattr(Gardener, "does", does)
    monkeypatch.setattr(Gardener, "factory", factory)
    FakeWorker.made.clear()
    look([spec(Gardener, "g")])
    (worker,) = FakeWorker.made
    return worker


class Nameless:
    """A factory that is an object."""

    def __call__(self) -> Plant:
        return Plant()


@pytest.mark.parametrize(
    ("factory", "name"), [(Plant, "Plant"), (plain, "plain"), (Nameless(), "worker")]
)
def test_a_worker_is_named_by_its_node_and_class_and_ends_with_the_node(
    factory: Any,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    worker = with_worker(monkeypatch, lambda _, w: w.options["printed"]("a leaf"), factory)
    assert (worker.name, worker.closed, worker.options["latency"]) == (f"g.{name}", True, 0.25)
    assert [(r.name, r.getMessage()) for r in caplog.records] == [("visnav.g", f"{name}: a leaf")]


def test_a_worker_that_dies_is_its_nodes_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NodeError, match=r"g: worker g\.Plant: killed by signal 9"):
        with_worker(
            monkeypatch,
            lambda _, w: w.options["died"](WorkerDiedError("worker g.Plant: killed by signal 9")),
        )


def test_an_instrument_looks_at_workers_that_come_later(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    class Eye(Instrument):
        def worker_called(self, process: str, method: str, answer: Any) -> None:
            seen.append(f"{process}: {method}")

    class Watched(Gardener):
        async def run(self) -> None:
            supervisor_of(self).instruments.attach(Eye())
            await super().run()

    monkeypatch.setattr(Gardener, "does", lambda _, w: w.called("g.Plant", "pid", None))
    look([spec(Watched, "g")])
    assert seen == ["g.Plant: pid"]


def test_the_costs_of_a_worker_are_added_up_over_restarts() -> None:
    class Restarts(Gardener):
        async def run(self) -> None:
            await super().run()
            if not self.restarts:
                raise RuntimeError("out of order")

    FakeWorker.made.clear()
    supervise([spec(Restarts, "g", on_error="restart")])
    first, second = FakeWorker.made
    assert first.options["costs"] is second.options["costs"]
    assert first.closed


class Odd(Node):
    """Ends its own work in a way that asyncio would pass over."""

    raises: ClassVar[BaseException] = RuntimeError()

    async def run(self) -> None:
        self.start(self.beside())
        await self.clock.sleep(3600)

    async def beside(self) -> None:
        raise self.raises


@pytest.mark.parametrize(
    ("raises", "said"),
    [
        (asyncio.CancelledError("off"), "o: CancelledError: off"),
        (GeneratorExit("gone"), "o: GeneratorExit: gone"),
        (LookupError("no wires"), "o: LookupError: no wires"),
    ],
)
def test_whatever_a_task_raises_is_its_nodes_fault(
    raises: BaseException, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Odd, "raises", raises)
    outcome = supervise([spec(Odd, "o")], duration=7200)
    assert (str(outcome.error), outcome.reason, outcome.seconds) == (said, "o failed", 0.0)


class Leaves(Node):
    """Fails while its work is cancelled."""

    async def run(self) -> None:
        try:
            await self.clock.sleep(3600)
        finally:
            raise LookupError("cannot tidy up")

    async def on_shutdown(self) -> None:
        self.log.info("down")


def test_an_error_while_a_node_is_cancelled_is_the_runs_error() -> None:
    outcome = supervise([spec(Leaves, "l")])
    assert (str(outcome.error), outcome.reason) == ("l: LookupError: cannot tidy up", "duration")


def test_a_node_that_has_nothing_to_read_may_return(caplog: pytest.LogCaptureFixture) -> None:
    class Brief(Node):
        async def run(self) -> None: ...

    supervise([spec(Brief, "b")])
    assert caplog.messages == []


@pytest.mark.parametrize("how", ["stop", "end", "restart"])
def test_a_node_that_returns_as_it_is_to_end_is_no_surprise(
    how: str, caplog: pytest.LogCaptureFixture
) -> None:
    class Obedient(Node):
        pings = Input(Ping)

        async def run(self) -> None:
            if how == "stop":
                self.stop("enough")
                return
            if how == "restart" and not self.restarts:
                self.start(self.fail())
            try:
                await self.clock.sleep(3600)
            except asyncio.CancelledError:
                return

        async def fail(self) -> None:
            raise RuntimeError("out of order")

    supervise([spec(Obedient, "o", on_error="restart")])
    assert not [message for message in caplog.messages if "nobody reads" in message]


def test_siblings_say_which_of_them_are_here() -> None:
    nodes = (spec(Speaker, "a"), spec(Speaker, "b"))
    config = Config(run=RunConfig(), nodes=nodes)
    expected = (
        Sibling("a", Speaker, nodes[0].config, {}, True),
        Sibling("b", Speaker, nodes[1].config, {}, False),
    )
    assert siblings(config, {"a"}) == expected
