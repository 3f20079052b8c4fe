"""Snapshots of a run, and commands to it, on its own loop."""

from __future__ import annotations

import types
from collections.abc import Callable, Coroutine
from typing import Any
from unittest.mock import Mock

import pytest

from runtime import Duration
from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.tools.monitor import observer
from runtime.tools.monitor.estimators import Measured
from runtime.tools.monitor.observer import (
    KEPT,
    Amount,
    LastRecords,
    Meter,
    Observer,
    RecentSamples,
    Sample,
    describe,
)
from runtime.tools.monitor.protocol import COLUMNS, Pause, Restart, Set, Snapshot, Speed, Step, Stop
from tests.runtime.samples_loop import Camera, Estimator, Looked, Pilot, look

NODES = [
    spec(Camera, "drone"),
    spec(Estimator, "vo"),
    spec(Pilot, "pilot", links={"fly": {"loss": 1.0}}),
]

Script = Callable[[Supervisor, Observer], Coroutine[Any, Any, None]]


def observe(script: Script, **options: Any) -> Looked:
    async def body(supervisor: Supervisor) -> None:
        config = Config(run=RunConfig(name="sample"), nodes=tuple(NODES))
        await script(supervisor, Observer(supervisor, config, LastRecords()))

    return look(NODES, body, **options)


def row(snapshot: Snapshot, table: str, name: str) -> dict[str, str]:
    """Return the cells of a row by the titles of its table's columns."""
    assert {len(cells) for cells in snapshot.tables[table]} == {len(COLUMNS[table])}
    cells = {row_cells[0]: row_cells for row_cells in snapshot.tables[table]}[name]
    return dict(zip(COLUMNS[table], cells, strict=True))


def test_a_snapshot_tells_what_there_was_lately() -> None:
    taken: list[Snapshot] = []

    async def script(supervisor: Supervisor, observer: Observer) -> None:
        observer.begin()
        for _ in range(2):
            await supervisor.state.clock.sleep(0.35)
            taken.append(observer.snapshot())

    observe(script)
    first, second = taken
    assert (first.now, second.now) == (0.35, 0.7)
    assert first.headline.startswith("sample   0.350 s   ")
    assert first.headline.endswith(" × real time (as fast as it can)   runs")
    assert second.tables.keys() == COLUMNS.keys()
    images = ("drone.images", "Image", "7", "10.0", "0.08", "20.00", "20.00")
    assert tuple(row(second, "outputs", "drone.images").values()) == images
    assert row(second, "outputs", "vo.estimates")["latency ms"] == "30.00"
    drone = row(second, "nodes", "drone")
    assert drone["condition"] == "running"
    assert 0 <= float(drone["loop"].rstrip("%")) < 100
    assert 0 < float(drone["longest ms"]) < 1000
    assert second.tables["settings"] == [("pilot.gain", "1.0")]
    assert row(second, "inputs", "vo.images")["of"] == "1"
    assert second.tables["links"] == [("pilot.fly", "7", "0")]
    assert row(second, "ticks", "drone.expose")["Hz"] == "10"


def test_nobody_is_measured_before_the_beginning_and_after_the_end() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.2)
        before = observer.snapshot()
        observer.begin()
        observer.begin()
        await supervisor.state.clock.sleep(0.2)
        observer.end()
        await supervisor.state.clock.sleep(0.2)
        after = observer.snapshot()
        for snapshot in (before, after):
            assert row(snapshot, "nodes", "drone")["steps/s"] == "0"
            assert row(snapshot, "outputs", "drone.images")["latency ms"] == ""
        assert row(after, "outputs", "drone.images")["sent"] == "6"

    observe(script)


def test_looking_changes_nothing_of_what_is_said() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)
        observer.begin()
        observer.snapshot()

    async def nothing(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)

    assert observe(script).digest == observe(nothing).digest


def test_a_node_is_restarted_once_at_a_time() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.1)
        assert observer.execute(Restart(node="vo")) == "vo restarts"
        await supervisor.state.clock.sleep(0.1)
        assert row(observer.snapshot(), "nodes", "vo")["condition"].startswith("restarting")
        with pytest.raises(VisnavError, match="expected a node that runs, and vo is restarting"):
            observer.execute(Restart(node="vo"))
        with pytest.raises(VisnavError, match="found 'v0'"):
            observer.execute(Restart(node="v0"))
        await supervisor.state.clock.sleep(0.5)
        assert row(observer.snapshot(), "nodes", "vo")["condition"] == "running (1)"

    observe(script)


