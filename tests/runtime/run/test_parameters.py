"""Settings of nodes that change while a run goes on."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from events import ParameterChanged, VelocitySetpoint
from runtime import Node
from runtime.errors import ConfigError, NodeError
from runtime.run.supervisor import Supervisor
from runtime.testing import spec
from tests.runtime.samples_loop import Camera, Estimator, Listener, Pilot, look, until_sent
from tests.runtime.samples_runs import supervisor_of


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_change_in_a_run_holds_from_then_on_and_is_recorded(
    clock: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)

    async def body(supervisor: Supervisor) -> None:
        await until_sent(supervisor, "pilot", 1)
        assert supervisor.parameters.set("pilot.gain=3") == {"gain": "3.0"}
        with pytest.raises(ConfigError, match="pilot refuses: expected a gain that brings no"):
            supervisor.parameters.set("pilot.gain=13")
        if clock == "real":
            await until_sent(supervisor, "pilot", 1)
            supervisor.stop("seen enough")

    nodes = [
        spec(Camera, "drone"),
        spec(Estimator, "vo"),
        spec(Pilot, "pilot"),
        spec(Listener, "listener"),
    ]
    looked = look(nodes, body, clock=clock, duration=0.4 if clock == "lockstep" else 60)
    (changed,) = [e for e in looked.sent if isinstance(e, ParameterChanged)]
    assert (changed.source, changed.key, changed.value) == ("pilot", "gain", "3.0")
    assert [line for line in caplog.messages if "is now" in line] == ["pilot.gain is now 3.0"]
    gains = [e.velocity[0] for e in looked.sent if isinstance(e, VelocitySetpoint)]
    assert sorted(gains) == gains
    assert set(gains) == {1.0, 3.0}
    listener = looked.supervisor.state.all_nodes[3]
    assert isinstance(listener, Listener)
    assert listener.heard == ["pilot.gain=3.0"]
    if clock == "lockstep":
        assert looked.digest != look(nodes, duration=0.4).digest


def test_a_node_that_restarts_keeps_what_was_changed() -> None:
    async def body(supervisor: Supervisor) -> None:
        await supervisor.state.clock.sleep(0.2)
        supervisor.parameters.set("pilot.gain=3")
        supervisor.restart("pilot", anyway=True)

    looked = look([spec(Pilot, "pilot")], body)
    first, second = looked.supervisor.state.all_nodes
    assert first is not second
    assert isinstance(second, Pilot)
    assert second.config.gain == 3.0
    (changed,) = [e for e in looked.sent if isinstance(e, ParameterChanged)]
    assert changed.stamp == 200_000_000


def test_a_node_that_has_not_started_cannot_change() -> None:
    class First(Node):
        async def on_startup(self) -> None:
            with pytest.raises(ConfigError, match="pilot does not just now"):
                supervisor_of(self).parameters.set("pilot.gain=3")

    look([spec(First, "first"), spec(Pilot, "pilot")], duration=0.1)


def test_a_change_before_the_first_update_is_told_as_the_run_begins() -> None:
    class Last(Node):
        async def on_startup(self) -> None:
            supervisor_of(self).parameters.set("pilot.gain=3")

    looked = look(
        [spec(Pilot, "pilot"), spec(Last, "last"), spec(Listener, "listener")], duration=0.3
    )
    assert [e.value for e in looked.sent if isinstance(e, ParameterChanged)] == ["3.0"]
    listener = looked.supervisor.state.all_nodes[2]
    assert isinstance(listener, Listener)
    assert listener.heard == ["pilot.gain=3.0"]


def test_a_node_that_does_not_run_cannot_change() -> None:
    async def body(supervisor: Supervisor) -> None:
        await supervisor.state.clock.sleep(0.2)
        supervisor.restart("pilot", anyway=True)
        await supervisor.state.clock.sleep(0.2)
        with pytest.raises(ConfigError, match="expected a node that runs"):
            supervisor.parameters.set("pilot.gain=3")

    look([spec(Pilot, "pilot")], body)


def test_a_value_that_a_setting_has_is_no_change() -> None:
    async def body(supervisor: Supervisor) -> None:
        assert supervisor.parameters.set("pilot.gain=1") == {}

    looked = look([spec(Pilot, "pilot")], body)
    assert [e for e in looked.sent if isinstance(e, ParameterChanged)] == []


def test_what_on_change_raises_is_its_nodes_fault() -> None:
    class Broken(Pilot):
        def on_change(self, before: Any) -> None:
            raise LookupError("no such gain")

    async def body(supervisor: Supervisor) -> None:
        supervisor.parameters.set("pilot.gain=3")

    with pytest.raises(NodeError, match="pilot: LookupError: no such gain"):
        look([spec(Broken, "pilot")], body)
