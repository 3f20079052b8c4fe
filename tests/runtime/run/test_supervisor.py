"""The life of nodes: who does what when, and how a run ends."""

from __future__ import annotations

import asyncio
import gc
import time
import warnings
from collections.abc import Iterable
from typing import Any

import pytest

from events import Announcement, Event, Shutdown, WindowClosed
from runtime import Input, Node, NodeConfig, Output, RefusedError, Tick, every, on
from runtime.config.model import NodeSpec
from runtime.errors import NodeError, NodeTimeoutError
from runtime.testing import run_node, run_nodes, spec
from tests.runtime.samples import DIARY, Diarist, Echo, Ender, Offer, Ping, Pong, Speaker
from tests.runtime.samples_runs import supervise

CLOCKS = ["lockstep", "real"]


@pytest.fixture(autouse=True)
def _blank_diary() -> None:
    DIARY.clear()


def diarists(*names: str) -> list[NodeSpec]:
    return [spec(Diarist, name) for name in names]


@pytest.mark.parametrize("clock", CLOCKS)
def test_phases_come_in_order_and_end_in_reverse(clock: str) -> None:
    outcome = supervise(diarists("a", "b"), clock=clock, duration=0.2)
    assert outcome.error is None
    assert outcome.reason == "duration"
    beginning = ["a made", "a up", "b made", "b up", "a announces", "b announces"]
    hearing = ["a heard of a", "a heard of b", "b heard of a", "b heard of b"]
    living = {"a runs", "b runs", "a ticks 0", "b ticks 0"}
    ending = ["b down", "a heard b", "a down"]
    assert DIARY[:12] == [*beginning, *hearing, "a is ready", "b is ready"]
    assert set(DIARY[12:-3]) == living
    assert DIARY[-3:] == ending


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_refusal_names_both_and_shuts_down_all(clock: str) -> None:
    class Picky(Diarist):
        def on_announcement(self, announcement: Announcement) -> None:
            if announcement.source == "b":
                raise ValueError("it smells")

    outcome = supervise([spec(Diarist, "a"), spec(Diarist, "b"), spec(Picky, "c")], clock=clock)
    assert isinstance(outcome.error, RefusedError)
    assert str(outcome.error) == "c: cannot work with b: it smells"
    assert "a runs" not in DIARY
    assert [line for line in DIARY if "down" in line] == ["c down", "b down", "a down"]


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_start_that_takes_too_long_ends_the_run(clock: str) -> None:
    class Sleepy(Diarist):
        async def on_startup(self) -> None:
            await asyncio.get_running_loop().create_future()

    begin = time.monotonic()
    outcome = supervise(
        [spec(Diarist, "a"), spec(Sleepy, "s"), spec(Diarist, "z")], clock=clock, startup_limit=0.1
    )
    assert time.monotonic() - begin < 20
    assert isinstance(outcome.error, NodeTimeoutError)
    assert "s: expected on_startup to end within 0.1 s" in str(outcome.error)
    assert "z made" not in DIARY
    assert [line for line in DIARY if "down" in line] == ["a down"]


@pytest.mark.parametrize("clock", CLOCKS)
def test_getting_ready_that_takes_too_long_or_fails_ends_the_run(clock: str) -> None:
    class Sleepy(Diarist):
        async def on_ready(self) -> None:
            await asyncio.get_running_loop().create_future()

    class Broken(Diarist):
        async def on_ready(self) -> None:
            raise OSError("no such camera")

    for kind, said in (
        (Sleepy, "s: expected on_ready to end within 0.1 s"),
        (Broken, "s: OSError: no such camera"),
    ):
        DIARY.clear()
        outcome = supervise([spec(Diarist, "a"), spec(kind, "s")], clock=clock, startup_limit=0.1)
        assert said in str(outcome.error)
        assert "a runs" not in DIARY
        assert [line for line in DIARY if "down" in line] == ["s down", "a down"]


@pytest.mark.parametrize("clock", CLOCKS)
def test_no_event_is_missed_by_who_gets_ready(clock: str) -> None:
    """However long it takes: the clock starts after it."""
    heard: list[int] = []
    sent: list[int] = []

    class Slow(Node):
        pings = Input(Ping, keep="latest")

        async def on_ready(self) -> None:
            await self.offload(time.sleep, 0.3)  # real work beside the loop

        async def run(self) -> None:
            heard.append((await anext(self.pings)).stamp)

    class Source(Node):
        pings = Output(Ping)

        @every(hz=100)
        def tick(self, tick: Tick) -> None:
            sent.append(tick.index)  # not from 0 where the machine is busy: late ticks are skipped
            self.pings.send(Ping(stamp=tick.index, source=self.name))

    supervise([spec(Source, "source"), spec(Slow, "slow")], clock=clock, duration=0.2)
    assert heard == sent[:1]


