"""A run from its settings to its end: its log, its loop and clock, and what escapes the loop."""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from events import Event, Image, PoseEstimate, TrajectoryEstimate
from runtime import Duration, Node, Output, every
from runtime.config.model import Config, RunConfig
from runtime.config.reading import parse
from runtime.errors import NodeError, PeerError, VisnavError
from runtime.run import execute as execution
from runtime.run.execute import code_of_estimators, execute, make_clock, make_loop
from runtime.run.others import Others
from runtime.summary import Stall, Summary
from runtime.testing import spec
from runtime.time.clock import Tick
from runtime.time.lockstep import LockstepClock, LockstepLoop
from tests.runtime.samples_logs import Lines


class Sample(Event):
    """Event with a value of each kind."""

    image: npt.NDArray[np.uint8]
    position: tuple[float, float]
    height: float
    text: str


class Sensor(Node):
    """Sends one sample a second."""

    samples = Output(Sample)

    @every(hz=1)
    def measure(self, tick: Tick) -> None:
        image = np.zeros((2, 3), np.uint8)
        self.samples.send(
            Sample(
                stamp=tick.stamp,
                source="sensor/a",
                image=image,
                position=(1.23456, -2.0),
                height=1.23456789,
                text="up",
            )
        )


def table(node: str, **run: Any) -> dict[str, Any]:
    return {"run": {"duration": 0.5} | run, "nodes": [{"name": "sensor", "type": node}]}


def messages(
    out: Path | None = None, node: str = f"{__name__}:Sensor", **options: Any
) -> list[str]:
    lines = Lines()
    execute(parse(table(node), "c.toml"), out, handlers=[lines], **options)
    return lines.messages


def test_events_are_logged_with_sender_values_and_shapes() -> None:
    line = (
        "sensor.samples Sample sensor/a: image=uint8[2, 3] position=(1.235, -2) height=1.23457 "
        "text='up'"
    )
    assert line in messages(log_events=True)
    assert line not in messages()


def test_announcements_are_logged_as_such() -> None:
    logged = messages(node="tests.runtime.samples:Diarist", log_events=True)
    assert any(line.startswith("announced Offer sensor:") for line in logged)


def test_an_error_that_ends_a_run_is_logged(tmp_path: Path) -> None:
    lines = Lines()
    config = parse(table("tests.runtime.samples:Failing", duration=2.0), "c.toml")
    with pytest.raises(VisnavError) as caught:
        execute(config, tmp_path / "run", handlers=[lines])
    assert any(str(caught.value) in line for line in lines.messages)


