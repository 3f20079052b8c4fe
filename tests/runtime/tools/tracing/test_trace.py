"""A trace of a whole small run."""

from __future__ import annotations

import gzip
import itertools
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from events import PoseEstimate
from runtime import on
from runtime.errors import ConfigError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from runtime.tools.cli.run import tables
from runtime.tools.tracing import write
from runtime.tools.tracing.record import Spool
from runtime.tools.tracing.write import (
    LOOP,
    SENSORS,
    THREADS,
    Trace,
    TraceEvent,
    node_loads,
    paths,
    quantile,
    read_trace,
    tracing,
)
from tests.runtime.samples_loop import (
    Camera,
    Estimator,
    Looked,
    Pilot,
    SteadyPilot,
    look,
    until_sent,
)

NODES = [spec(Camera, "drone"), spec(Estimator, "vo"), spec(Pilot, "pilot")]
STEADY = [*NODES[:2], spec(SteadyPilot, "pilot")]


def traced(path: Path, nodes: Any = NODES, **options: Any) -> tuple[Trace, Looked]:
    looked = look(nodes, watch=lambda supervisor: tracing(supervisor, path, "loop"), **options)
    assert not list(path.parent.glob("*.part"))
    return read_trace(path), looked


def test_a_path_from_the_exposure_to_the_set_point_takes_what_it_takes(tmp_path: Path) -> None:
    trace, _ = traced(tmp_path / "t.json")
    (route,) = paths(trace)
    assert route.path == "drone/front Image → vo PoseEstimate → pilot VelocitySetpoint"
    assert route.run_ms == [30.0] * 10
    assert all(0 < ms < 1000 for ms in route.real_ms)
    assert trace.about["clock"] == "lockstep"


def test_a_pilot_at_a_rate_of_its_own_holds_the_newest_estimate(tmp_path: Path) -> None:
    trace, _ = traced(tmp_path / "t.json", STEADY)
    (route,) = paths(trace)
    assert route.path == "drone/front Image → vo PoseEstimate ⇢ pilot VelocitySetpoint"
    assert route.run_ms[:4] == [50.0, 100.0, 50.0, 100.0]


def test_slices_nest_on_every_track_and_arrows_begin_and_end_in_slices(tmp_path: Path) -> None:
    trace, _ = traced(tmp_path / "t.json.gz")
    tracks: dict[tuple[int, int], list[TraceEvent]] = defaultdict(list)
    for event in trace.events:
        if event.ph == "X":
            tracks[event.pid, event.tid].append(event)
    for slices in tracks.values():
        open_: list[TraceEvent] = []
        for span in sorted(slices, key=lambda e: (e.ts, -e.dur)):
            while open_ and open_[-1].ts + open_[-1].dur <= span.ts:
                open_.pop()
            assert not open_ or span.ts + span.dur <= open_[-1].ts + open_[-1].dur + 1e-3
            open_.append(span)
    arrows = [event for event in trace.events if event.ph in "stf"]
    assert [a.ph for a in arrows] == ["s", "t", "t", "f"] * 10
    assert all(a.ts <= b.ts for a, b in itertools.pairwise(arrows) if b.ph != "s")
    for arrow in arrows:
        assert any(e.ts <= arrow.ts <= e.ts + e.dur for e in tracks[arrow.pid, arrow.tid])


def test_all_that_a_node_did_has_its_place(tmp_path: Path) -> None:
    trace, _ = traced(tmp_path / "t.json")
    names = defaultdict(set)
    titles = {e.tid: e.args["name"] for e in trace.events if e.name == "thread_name"}
    for event in trace.events:
        if event.ph == "X":
            names[event.pid, titles[event.tid]].add(event.name)
    assert names[LOOP, "drone"] == {"expose", "deliver", "send Image"}
    assert names[LOOP, "vo"] == {"run", "send PoseEstimate"}
    assert names[LOOP, "pilot"] == {"fly", "send VelocitySetpoint"}
    assert names[SENSORS, "drone/front"] == {"Image exposed"}
    offloaded = [n for (pid, _), spans in names.items() if pid == THREADS for n in spans]
    assert set(offloaded) == {"vo: mean"}
    assert [share.node for share in node_loads(trace)].count("vo") == 1


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_run_that_is_traced_says_the_same(tmp_path: Path, clock: str) -> None:
    async def body(supervisor: Supervisor) -> None:
        await until_sent(supervisor, "pilot", 2)
        supervisor.stop("seen enough")

    trace, looked = traced(tmp_path / "t.json", body=body, clock=clock, duration=60)
    told = [e.name.removeprefix("send ") for e in trace.events if e.name.startswith("send ")]
    assert told == [type(event).__name__ for event in looked.sent]
    if clock == "lockstep":
        assert looked.digest == look(NODES, body, duration=60).digest
    (route,) = paths(trace)
    assert min(route.run_ms) >= 30.0
    if clock == "real":  # the two clocks are one
        assert route.real_ms == pytest.approx(route.run_ms, abs=0.5)


