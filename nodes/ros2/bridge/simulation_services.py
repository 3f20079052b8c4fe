"""The services of simulation_interfaces 2.1: what the simulator can, its state, and steps of time.

Source: https://github.com/ros-simulation/simulation_interfaces. There is no reset: a run has one
beginning. GetSimulatorFeatures says so.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nodes.ros2.bridge.service_server import ServiceServer
from nodes.ros2.messages.services import SIMULATION
from runtime.time.schedule import SECOND

# Of SimulatorFeatures.msg.
STATE_GETTING, STATE_SETTING, STATE_PAUSE = 24, 25, 26
STEP_SINGLE, STEP_MULTIPLE, STEP_ACTION = 31, 32, 33

# Of SimulationState.msg.
STOPPED, PLAYING, PAUSED, QUITTING = range(4)

# Of Result.msg, and of SetSimulationState.srv.
FEATURE_UNSUPPORTED, OK, OPERATION_FAILED = 0, 1, 4
ALREADY_IN_TARGET_STATE, INCORRECT_TRANSITION = 101, 103

LONGEST = 86_400 * SECOND
"""Nanoseconds of the run's clock that one request may step."""


class SimulationServices:
    """Lets ROS see and set whether simulated time runs, and step it."""

    def __init__(self, server: ServiceServer) -> None:
        self._server = server
        self._stepping = server.node.stepping
        self.step = round(server.node.config.step * SECOND)
        """Nanoseconds of one step."""

    def declare(self) -> None:
        """Declare the services; called in any thread."""
        for name, kind, serve in (
            ("get_simulator_features", "GetSimulatorFeatures", self._features),
            ("get_simulation_state", "GetSimulationState", self._state),
            ("set_simulation_state", "SetSimulationState", self._set_state),
            ("step_simulation", "StepSimulation", self._steps),
            ("reset_simulation", "ResetSimulation", self._reset),
        ):
            self._server.declare(name, f"{SIMULATION}/{kind}", serve)

    def refusal(self, steps: int) -> tuple[int, str] | None:
        """Return why so many steps cannot be done now, as result and text; `None` if they can."""
        if why := self._stepping.fixed():
            return FEATURE_UNSUPPORTED, why
        if (state := self._stepping.state) != "paused":
            return OPERATION_FAILED, f"expected time to stand, found it {state}"
        most = LONGEST // self.step
        if not 0 < steps <= most:
            return OPERATION_FAILED, f"expected 1 to {most} steps, found {steps}"
        return None

    def result(self, result: int, message: str = "") -> dict[str, Any]:
        """Return the field of a response that says how it went."""
        return {"result": self._make("Result", result=result, error_message=message)}

    async def _features(self, _: Any) -> dict[str, Any]:
        found = [STATE_GETTING, STATE_SETTING]
        why = self._stepping.fixed()
        if not why:
            found += [STATE_PAUSE, STEP_SINGLE, STEP_MULTIPLE, STEP_ACTION]
        info = why or f"a step is {self.step / SECOND:g} s of simulated time"
        kind, features = "SimulatorFeatures", np.array(found, np.uint16)
        made = self._make(kind, features=features, spawn_formats=[], custom_info=info)
        return {"features": made}

    async def _state(self, _: Any) -> dict[str, Any]:
        state = self._make("SimulationState", state=self._now())
        return {"state": state, **self.result(OK)}

    async def _set_state(self, request: Any) -> dict[str, Any]:
        wanted = request.state.state
        if wanted in {STOPPED, QUITTING}:
            self._server.node.stop("ended by ROS")
            return self.result(OK)
        if wanted not in {PLAYING, PAUSED}:
            return self.result(INCORRECT_TRANSITION, f"expected a state of 0 to 3, found {wanted}")
        if wanted == self._now():
            return self.result(ALREADY_IN_TARGET_STATE)
        if why := self._stepping.fixed():
            return self.result(FEATURE_UNSUPPORTED, why)
        if wanted == PLAYING:
            self._stepping.resume()
        else:
            self._stepping.pause()
        return self.result(OK)

    async def _steps(self, request: Any) -> dict[str, Any]:
        if refusal := self.refusal(request.steps):
            return self.result(*refusal)
        ns = request.steps * self.step
        if (gone := await self._stepping.step(ns)) < ns:
            what = f"ended after {gone / SECOND:g} of {ns / SECOND:g} s: by another request"
            return self.result(OPERATION_FAILED, what)
        return self.result(OK)

    async def _reset(self, _: Any) -> dict[str, Any]:
        return self.result(FEATURE_UNSUPPORTED, "a run begins once: end it, and start another")

    def _now(self) -> int:
        return PAUSED if self._stepping.state == "paused" else PLAYING

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._server.store.message(f"simulation_interfaces/msg/{kind}")(**fields)
