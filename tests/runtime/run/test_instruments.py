"""Looking at steps of nodes that run, and leaving no trace of it."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from typing import Any

import pytest

from events import Event
from runtime.channels.sender import Sender
from runtime.channels.tasks import ResumableCoroutine
from runtime.errors import ChannelClosedError
from runtime.node import Node, senders
from runtime.run.instruments import Call, Instrument
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from tests.runtime.samples_loop import Camera, Estimator, Pilot, look, until_sent
from tests.runtime.samples_runs import supervisor_of
from tests.runtime.samples_workers import Plant

NODES = [spec(Camera, "drone"), spec(Estimator, "vo"), spec(Pilot, "pilot")]


class Gardener(Node):
    """Has a worker, and asks it something."""

    async def run(self) -> None:
        plant = await self.worker(Plant)
        await plant.call(Plant.pid)


class Eye(Instrument):
    """An instrument that notes what it sees."""

    def __init__(self) -> None:
        self.steps: list[str] = []
        self.events: list[str] = []
        self.calls: list[str] = []
        self.event_sent = self._tap

    def wrap_call(self, node: str, what: str, call: Call) -> Call:
        def seeing(argument: Any) -> Any:
            self.steps.append(f"{node}.{what}")
            return call(argument)

        return seeing

    def worker_called(self, process: str, method: str, answer: Future[Any]) -> None:
        self.calls.append(f"{process}: {method}")

    def _tap(self, sender: Sender[Any] | None, event: Event) -> None:
        self.events.append(type(event).__name__)


def insides(supervisor: Supervisor) -> list[Any]:
    """Return all that an instrument could leave behind."""
    runners = supervisor.state.runners.values()
    return [
        [
            (s.name, s.send.__name__, [c.deliver for c in s._candidates], s._taps)
            for runner in runners
            if runner.node
            for s in senders(runner.node).values()
        ],
        [ticker._call for runner in runners for ticker in runner.tickers],
        all(  # of tasks there are now more, now fewer
            steps._step == steps._coro.send
            for runner in runners
            for task in runner.tasks
            if isinstance(steps := task.get_coro(), ResumableCoroutine)
        ),
    ]


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_an_instrument_sees_ticks_handlers_steps_and_events_while_it_is_there(clock: str) -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        await supervisor.state.clock.sleep(0.05)
        before = insides(supervisor)
        supervisor.instruments.attach(eye)
        assert insides(supervisor) != before
        await until_sent(supervisor, "pilot", 3)
        supervisor.instruments.detach(eye)
        assert insides(supervisor) == before
        seen.append(len(eye.steps))
        await until_sent(supervisor, "pilot", 1)
        supervisor.stop("seen enough")

    seen: list[int] = []
    look(NODES, body, duration=60, clock=clock)
    assert len(eye.steps) == seen[0]
    assert set(eye.events) == {"Image", "PoseEstimate", "VelocitySetpoint"}
    assert set(eye.steps) == {"drone.expose", "drone.deliver", "vo.run", "pilot.fly"}
    assert eye.steps.count("pilot.fly") == eye.events.count("VelocitySetpoint") == 3
    if clock == "lockstep":
        assert eye.events == ["Image", "PoseEstimate", "VelocitySetpoint"] * 3


def test_an_instrument_is_put_around_a_node_that_restarts() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.instruments.attach(eye)
        supervisor.restart("pilot", anyway=True)  # half a second later it is up again

    look(NODES, body, duration=0.75)  # set-points at 530, 630 and 730 ms
    assert eye.steps.count("pilot.fly") == 3


def test_a_link_does_not_hide_the_handler_behind_it() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.instruments.attach(eye)

    pilot = spec(Pilot, "pilot", links={"fly": {"delay": 0.01}})
    look([*NODES[:2], pilot], body, duration=0.15)  # set-points at 40 and 140 ms
    assert eye.steps.count("pilot.fly") == 2


def test_an_instrument_hears_of_a_workers_calls() -> None:
    eye = Eye()

    async def body(supervisor: Supervisor) -> None:
        supervisor.instruments.attach(eye)
        await asyncio.sleep(0)

    look([spec(Gardener, "gardener")], body, duration=0.1)
    assert eye.calls == ["gardener.Plant: pid"]


def test_an_instrument_does_not_let_nodes_send_before_the_first_update() -> None:
    refused = []

    class Late(Node):
        async def on_startup(self) -> None:
            supervisor = supervisor_of(self)
            supervisor.instruments.attach(Eye())
            drone = supervisor.state.runners["drone"].node
            assert drone is not None
            early = senders(drone)["images"]
            with pytest.raises(ChannelClosedError):
                early.send(None)
            refused.append(early.name)

    look([*NODES, spec(Late, "late")], duration=0.1)
    assert refused == ["drone.images"]