def test_an_error_in_a_traced_node_is_that_nodes(tmp_path: Path) -> None:
    class Broken(Pilot):
        @on(PoseEstimate)
        def fly(self, estimate: PoseEstimate) -> None:
            raise RuntimeError("out of order")

    with pytest.raises(Exception, match="pilot: RuntimeError: out of order"):
        traced(tmp_path / "t.json", [*NODES[:2], spec(Broken, "pilot")])
    assert read_trace(tmp_path / "t.json").events


def test_a_trace_without_a_place_is_refused_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="expected a place for a trace, found: "):
        traced(tmp_path / "file" / "t.json")


@pytest.mark.parametrize("name", [".", "/", ".."])
def test_a_folder_is_no_place_for_a_trace(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="expected the name of a file for a trace"):
        traced(tmp_path / name)


@pytest.mark.parametrize("when", ["in the run", "after it"])
def test_a_full_disk_costs_the_trace_and_not_the_run(
    tmp_path: Path, when: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    if when == "in the run":
        monkeypatch.setattr(Spool, "_append", full)
    else:
        monkeypatch.setattr(write._Writer, "_step", full)
    looked = look(NODES, watch=lambda s: tracing(s, tmp_path / "t.json", "loop"))
    assert looked.supervisor.state.reason == "duration"
    assert list(tmp_path.iterdir()) == []
    assert "No space left on device" in caplog.text


def test_time_in_a_trace_begins_before_all_that_is_in_it(tmp_path: Path) -> None:
    notes = Spool(tmp_path / "notes")
    begin = notes.origin
    late = 123_456_789_000_000_000  # of an announcement that bears the time of day, say
    announced = ("event", begin + 5_000, 0, None, PoseEstimate, "a", late, 7_000_000, 0, None)
    notes.add([announced, ("step", "a", "run", begin + 2_000, begin + 9_000, 0, 0)])
    notes.close()
    write.write_trace(notes, tmp_path / "t.json", name="x", clock="lockstep", nodes=["a"])
    assert [e.ts for e in read_trace(tmp_path / "t.json").events if e.ph == "X"] == [5.0, 2.0]


def test_a_terminal_without_arrows_gets_others(tmp_path: Path) -> None:
    trace, _ = traced(tmp_path / "t.json", STEADY)
    shown = str(next(tables(trace, "latin-1")))
    assert shown == "path 1: drone/front Image -> vo PoseEstimate ~> pilot VelocitySetpoint"


def test_shares_leave_out_what_a_step_called_in_others() -> None:
    def slice_(tid: int, name: str, ts: float, dur: float) -> TraceEvent:
        return TraceEvent(ph="X", pid=LOOP, tid=tid, name=name, ts=ts, dur=dur)

    named = [
        TraceEvent(ph="M", pid=LOOP, tid=n, name="thread_name", args={"name": name})
        for n, name in enumerate(("a", "b"))
    ]
    slices = [slice_(1, "hear", 20, 30), slice_(0, "tick", 0, 60), slice_(0, "tick", 90, 10)]
    first, second = node_loads(Trace(events=[*named, *slices]))
    assert (first.node, first.steps, first.busy_ms, first.share) == ("a", 2, 0.04, 0.4)
    assert (second.node, second.longest_ms, second.longest) == ("b", 0.03, "hear")


def test_quantiles_are_values_that_there_were() -> None:
    assert quantile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert quantile([5.0], 0.99) == 5.0


def test_what_is_no_trace_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a trace, found: No such file"):
        read_trace(tmp_path / "none")
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"a": 1}))
    with pytest.raises(ConfigError, match="expected a trace, found"):
        read_trace(other)
    whole = gzip.compress(b'{"traceEvents":[]}', mtime=0)
    for broken in (b"\x1f\x8bnonsense", whole[:-9], whole[:12] + b"\xff" * 9, b"[" * 100_000):
        other.write_bytes(broken)
        with pytest.raises(ConfigError, match="expected a trace, found"):
            read_trace(other)
    other.write_text('{"traceEvents":[{"ph":"X","pid":1,"tid":1,"name":"x","args":{"path":"/"}}]}')
    with pytest.raises(ConfigError, match="expected a trace of ours, by python -m runtime run"):
        read_trace(other)
    (tmp_path / "none.part").touch()
    with pytest.raises(ConfigError, match="its run goes on, or was killed"):
        read_trace(tmp_path / "none")
