"""What becomes of a run in which a node fails, for each place where it can and each `on_error`."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

import pytest

from events import Announcement, Event
from runtime import Input, Node, Output, Tick, every, on
from runtime.config.model import OnError
from runtime.errors import ChannelFullError, FatalError, NodeError
from runtime.testing import run_nodes, spec
from tests.runtime.samples import Offer, Ping, Pong
from tests.runtime.samples_runs import Outcome, supervise

PLACES = ["run", "handler", "tick", "started", "task_group"]
pytestmark = pytest.mark.timeout(20)


class Patient(Node):
    """Fails once in each of its first lives, at 1 s of them, in the place it is told."""

    pongs = Output(Pong)
    place: ClassVar[str] = "run"
    lives: ClassVar[list[float]] = []
    ends: ClassVar[list[float]] = []
    heard: ClassVar[list[tuple[int, float]]] = []
    failures: ClassVar[int] = 1

    async def on_startup(self) -> None:
        self.life = len(self.lives)
        self.lives.append(self.now)
        if self.place == "on_startup" and 1 <= self.life <= self.failures:
            raise RuntimeError("cannot get up")

    @property
    def now(self) -> float:
        return self.clock.now() / 1e9

    def on_announcement(self, announcement: Announcement) -> None:
        self.heard.append((self.life, -1.0))

    def trouble(self, place: str) -> None:
        due = self.lives[self.life] + 1.0
        if self.place == place and self.life < self.failures and self.now >= due:
            raise RuntimeError("out of order")

    @on(Ping)
    def listen(self, _: Ping) -> None:
        self.heard.append((self.life, self.now))
        self.trouble("handler")

    @every(hz=10)
    def tick(self, tick: Tick) -> None:
        self.trouble("tick")

    async def run(self) -> None:
        if self.place == "started":
            self.start(self.later("started"))
        if self.place == "task_group":
            async with asyncio.TaskGroup() as group:
                group.create_task(self.later("task_group"))
        await self.later("run")

    async def later(self, place: str) -> None:
        await self.clock.sleep(1.0)
        self.trouble(place)
        if self.place == "on_startup" and self.life == 0:
            raise RuntimeError("out of order")

    async def on_shutdown(self) -> None:
        self.ends.append(self.now)


class Speaker(Node):
    """Says something ten times a second, and notes that sending never fails."""

    pings = Output(Ping)
    sent: ClassVar[int] = 0

    @every(hz=10)
    def speak(self, tick: Tick) -> None:
        self.pings.send(Ping(stamp=tick.stamp, source=self.name, count=tick.index))
        type(self).sent += 1


class Other(Node):
    """Hears the same events after the patient."""

    heard: ClassVar[int] = 0

    @on(Ping)
    def listen(self, _: Event) -> None:
        type(self).heard += 1


def treat(
    place: str, on_error: OnError, failures: int = 1, duration: float = 5.0, clock: str = "lockstep"
) -> Outcome:
    Patient.place, Patient.failures = place, failures
    for diary in (Patient.lives, Patient.ends, Patient.heard):
        diary.clear()
    Speaker.sent = Other.heard = 0
    nodes = [spec(Speaker, "speaker"), spec(Patient, "p", on_error=on_error), spec(Other, "other")]
    return supervise(nodes, duration=duration, clock=clock)


@pytest.mark.parametrize("place", PLACES)
def test_stop_ends_the_run_and_names_the_node(place: str) -> None:
    outcome = treat(place, "stop")
    assert isinstance(outcome.error, NodeError)
    assert str(outcome.error).startswith("p: ")
    assert outcome.reason == "p failed"
    assert outcome.seconds == 1.0
    assert Patient.ends == [1.0]
    assert Other.heard == Speaker.sent  # the delivery goes on past the one that failed


@pytest.mark.parametrize("place", PLACES)
def test_restart_brings_a_new_instance_after_the_back_off(place: str) -> None:
    outcome = treat(place, "restart", failures=2)
    assert outcome.error is None
    assert Patient.ends == [1.0, 2.5, 5.0]
    assert Patient.lives == [0.0, 1.5, 3.5]  # 0.5 s, then 1 s
    assert (2, 4.0) in Patient.heard
    assert not [at for _, at in Patient.heard if 1.0 < at < 1.5 or 2.5 < at < 3.5]
    assert Other.heard == Speaker.sent >= 50


@pytest.mark.parametrize("place", PLACES)
def test_drop_leaves_the_node_out_and_the_others_go_on(place: str) -> None:
    outcome = treat(place, "drop")
    assert outcome.error is None
    assert outcome.reason == "duration"
    assert (Patient.lives, Patient.ends) == ([0.0], [1.0])
    assert max(at for _, at in Patient.heard) <= 1.0
    assert Other.heard == Speaker.sent > 40


def test_a_restarted_node_hears_the_announcements_again() -> None:
    class Announcer(Node):
        def announce(self) -> list[Announcement]:
            return [Offer(stamp=0, source=self.name)]

    Patient.place, Patient.failures = "run", 1
    Patient.lives.clear()
    Patient.heard.clear()
    nodes = [spec(Announcer, "a"), spec(Patient, "p", on_error="restart")]
    supervise(nodes, duration=3.0)
    assert Patient.heard == [(0, -1.0), (1, -1.0)]


@pytest.mark.parametrize("place", ["run", "on_startup"])
def test_a_node_knows_how_often_it_was_up_before(place: str) -> None:
    knows: list[tuple[int, float]] = []

    class Knowing(Patient):
        async def run(self) -> None:
            knows.append((self.restarts, self.now))
            await self.clock.sleep(0.1)
            raise RuntimeError("out of order")

        async def on_startup(self) -> None:
            if place == "on_startup" and len(knows) == 1 and self.now < 1.0:
                raise RuntimeError("cannot get up")  # this attempt was never up

    supervise([spec(Knowing, "k", on_error="restart")], duration=5.0)
    assert [restarts for restarts, _ in knows] == list(range(len(knows)))
    assert len(knows) > 2


def test_statistics_carry_on_over_a_restart() -> None:
    treated = treat("tick", "restart")
    ticks = treated.supervisor.state.tickers["p.tick"]
    assert 11 + 35 <= ticks.calls <= 11 + 36


def test_failing_to_start_again_doubles_the_back_off() -> None:
    outcome = treat("on_startup", "restart", failures=3, duration=12.0)
    assert outcome.error is None
    assert Patient.lives == [0.0, 1.5, 2.5, 4.5, 8.5]


def test_failing_in_the_first_start_ends_the_run_whatever_on_error_says() -> None:
    class Lame(Node):
        async def on_startup(self) -> None:
            raise OSError("no such device")

    for on_error in ("stop", "restart", "drop"):
        with pytest.raises(NodeError, match="lame: OSError: no such device"):
            run_nodes([spec(Lame, "lame", on_error=on_error)])


@pytest.mark.parametrize("again", [False, True])
def test_fatal_ends_the_run_even_with_restart(again: bool) -> None:
    class Proud(Node):
        lives: ClassVar[int] = 0

        async def on_startup(self) -> None:
            type(self).lives += 1
            if self.lives == 2:
                self.log.fatal("I shall not %s", "rise again")

        async def run(self) -> None:
            await self.clock.sleep(0.5)
            if again:
                raise RuntimeError
            self.log.fatal("I shall not go on")

    text = "I shall not rise again" if again else "I shall not go on"
    with pytest.raises(FatalError, match=f"proud: {text}"):
        run_nodes([spec(Proud, "proud", on_error="restart")], duration=9.0)


def test_a_full_input_is_the_receivers_fault() -> None:
    class Slow(Node):
        pings = Input(Ping, bound=3)

        async def run(self) -> None:
            await self.clock.sleep(100)

    outcome = supervise([spec(Speaker, "speaker"), spec(Slow, "slow")])
    assert isinstance(outcome.error, NodeError)
    assert isinstance(outcome.error.__cause__, ChannelFullError)
    assert outcome.error.node == "slow"
    assert "slow.pings: expected room for one more event, found 3 unread" in str(outcome.error)


def test_the_end_of_the_run_waits_for_a_node_that_is_being_taken_out() -> None:
    log: list[Any] = []

    class Leaver(Node):
        async def run(self) -> None:
            await self.clock.sleep(0.5)
            raise RuntimeError

        async def on_shutdown(self) -> None:
            log.append("begins")
            await self.clock.sleep(2.0)
            log.append("done")

    outcome = supervise([spec(Leaver, "l", on_error="restart")], duration=1.0)
    assert log == ["begins", "done"]
    assert outcome.error is None


def test_a_node_that_waits_for_its_restart_stays_away_once_the_run_ends() -> None:
    lives = []

    class Weak(Node):
        async def on_startup(self) -> None:
            lives.append(self.clock.now())

        async def run(self) -> None:
            raise RuntimeError

    class Slow(Node):
        async def on_shutdown(self) -> None:
            await self.clock.sleep(60)

    outcome = supervise([spec(Slow, "s"), spec(Weak, "w", on_error="restart")], duration=0.2)
    assert (outcome.error, lives) == (None, [0])


@pytest.mark.slow
def test_restart_works_on_the_real_clock() -> None:
    outcome = treat("tick", "restart", duration=1.7, clock="real")
    assert outcome.error is None
    assert len(Patient.lives) == 2
    assert 0.5 <= Patient.lives[1] - Patient.ends[0] < 10


@pytest.mark.slow
def test_two_thousand_restarts_overflow_nothing() -> None:
    class Weak(Node):
        async def run(self) -> None:
            raise RuntimeError

    outcome = supervise([spec(Weak, "w", on_error="restart")], duration=2000 * 30.0)
    assert outcome.error is None
    assert outcome.supervisor.state.runners["w"].starts > 1900


def test_failures_are_forgotten_after_a_healthy_period() -> None:
    class Weekly(Node):
        starts: ClassVar[list[float]] = []

        async def run(self) -> None:
            self.starts.append(self.clock.now() / 1e9)
            await self.clock.sleep(1.0 if len(self.starts) < 4 else 61.0)
            raise RuntimeError

    supervise([spec(Weekly, "w", on_error="restart")], duration=80.0)
    assert Weekly.starts == [0.0, 1.5, 3.5, 6.5, 68.0]  # 0.5, 1 and 2 s; 0.5 s again


def test_the_limit_of_a_node_s_end_grows_with_the_run() -> None:
    outcome = supervise([spec(Speaker, "s")], duration=6000.0, shutdown_limit=10)
    assert outcome.supervisor.state.shutdown_limit() >= 10 + 0.05 * 6000