def test_commands_end_the_run_and_change_settings() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.1)
        assert observer.execute(Set(text="pilot.gain=2")) == "gain = 2.0"
        assert observer.execute(Set(text="pilot.gain=2")) == "as it was"
        observer.execute(Pause())
        paused = observer.snapshot()
        assert paused.paused
        assert paused.headline.endswith("   paused")
        observer.execute(Speed(factor=0.5))
        assert "(asked: 0.5)" in observer.snapshot().headline
        assert observer.snapshot().speed == 0.5
        assert observer.execute(Stop()) == "ends"
        assert observer.snapshot().ended == "stopped by hand"
        assert observer.snapshot().headline.endswith("   ends: stopped by hand")

    assert observe(script).supervisor.state.reason == "stopped by hand"
    assert describe(Step(seconds=0.5)) == "step 0.5"


def test_a_run_ends_in_order_though_time_stands() -> None:
    class Slow(Pilot):
        landed = False

        async def on_shutdown(self) -> None:
            await self.clock.sleep(0.5)
            Slow.landed = True

    async def body(supervisor: Supervisor) -> None:
        config = Config(
            run=RunConfig(name="sample", shutdown_limit=Duration(1)), nodes=tuple(NODES)
        )
        supervisor.state.config = config
        observer = Observer(supervisor, config, LastRecords())
        await supervisor.state.clock.sleep(0.1)
        observer.execute(Pause())
        observer.execute(Stop())

    assert (
        look([*NODES[:2], spec(Slow, "pilot")], body).supervisor.state.reason == "stopped by hand"
    )
    assert Slow.landed


@pytest.mark.parametrize("command", [Pause(), Step(), Speed(factor=2.0)])
def test_real_time_takes_no_orders(command: Any) -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        with pytest.raises(VisnavError, match="in real time, which cannot be stopped"):
            observer.execute(command)
        assert "sensors do not wait" in observer.snapshot().fixed

    observe(script, clock="real", duration=0.02)


def sample(n: int) -> Sample:
    """Return what is known at the n-th fifth of a second: time goes twice as fast as real time."""
    return Sample(
        n / 5,
        n * 10**9 * 2 // 5,
        {"a.out": n * n},
        {"a": Amount(1, 10 * n, 10 * n), "a.out": Amount(2, n, n)},
    )


def test_it_spans_the_last_samples_and_adds_up_what_lies_between() -> None:
    recent = RecentSamples(sample(0))
    for n in range(1, 11):
        recent.add(sample(n))
    assert KEPT == 5
    assert recent.real == pytest.approx(1.0)
    assert recent.run == 2.0
    assert recent.rate("a.out") == (100 - 25) / 2
    assert recent.amount("a") == Amount(5, 10 * (6 + 7 + 8 + 9 + 10), 100)
    assert recent.amount("a.out") == Amount(10, 40, 10)


def test_there_is_nothing_before_the_second_sample_and_of_strangers() -> None:
    recent = RecentSamples(sample(3))
    assert (recent.run, recent.rate("a.out"), recent.amount("a")) == (0.0, 0.0, Amount())
    recent.add(sample(4))
    assert (recent.amount("b"), recent.rate("b.out")) == (Amount(), 0.0)


def test_a_step_counts_without_those_within_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0]

    def work(ns: int) -> None:
        now[0] += ns

    monkeypatch.setattr(observer, "time", types.SimpleNamespace(perf_counter_ns=lambda: now[0]))
    loop = LockstepLoop()
    try:
        meter = Meter(LockstepClock(loop), Measured(Mock()))

        def fail(_: Any) -> None:
            work(5)
            raise RuntimeError

        inner = meter.wrap_call("b", "hear", work)
        failing = meter.wrap_call("c", "hear", fail)

        def outer(_: Any) -> None:
            work(10)
            inner(100)
            inner(200)
            with pytest.raises(RuntimeError):
                failing(None)
            work(20)

        meter.wrap_call("a", "tick", outer)(None)
        meter.wrap_call("a", "tick", work)(7)
    finally:
        loop.close()
    assert meter.pop_amounts() == {
        "a": Amount(2, 37, 30),
        "b": Amount(2, 300, 200),
        "c": Amount(1, 5, 5),
    }
    assert meter.pop_amounts() == {}
