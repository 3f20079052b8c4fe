"""A clock that follows that of another machine: it gets there, and never jumps."""

from __future__ import annotations

import asyncio
import itertools
import random
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from extensions.machines.tests.test_losses import Rig
from runtime.time.clock import SECOND, RealClock
from runtime.time.lockstep import LockstepLoop
from visnav_machines.member import (
    KEPT,
    MOST_DRIFT,
    ClockFollower,
    Exchange,
    Member,
    PhaseLockedLoop,
)
from visnav_machines.messages import Hello

MICRO = 1e-6


class Alarm:
    """Notes for when it was set; there is nothing due here."""

    def __init__(self, loop: object, ring: object) -> None:
        self.when = 0

    def set(self, when: int) -> None:
        self.when = when

    def close(self) -> None:
        pass


def member(outbox: Any = None) -> Member:
    return Member("far", Hello((), {}, "", 0.0), cast("Any", None), outbox)


class Far:
    """Another process, whose answers take a while that varies; stands in for an outbox."""

    def __init__(self, clock: RealClock, theirs: Callable[[], int]) -> None:
        self.member = member(self)
        self._clock, self._theirs = clock, theirs
        self._random = random.Random(0)

    def send(self, ping: Any) -> None:
        there, back = (round(self._random.expovariate(1 / 100e3)) + 30_000 for _ in "ab")
        half = (there + back) // 2
        late = self._theirs() - back - (self._clock.now() - round(half * self._clock.speed))
        self.member.exchanges.append(Exchange(there + back, 0, late))


def followed(
    monkeypatch: pytest.MonkeyPatch, ppm: float, *, behind: float = 0.0, seconds: int = 120
) -> tuple[list[float], float]:
    """Follow a clock that is so much quicker; return by how many seconds we were late, and ppm."""
    loop = LockstepLoop()

    def theirs() -> int:
        return loop.now

    def ours() -> int:
        return 5 * SECOND + round(loop.now / (1 + ppm * MICRO))

    monkeypatch.setattr("runtime.time.clock.time", types.SimpleNamespace(monotonic_ns=ours))
    monkeypatch.setattr("runtime.time.clock.TimerFd", Alarm)

    async def main() -> tuple[list[float], float]:
        clock = RealClock(loop)
        clock.start_at(ours() + round(behind * SECOND))
        far = Far(clock, theirs).member
        following = ClockFollower(clock, far)
        late, before = [], 0
        for second in range(1, 10 * seconds + 1):
            await asyncio.sleep(0.1)
            assert clock.now() >= before
            before = clock.now()
            if second % 10 == 0:
                late.append((theirs() - before) / SECOND)
        following.stop()
        assert far.drift_ppm is not None
        return late, far.drift_ppm

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main())


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 80.0])
def test_it_shows_what_the_other_does_and_knows_how_quick_that_is(
    ppm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also though the other began 2 ms before it, and though answers come as they like."""
    late, drift = followed(monkeypatch, ppm, behind=0.002)
    assert late[0] > 1e-3
    assert all(abs(offset) < 60 * MICRO for offset in late[60:])
    assert drift == pytest.approx(ppm, abs=5)


def test_what_is_out_of_reach_is_followed_as_quickly_as_may_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late, drift = followed(monkeypatch, 2000.0, seconds=60)
    steps = [after - before for before, after in itertools.pairwise(late[10:])]
    assert steps == pytest.approx([2e-3 - MOST_DRIFT] * len(steps), rel=0.02)
    assert abs(drift) < MOST_DRIFT / MICRO


def test_a_clock_that_is_steered_goes_on_from_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    real = [1000]
    monkeypatch.setattr(
        "runtime.time.clock.time", types.SimpleNamespace(monotonic_ns=lambda: real[0])
    )
    monkeypatch.setattr("runtime.time.clock.TimerFd", Alarm)
    clock = RealClock(cast("asyncio.AbstractEventLoop", None), speed=2.0)  # the alarm is ours
    clock.start_at(1000)
    real[0] += SECOND
    assert clock.now() == 2 * SECOND
    clock.schedule.add(4 * SECOND, types.SimpleNamespace(fire=lambda due, now: None))
    assert cast("Alarm", clock._alarm).when == 1000 + 2 * SECOND
    clock.steer(1.25)
    assert clock.now() == 2 * SECOND
    assert cast("Alarm", clock._alarm).when == 1000 + SECOND + round(0.8 * SECOND)
    real[0] += SECOND
    assert clock.now() == round(4.5 * SECOND)


def test_alone_it_runs_as_quickly_as_the_other_did() -> None:
    pursuit = PhaseLockedLoop()
    for _ in range(200):
        pursuit.factor(1e-4, 1.0)
    assert 0 < pursuit.drift < MOST_DRIFT
    assert pursuit.factor(0.0, 1.0) == 1.0 + pursuit.drift


def test_the_quickest_exchange_counts_of_those_that_are_kept() -> None:
    far = member()
    assert far.best() is None
    for n in range(KEPT + 5):
        far.exchanges.append(Exchange(100 + n, n, -n))
    assert far.best() == Exchange(105, 5, -5)
    assert far.best(3) == Exchange(KEPT + 102, KEPT + 2, -KEPT - 2)


QUICKER = """
import runpy, sys, time
real = time.monotonic_ns
begin = real()
time.monotonic_ns = lambda: begin + round((real() - begin) * (1 + 300e-6))
sys.argv[0] = "runtime"
runpy.run_module("runtime", run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_machine_with_another_quartz_keeps_up(tmp_path: Path) -> None:
    """After 20 s six tenths of how much slower it is are known, by the tests above."""
    rig = Rig(tmp_path)
    rig.write(clock="real", on_error="stop", duration="20s")
    here = rig.start("asker", "here")
    there = rig.start("one,other", "there", python=("-c", QUICKER))
    try:
        for process in (there, here):
            said, _ = process.communicate(timeout=100)
            assert process.returncode == 0, said
    finally:
        for process in (here, there):
            process.kill()
            process.communicate()
    drifts = [row.clock_drift_ppm for row in rig.summary("there").processes]
    assert drifts == [pytest.approx(-180, abs=80), None]