class LastWord(Diarist):
    """Says something when the run is to end."""

    async def on_end(self) -> None:
        await self.offload(time.sleep, 0.01)  # such as asking a worker
        DIARY.append(f"{self.name} has a last word")
        self.pings.send(Ping(stamp=self.clock.now(), source=f"{self.name}/last word"))


@pytest.mark.parametrize("clock", CLOCKS)
def test_last_words_reach_all_nodes_before_any_shuts_down(clock: str) -> None:
    supervise([*diarists("a"), spec(LastWord, "b"), *diarists("c")], clock=clock, duration=0.1)
    end = DIARY[DIARY.index("b has a last word") :]
    heard = [f"{name} heard b/last word" for name in "ac"]
    assert end[1 : 1 + len(heard)] == heard
    assert end[1 + len(heard)] == "c down"


def test_last_words_that_fail_or_hang_keep_nobody() -> None:
    class Stuck(Diarist):
        async def on_end(self) -> None:
            await asyncio.get_running_loop().create_future()

    class Choking(Diarist):
        async def on_end(self) -> None:
            raise OSError("disk full")

    nodes = [*diarists("a"), spec(Choking, "b"), spec(Stuck, "c"), spec(LastWord, "d")]
    outcome = supervise(nodes, duration=0.1, shutdown_limit=0.1)
    assert str(outcome.error) == "b: OSError: disk full"
    assert "a heard d/last word" in DIARY
    assert [line for line in DIARY if "down" in line] == ["d down", "c down", "b down", "a down"]


@pytest.mark.parametrize("clock", CLOCKS)
def test_an_end_that_takes_too_long_does_not_keep_the_others(clock: str) -> None:
    class Sleepy(Diarist):
        async def on_shutdown(self) -> None:
            await asyncio.get_running_loop().create_future()

    outcome = supervise(
        [spec(Diarist, "a"), spec(Sleepy, "s")], clock=clock, duration=0.1, shutdown_limit=0.1
    )
    assert isinstance(outcome.error, NodeTimeoutError)
    assert outcome.error.node == "s"
    assert DIARY[-1] == "a down"


def test_an_end_that_raises_does_not_keep_the_others() -> None:
    class Clumsy(Diarist):
        async def on_shutdown(self) -> None:
            raise OSError("disk full")

    outcome = supervise([*diarists("a"), spec(Clumsy, "b"), *diarists("c")])
    assert str(outcome.error) == "b: OSError: disk full"
    assert [line for line in DIARY if "down" in line] == ["c down", "a down"]


def test_an_exception_in_announce_is_the_nodes_fault() -> None:
    class Broken(Diarist):
        def announce(self) -> Iterable[Announcement]:
            raise KeyError("camera")

    outcome = supervise([*diarists("a"), spec(Broken, "b")])
    assert isinstance(outcome.error, NodeError)
    assert str(outcome.error) == "b: KeyError: 'camera'"
    assert DIARY[-1] == "a down"


def test_a_node_with_only_a_handler_works() -> None:
    result = run_nodes([spec(Speaker, "s"), spec(Echo, "e")], duration=0.35)
    assert [p.count for p in result.of(Pong)] == [0, 1, 2, 3]


def test_a_rate_may_come_from_a_setting() -> None:
    assert run_node(Speaker, config={"rate": 4}, duration=0.9).ticks["node.speak"].calls == 4


def test_a_coroutine_tick_that_overruns_is_skipped_and_counted() -> None:
    class Slow(Node):
        @every(hz=10)
        async def work(self, tick: Tick) -> None:
            DIARY.append(f"{tick.index}")
            await self.clock.sleep(0.25)

    result = run_node(Slow, duration=0.95)
    assert DIARY == ["0", "3", "6", "9"]
    assert result.ticks["node.work"].missed == 6


def test_start_and_every_belong_to_the_node() -> None:
    class Busy(Node):
        pings = Output(Ping)

        async def on_startup(self) -> None:
            self.every(5, self.say, "say")

        def say(self, tick: Tick) -> None:
            self.pings.send(Ping(stamp=tick.stamp, source=self.name, count=tick.index))

        async def run(self) -> None:
            self.start(self.beside())

        async def beside(self) -> None:
            try:
                await asyncio.get_running_loop().create_future()
            finally:
                DIARY.append("cancelled")

    result = run_node(Busy, duration=0.5)
    assert [p.stamp for p in result.of(Ping)] == [0, 200_000_000, 400_000_000]
    assert DIARY == ["cancelled"]


