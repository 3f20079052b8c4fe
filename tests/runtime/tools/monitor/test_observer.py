"""Snapshots of a run, and commands to it, on its own loop."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from runtime import Duration
from runtime.config.model import Config, RunConfig
from runtime.errors import VisnavError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.tools.monitor.command import Pause, Restart, Set, Speed, Step, Stop
from runtime.tools.monitor.observer import LastRecords, Observer, describe
from runtime.tools.monitor.snapshot import Snapshot
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


def node(snapshot: Snapshot, name: str) -> Any:
    return next(n for n in snapshot.nodes if n.name == name)


def output(snapshot: Snapshot, name: str) -> Any:
    return next(o for o in snapshot.outputs if o.name == name)


def test_a_snapshot_tells_what_there_was_lately() -> None:
    taken: list[Snapshot] = []

    async def script(supervisor: Supervisor, observer: Observer) -> None:
        observer.begin()
        for _ in range(2):
            await supervisor.state.clock.sleep(0.35)
            taken.append(observer.take())

    observe(script)
    first, second = taken
    assert (first.number, second.number) == (1, 2)
    assert (first.run, first.clock.kind, first.clock.now) == ("sample", "lockstep", 0.35)
    images = output(second, "drone.images")
    assert (images.event, images.count) == ("Image", 7)
    assert images.rate == pytest.approx(10.0)
    assert images.age == pytest.approx(0.08)
    assert (images.latency_ms, images.latency_max_ms) == (20.0, 20.0)
    assert output(second, "vo.estimates").latency_ms == 30.0
    drone = node(second, "drone")
    assert drone.condition == "running"
    assert 0 < drone.share < 1
    assert 0 < drone.longest_ms < 1000
    assert node(second, "pilot").settings == {"gain": "1.0"}
    assert [(i.name, i.bound) for i in second.inputs] == [("vo.images", 1)]
    assert [(each.name, each.lost) for each in second.links] == [("pilot.fly", 7)]
    assert [(t.name, t.hz) for t in second.ticks] == [("drone.expose", 10.0)]


def test_nobody_is_measured_before_the_beginning_and_after_the_end() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.2)
        before = observer.take()
        observer.begin()
        observer.begin()
        await supervisor.state.clock.sleep(0.2)
        observer.end()
        await supervisor.state.clock.sleep(0.2)
        after = observer.take()
        for snapshot in (before, after):
            assert node(snapshot, "drone").steps == 0
            assert output(snapshot, "drone.images").latency_ms is None
        assert output(after, "drone.images").count == 6

    observe(script)


def test_looking_changes_nothing_of_what_is_said() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)
        observer.begin()
        observer.take()

    async def nothing(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.25)

    assert observe(script).digest == observe(nothing).digest


def test_a_node_is_restarted_once_at_a_time() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.1)
        assert observer.execute(Restart(node="vo")) == "vo restarts"
        await supervisor.state.clock.sleep(0.1)
        assert node(observer.take(), "vo").condition == "restarting"
        with pytest.raises(VisnavError, match="expected a node that runs, and vo is restarting"):
            observer.execute(Restart(node="vo"))
        with pytest.raises(VisnavError, match="found 'v0'"):
            observer.execute(Restart(node="v0"))
        await supervisor.state.clock.sleep(0.5)
        found = node(observer.take(), "vo")
        assert (found.condition, found.failures) == ("running", 1)

    observe(script)


def test_commands_end_the_run_and_change_settings() -> None:
    async def script(supervisor: Supervisor, observer: Observer) -> None:
        await supervisor.state.clock.sleep(0.1)
        assert observer.execute(Set(text="pilot.gain=2")) == "gain = 2.0"
        assert observer.execute(Set(text="pilot.gain=2")) == "as it was"
        assert observer.execute(Stop()) == "ends"
        assert observer.take().ended == "stopped by hand"

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
        assert "sensors do not wait" in observer.take().clock.fixed

    observe(script, clock="real", duration=0.02)