def test_the_folder_of_an_earlier_run_is_named(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert not any("earlier run" in line for line in messages(out))
    moved = [line for line in messages(out) if "the folder of the earlier run is now" in line]
    assert len(moved) == 1
    assert Path(moved[0].rpartition(" ")[2]).is_dir()
    first = (out / "log.txt").read_text().splitlines()[0]  # before there is a clock
    assert first.startswith("    0.000000 INFO     runtime: the folder of the earlier run is now ")


@pytest.mark.parametrize(("speed", "pace"), [(None, 0.0), ("max", 0.0), (4.0, 0.25e-9)])
def test_lockstep_has_the_pace_of_the_file(speed: float | str | None, pace: float) -> None:
    run = {} if speed is None else {"speed": speed}
    loop = make_loop(parse(table(f"{__name__}:Sensor", **run), "c.toml").run)
    try:
        assert isinstance(loop, LockstepLoop)
        assert loop._pace == pytest.approx(pace)
    finally:
        loop.close()


@pytest.mark.parametrize(("speed", "pace"), [(None, 1.0), (4.0, 4.0)])
def test_real_time_has_the_pace_of_the_file(speed: float | None, pace: float) -> None:
    run = RunConfig(clock="real", speed=speed)
    loop = make_loop(run)
    clock = make_clock(run, loop)
    try:
        assert (clock.kind, vars(clock)["speed"]) == ("real", pace)
    finally:
        clock.close()
        loop.close()


def test_lockstep_has_a_clock_that_jumps() -> None:
    loop = make_loop(RunConfig())
    try:
        assert isinstance(make_clock(RunConfig(), loop), LockstepClock)
    finally:
        loop.close()


def fly(*nodes: type[Node[Any]], lines: Lines | None = None, **run: Any) -> Summary:
    """Run nodes, called a, b and so on, without results."""
    settings = RunConfig(**{"duration": Duration(0.5)} | run)
    specs = tuple(spec(node, name) for node, name in zip(nodes, "abc", strict=False))
    return execute(Config(run=settings, nodes=specs), handlers=[lines] if lines else None)


@pytest.mark.parametrize(
    ("clock", "digest", "has"),
    [("lockstep", None, True), ("lockstep", False, False), ("real", True, True)],
)
def test_a_digest_is_usual_in_simulated_time(clock: str, digest: bool | None, has: bool) -> None:
    summary = fly(Ends, clock=clock, digest=digest)
    assert (summary.digest is not None) == has


def test_a_digest_costs_nothing_in_real_time_unless_wanted() -> None:
    assert fly(Ends, clock="real").digest is None


class Ends(Node):
    """Ends the run as it begins, in a way of its own."""

    end: ClassVar[Callable[[Any], object]] = lambda node: node.stop("enough")

    async def run(self) -> None:
        self.end()
        await self.clock.sleep(3600.0)


def ends_by(end: Callable[[Any], object]) -> type[Node[Any]]:
    return type("EndsSomehow", (Ends,), {"end": end})


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_callback_that_leaves_the_loop_is_its_nodes_fault(clock: str) -> None:
    def leave(node: Any) -> None:
        def call() -> None:
            assert node  # so that the frame is the node's
            sys.exit(3)

        asyncio.get_running_loop().call_soon(call)

    with pytest.raises(NodeError, match=r"SystemExit: 3 \(expected self.stop\(reason\)"):
        fly(ends_by(leave), clock=clock)


def test_ctrl_c_before_there_is_anything_to_end_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(run: RunConfig) -> asyncio.AbstractEventLoop:
        loop = make_loop(run)
        loop.call_soon(signal.default_int_handler, signal.SIGINT, None)
        return loop

    monkeypatch.setattr(execution, "make_loop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fly(Ends)


def test_the_loop_is_the_runs_and_no_node_cancels_what_is_not_its_own() -> None:
    def cancel(_: Any) -> None:
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()

    with pytest.raises(NodeError, match="a: expected it to cancel no tasks but its own"):
        fly(ends_by(cancel))


class Watchdog:
    """Sees a stall as soon as it is started, as a watchdog may."""

    stops: ClassVar[int] = 0

    def __init__(self, _: object, limit: float, report: Callable[[Stall], None]) -> None:
        self.stalls = {"vo": 1}
        self.longest = {"vo": Stall("vo", "vo.py:7 in track", limit)}
        self._report = report

    def start(self) -> None:
        self._report(self.longest["vo"])

    def stop(self) -> None:
        Watchdog.stops += 1


@pytest.mark.parametrize(("clock", "level"), [("real", "WARNING"), ("lockstep", "DEBUG")])
def test_a_stall_is_logged_as_it_happens(
    clock: str, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its milliseconds, its node and line; in simulated time it only makes the run longer."""
    monkeypatch.setattr(execution, "LoopWatchdog", Watchdog)
    monkeypatch.setattr(Watchdog, "stops", 0)
    lines = Lines()
    summary = fly(Ends, lines=lines, clock=clock, stall=Duration(2.5), log="debug")
    (stall,) = [record for record in lines.records if "the loop stood" in record.getMessage()]
    assert stall.levelname == level
    assert stall.getMessage() == "the loop stood for 2500 ms: vo, vo.py:7 in track"
    assert summary.stalls["vo"] == 1
    assert Watchdog.stops == 1


def open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_a_run_leaves_no_file_open() -> None:
    fly(Ends, clock="real")
    before = open_files()
    fly(Ends, clock="real")
    assert open_files() == before


def test_slow_work_is_in_threads_that_the_command_line_may_leave_behind() -> None:
    names = []

    class Slow(Ends):
        async def run(self) -> None:
            names.append(await asyncio.to_thread(lambda: threading.current_thread().name))
            self.stop("enough")

    fly(Slow, clock="real")
    assert names[0].startswith("node")


class Camera(Node):
    images = Output(Image)


class Odometry(Node):
    images = Output(Image)
    estimates = Output(PoseEstimate)


class Mapping(Node):
    trajectories = Output(TrajectoryEstimate)


@pytest.mark.parametrize(
    ("only", "hashed"),
    [([], {"b", "c"}), (["a", "b"], {"b"}), (["a"], set()), (["c"], {"c"})],
)
def test_the_code_is_hashed_of_what_estimates_here(only: list[str], hashed: set[str]) -> None:
    nodes = (spec(Camera, "a"), spec(Odometry, "b"), spec(Mapping, "c"))
    assert code_of_estimators(Config(run=RunConfig(), nodes=nodes), only).keys() == hashed


def test_processes_that_do_not_leave_together_are_an_error_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def leave(_: Others, summary: Summary) -> Summary:
        raise PeerError("expected a summary from two, found none")

    monkeypatch.setattr(Others, "leave", leave)
    config = Config(run=RunConfig(), nodes=(spec(Ends, "a"),))
    said = "the other processes: expected a summary from two, found none"
    with pytest.raises(NodeError, match=said):
        execute(config, tmp_path)
    assert f'"{said}"' in (tmp_path / "summary.json").read_text()