def test_what_is_started_as_the_node_ends_need_not_have_begun() -> None:
    """A task that is cancelled before its first step leaves no warning of its coroutine."""

    class Late(Node):
        async def run(self) -> None:
            self.stop("enough")
            while True:
                self.start(self.beside())
                await asyncio.sleep(0)

        async def beside(self) -> None:
            DIARY.append("begun")
            await asyncio.get_running_loop().create_future()

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert run_node(Late).reason == "enough"
        gc.collect()
    assert DIARY
    assert [str(warning.message) for warning in caught] == []


def test_stop_ends_the_run_with_its_reason() -> None:
    class Tired(Node):
        async def run(self) -> None:
            await self.clock.sleep(0.25)
            self.stop("tired")

    result = run_node(Tired)
    assert (result.reason, result.seconds) == ("tired", 0.25)


def test_duration_is_time_of_the_clock() -> None:
    begin = time.monotonic()
    result = run_nodes(diarists("a"), duration=3600.0)
    assert (result.reason, result.seconds) == ("duration", 3600.0)
    assert time.monotonic() - begin < 20


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (Shutdown(stamp=0, source="x", reason="enough"), "x: enough"),
        (WindowClosed(stamp=0, source="x"), "x: WindowClosed"),
    ],
)
def test_shutdown_and_a_closed_window_end_the_run(event: Event, reason: str) -> None:
    assert run_nodes(diarists("a"), inputs=[event]).reason == reason


def test_a_handled_shutdown_does_not_end_the_run() -> None:
    class Keeper(Node):
        @on(Shutdown)
        def keep(self, _: Shutdown) -> bool:
            return True

    assert run_nodes([spec(Ender, "e"), spec(Keeper, "k")]).reason == "duration"
    assert run_nodes([spec(Ender, "e")]).reason == "e: enough"


@pytest.mark.parametrize("waits", [False, True])
def test_stop_during_start_up_shuts_down_what_had_started(waits: bool) -> None:
    class Quitter(Diarist):
        async def on_startup(self) -> None:
            self.stop("no more")
            if waits:
                await asyncio.sleep(0)

    outcome = supervise([*diarists("a"), spec(Quitter, "q"), *diarists("z")])
    assert (outcome.reason, outcome.error) == ("no more", None)
    assert "z made" not in DIARY
    assert "a announces" not in DIARY
    assert DIARY[-1] == "a down"
    assert ("q down" in DIARY) is not waits


def test_every_node_hears_every_announcement_before_the_first_event() -> None:
    run_nodes(diarists("a", "b"), inputs=[Offer(stamp=0, source="seed"), Ping(stamp=0, source="s")])
    assert {"a heard of seed", "b heard of seed"} <= set(DIARY[: DIARY.index("a heard s")])


def test_a_nodes_random_numbers_depend_on_seed_and_name_only() -> None:
    class Dice(Node[NodeConfig]):
        pings = Output(Ping)

        async def run(self) -> None:
            count = int(self.rng.integers(1 << 60))
            self.pings.send(Ping(stamp=0, source=self.name, count=count))

    def roll(*names: str, seed: int) -> list[Any]:
        return [p.count for p in run_nodes([spec(Dice, n) for n in names], seed=seed).of(Ping)]

    assert roll("a", seed=1) == roll("a", "b", seed=1)[:1]
    assert roll("a", seed=1) != roll("a", seed=2)
    first, second = roll("a", "b", seed=1)
    assert first != second


class Short(Node):
    """Reads but two events."""

    pings = Input(Ping)

    async def run(self) -> None:
        async for ping in self.pings:
            if ping.count:
                return


@pytest.mark.parametrize("clock", CLOCKS)
def test_a_node_that_stops_reading_is_named(clock: str, caplog: pytest.LogCaptureFixture) -> None:
    nodes = [spec(Speaker, "speaker"), spec(Short, "short"), *diarists("a")]
    outcome = supervise(nodes, clock=clock, duration=0.3)
    assert outcome.error is None
    told = [record.getMessage() for record in caplog.records if "nobody reads" in record.message]
    assert told == ["short: run() has returned: nobody reads pings any more"]
