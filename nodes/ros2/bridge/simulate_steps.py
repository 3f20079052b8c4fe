"""The action SimulateSteps of simulation_interfaces 2.1: steps of time, and news of how far it is.

An action is three services and two topics (https://design.ros2.org/articles/actions.html). A goal
that cannot be pursued is accepted and aborted at once: a rejection could not say why.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
import time
from typing import Any

from nodes.ros2.bridge.service_server import ServiceServer
from nodes.ros2.bridge.simulation_services import OK, OPERATION_FAILED, SimulationServices
from nodes.ros2.messages.services import CANCEL_GOAL, STEPS
from nodes.ros2.messages.topics import Qos
from runtime.time.schedule import SECOND

# Of GoalStatus.msg, and of CancelGoal.srv.
UNKNOWN, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 0, 2, 3, 4, 5, 6
NO_ERROR, UNKNOWN_GOAL, GOAL_TERMINATED = 0, 2, 3

KEPT, PERIOD = 16, 0.2
"""Goals whose results can be asked for; real seconds between two messages of feedback."""


class _Goal:
    """Steps that a client wants from simulated time `begin` (ns); `info` is its GoalInfo."""

    def __init__(self, info: Any, steps: int, begin: int) -> None:
        self.info, self.steps, self.begin = info, steps, begin
        self.status, self.result, self.over = EXECUTING, dict[str, Any](), asyncio.Event()


class SimulateSteps:
    """Steps time for one goal at a time."""

    def __init__(self, server: ServiceServer, simulation: SimulationServices) -> None:
        self._server, self._simulation = server, simulation
        self._clock, self._stepping = server.node.clock, server.node.stepping
        self._message = server.store.message
        self._goals: dict[bytes, _Goal] = {}
        """By id, the oldest first; at most one is not over."""

    def declare(self) -> None:
        """Declare topics and services; called in any thread."""
        below, array = "simulate_steps/_action", "action_msgs/msg/GoalStatusArray"
        declare, publisher = self._server.declare, self._server.publisher
        self._status = publisher(f"{below}/status", array, Qos(transient_local=True, depth=1))
        self._news = publisher(f"{below}/feedback", f"{STEPS}_FeedbackMessage", Qos())
        declare(f"{below}/cancel_goal", CANCEL_GOAL, self._cancel)
        declare(f"{below}/get_result", f"{STEPS}_GetResult", self._get_result)
        declare(f"{below}/send_goal", f"{STEPS}_SendGoal", self._send_goal)

    async def _send_goal(self, request: Any) -> dict[str, Any]:
        now, id_, steps = self._clock.now(), bytes(request.goal_id.uuid), request.goal.steps
        sec, nanosec = divmod(now, SECOND)
        stamp = self._message("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
        if id_ in self._goals:
            return {"accepted": False, "stamp": stamp}
        if len(self._goals) == KEPT:
            del self._goals[next(each for each, goal in self._goals.items() if goal.over.is_set())]
        info = self._message("action_msgs/msg/GoalInfo")(goal_id=request.goal_id, stamp=stamp)
        goal = self._goals[id_] = _Goal(info, steps, now)
        if refusal := self._simulation.refusal(steps):
            self._set(goal, ABORTED, *refusal)
        else:
            self._set(goal, EXECUTING)
            stepped = self._stepping.step(steps * self._simulation.step)
            stepped.add_done_callback(functools.partial(self._stepped, goal))
            threading.Thread(target=self._tell_often, args=(goal,), daemon=True).start()
        return {"accepted": True, "stamp": stamp}

    def _tell_often(self, goal: _Goal) -> None:
        """Have feedback published while steps go on, by a thread: the loop's time is simulated."""
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            while not goal.over.is_set():
                time.sleep(PERIOD)
                gone = self._clock.now() - goal.begin
                self._server.loop.call_soon_threadsafe(self._tell, goal, gone)

    def _tell(self, goal: _Goal, gone: int) -> int:
        """Publish how many steps are done after `gone` ns, and return that."""
        done = min(gone // self._simulation.step, goal.steps)
        if not goal.over.is_set():
            counts = {"completed_steps": done, "remaining_steps": goal.steps - done}
            feedback = self._message(f"{STEPS}_Feedback")(**counts)
            self._news(goal_id=goal.info.goal_id, feedback=feedback)
        return done

    def _stepped(self, goal: _Goal, stepped: asyncio.Future[int]) -> None:
        done = self._tell(goal, stepped.result())
        what = f"after {done} of {goal.steps} steps"
        if done == goal.steps:
            self._set(goal, SUCCEEDED, OK)
        elif goal.status == CANCELING:
            self._set(goal, CANCELED, OPERATION_FAILED, f"canceled {what}")
        else:
            self._set(goal, ABORTED, OPERATION_FAILED, f"ended from elsewhere {what}")

    def _set(self, goal: _Goal, status: int, *result: Any) -> None:
        """Publish a status; with a result the goal is over, once and for all."""
        if goal.over.is_set():
            return
        if result:
            goal.result = self._simulation.result(*result)
            goal.over.set()
        goal.status = status
        make, goals = self._message("action_msgs/msg/GoalStatus"), self._goals.values()
        self._status(status_list=[make(goal_info=it.info, status=it.status) for it in goals])

    async def _get_result(self, request: Any) -> dict[str, Any]:
        status, result = UNKNOWN, self._simulation.result(OPERATION_FAILED, "no such goal is known")
        if goal := self._goals.get(bytes(request.goal_id.uuid)):
            try:
                await goal.over.wait()
            except asyncio.CancelledError:  # whoever asked must not wait for ever
                self._set(goal, ABORTED, OPERATION_FAILED, "the run has ended")
            status, result = goal.status, goal.result
        return {"status": status, "result": self._message(f"{STEPS}_Result")(**result)}

    async def _cancel(self, request: Any) -> dict[str, Any]:
        """Cancel the goal of an id, or accepted up to a time; if neither is given, any."""
        id_, stamp = bytes(request.goal_info.goal_id.uuid), request.goal_info.stamp
        until = stamp.sec * SECOND + stamp.nanosec
        for each, goal in self._goals.items():
            before = goal.begin <= until if until else not any(id_)
            if not goal.over.is_set() and (each == id_ or before):
                self._set(goal, CANCELING)
                self._stepping.pause()
                return {"return_code": NO_ERROR, "goals_canceling": [goal.info]}
        code = GOAL_TERMINATED if id_ in self._goals else UNKNOWN_GOAL
        return {"return_code": code if any(id_) else NO_ERROR, "goals_canceling": []}
