"""ROS 2 services and an action of a run: requests come as Zenoh's queries.

simulation_interfaces 2.1 (https://github.com/ros-simulation/simulation_interfaces) shows and sets
whether simulated time runs, and steps it, with a reset refused: a run has one beginning. An action
is three services and two topics (https://design.ros2.org/articles/actions.html); an impossible goal
is accepted and aborted, as a rejection has no reason. Each vehicle is armed, disarmed, and made to
take off and land, by ``std_srvs/Trigger``.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import threading
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

import events
from events import Command, VehicleEvent
from nodes.ros2.bridge.keys import Attachment, Complaints, Message, pack
from nodes.ros2.bridge.session import Answer, Session
from nodes.ros2.bridge.settings import Ros2BridgeConfig
from nodes.ros2.messages.topics import (
    CANCEL_GOAL,
    DEFINITIONS,
    SIMULATION,
    STEPS,
    TRIGGER,
    Qos,
    Topic,
    ros_name,
    topic_name,
)
from nodes.ros2.messages.typestore import MessageError, TypeStore
from runtime import Node
from runtime.errors import VisnavError
from runtime.time.clock import SECOND

Serve = Callable[[Any], Awaitable[dict[str, Any]]]  # response's fields by request, or `VisnavError`
Finish = Callable[[bytearray | str], None]

WAITING = 64  # unanswered requests, at most


class ServiceServer:
    """Server of ROS 2 requests for a bridge."""

    def __init__(
        self,
        node: Node[Ros2BridgeConfig],
        session: Session,
        store: TypeStore,
        complaints: Complaints,
    ) -> None:
        self.node, self.store, self._session, self._complaints = node, store, session, complaints
        self.loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._waiting = self._answered = 0
        self._closed = False
        # Not `Node.offload`: simulated time does not wait for clients.
        self._executor = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="answers")

    def declare(self, name: str, type_: str, serve: Serve) -> None:
        """Declare a service, relative to the namespace, in any thread; `serve` runs on the loop."""
        for part in ("_Request", "_Response"):  # the first of each takes milliseconds
            sample = self.store.serialize(self.store.zero(type_ + part))
            self.store.deserialize(bytes(sample), type_ + part)
        name = topic_name(self.node.config.namespace, name)
        service = Topic(name=name, type=type_, hash=self.store.hash(type_))
        self._session.serve(service, functools.partial(self._receive_request, service, serve))

    def publisher(self, name: str, type_: str, qos: Qos) -> Callable[..., None]:
        """Declare a topic; return a function to publish messages of given fields, in order."""
        self.store.serialize(self.store.zero(type_))  # the first takes milliseconds
        name = topic_name(self.node.config.namespace, name)
        topic = Topic(name=name, type=type_, hash=self.store.hash(type_), qos=qos)
        make, publish = self.store.message(type_), self._session.publisher(topic).put
        return lambda **fields: self._send(publish, self.store.serialize(make(**fields)))

    async def close(self) -> None:
        """Stop accepting requests, and wait until all answers are sent."""
        self._closed = True
        await self.node.offload(self._executor.shutdown)
        self.node.log.info("%d requests answered", self._answered)

    def _receive_request(
        self, service: Topic, serve: Serve, message: Message, answer: Answer
    ) -> None:
        """Read a request in a thread of Zenoh's, and hand the request to the loop."""
        problem, request, attachment = "", None, message.attachment
        max_size = self.node.config.max_message_size
        with self._lock:
            self._waiting += 1
            waiting = self._waiting
        if waiting > WAITING:
            problem = f"expected {WAITING} requests that wait or fewer"
        elif attachment is None:
            problem = "expected an attachment with a number and a GID"
        elif message.size > max_size:
            problem = f"expected {max_size} bytes or less, found {message.size}"
        else:
            try:
                request = self.store.deserialize(message.read(), f"{service.type}_Request")
            except MessageError as error:
                problem = f"expected a {service.type}_Request: {error}"
        finish = functools.partial(self._finish, service.name, answer, attachment)
        if problem:
            finish(problem)
            return
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            self.loop.call_soon_threadsafe(self._start_answer, service.type, serve, request, finish)

    def _start_answer(self, *request: Any) -> None:
        if not self._closed:
            self.node.start(self._answer(*request))

    async def _answer(self, type_: str, serve: Serve, request: Any, finish: Finish) -> None:
        reply: bytearray | str = "the run has ended"
        try:
            response = self.store.message(f"{type_}_Response")(**await serve(request))
            reply = self.store.serialize(response)
            self._answered += 1
        except Exception as error:  # what comes from outside must not end the run
            reply = str(error) if isinstance(error, VisnavError) else repr(error)
        finally:  # cancelled, too: the client must not wait for ever
            finish(reply)

    def _finish(
        self, name: str, answer: Answer, request: Attachment | None, reply: bytearray | str
    ) -> None:
        if isinstance(reply, str):
            self._complaints.add(name, "request refused", reply)
        with self._lock:
            self._waiting -= 1
        attachment = b"" if request is None else pack(request._replace(stamp=time.time_ns()))
        self._send(answer, reply, attachment)

    def _send(self, *call: Any) -> None:
        with contextlib.suppress(RuntimeError):  # closed, and with it soon the session
            self._executor.submit(*call)


# Of SimulatorFeatures.msg.
STATE_GETTING, STATE_SETTING, STATE_PAUSE = 24, 25, 26
STEP_SINGLE, STEP_MULTIPLE, STEP_ACTION = 31, 32, 33

# Of SimulationState.msg.
STOPPED, PLAYING, PAUSED, QUITTING = range(4)

# Of Result.msg, and of SetSimulationState.srv.
FEATURE_UNSUPPORTED, OK, OPERATION_FAILED = 0, 1, 4
ALREADY_IN_TARGET_STATE, INCORRECT_TRANSITION = 101, 103
LONGEST = 86_400 * SECOND  # longest step of a single request, nanoseconds of the run's clock


class SimulationServices:
    """Services to show and set whether simulated time runs, and to step time."""

    def __init__(self, server: ServiceServer) -> None:
        self._server = server
        self._stepping = server.node.stepping
        self.step = round(server.node.config.step * SECOND)  # length of a step, nanoseconds

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
        if reason := self._stepping.fixed():
            return FEATURE_UNSUPPORTED, reason
        if (state := self._stepping.state) != "paused":
            return OPERATION_FAILED, f"expected time to stand, found it {state}"
        most = LONGEST // self.step
        if not 0 < steps <= most:
            return OPERATION_FAILED, f"expected 1 to {most} steps, found {steps}"
        return None

    def result(self, result: int, message: str = "") -> dict[str, Any]:
        """Return the ``result`` field of a response."""
        return {"result": self._make("Result", result=result, error_message=message)}

    async def _features(self, _: Any) -> dict[str, Any]:
        ids = [STATE_GETTING, STATE_SETTING]
        reason = self._stepping.fixed()
        if not reason:
            ids += [STATE_PAUSE, STEP_SINGLE, STEP_MULTIPLE, STEP_ACTION]
        info = reason or f"a step is {self.step / SECOND:g} s of simulated time"
        kind, features = "SimulatorFeatures", np.array(ids, np.uint16)
        message = self._make(kind, features=features, spawn_formats=[], custom_info=info)
        return {"features": message}

    async def _state(self, _: Any) -> dict[str, Any]:
        state = self._make("SimulationState", state=self._now())
        return {"state": state, **self.result(OK)}

    async def _set_state(self, request: Any) -> dict[str, Any]:
        target = request.state.state
        if target in {STOPPED, QUITTING}:
            self._server.node.stop("ended by ROS")
            return self.result(OK)
        if target not in {PLAYING, PAUSED}:
            return self.result(INCORRECT_TRANSITION, f"expected a state of 0 to 3, found {target}")
        if target == self._now():
            return self.result(ALREADY_IN_TARGET_STATE)
        if reason := self._stepping.fixed():
            return self.result(FEATURE_UNSUPPORTED, reason)
        if target == PLAYING:
            self._stepping.resume()
        else:
            self._stepping.pause()
        return self.result(OK)

    async def _steps(self, request: Any) -> dict[str, Any]:
        if refusal := self.refusal(request.steps):
            return self.result(*refusal)
        ns = request.steps * self.step
        if (elapsed := await self._stepping.step(ns)) < ns:
            text = f"ended after {elapsed / SECOND:g} of {ns / SECOND:g} s: by another request"
            return self.result(OPERATION_FAILED, text)
        return self.result(OK)

    async def _reset(self, _: Any) -> dict[str, Any]:
        return self.result(FEATURE_UNSUPPORTED, "a run begins once: end it, and start another")

    def _now(self) -> int:
        return PAUSED if self._stepping.state == "paused" else PLAYING

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._server.store.message(f"simulation_interfaces/msg/{kind}")(**fields)


# Of GoalStatus.msg, and of CancelGoal.srv.
UNKNOWN, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 0, 2, 3, 4, 5, 6
NO_ERROR, UNKNOWN_GOAL, GOAL_TERMINATED = 0, 2, 3
STORED_RESULTS, PERIOD = 16, 0.2  # goals with kept results; real seconds between feedback messages


class _Goal:
    """A client's goal: steps from simulated time `start_time` (ns); `info` is its GoalInfo."""

    def __init__(self, info: Any, steps: int, start_time: int) -> None:
        self.info, self.steps, self.start_time = info, steps, start_time
        self.status, self.result, self.over = EXECUTING, dict[str, Any](), asyncio.Event()


class SimulateSteps:
    """Action ``simulate_steps``: steps simulated time for a single goal at a time."""

    def __init__(self, server: ServiceServer, simulation: SimulationServices) -> None:
        self._server, self._simulation = server, simulation
        self._clock, self._stepping = server.node.clock, server.node.stepping
        self._message = server.store.message
        self._goals: dict[bytes, _Goal] = {}  # by id, the oldest first; at most one is not over

    def declare(self) -> None:
        """Declare topics and services; called in any thread."""
        below, array = "simulate_steps/_action", "action_msgs/msg/GoalStatusArray"
        declare, publisher = self._server.declare, self._server.publisher
        self._status = publisher(f"{below}/status", array, Qos(transient_local=True, depth=1))
        self._feedback_publisher = publisher(f"{below}/feedback", f"{STEPS}_FeedbackMessage", Qos())
        declare(f"{below}/cancel_goal", CANCEL_GOAL, self._cancel)
        declare(f"{below}/get_result", f"{STEPS}_GetResult", self._get_result)
        declare(f"{below}/send_goal", f"{STEPS}_SendGoal", self._send_goal)

    async def _send_goal(self, request: Any) -> dict[str, Any]:
        now, id_, steps = self._clock.now(), bytes(request.goal_id.uuid), request.goal.steps
        sec, nanosec = divmod(now, SECOND)
        stamp = self._message("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
        if id_ in self._goals:
            return {"accepted": False, "stamp": stamp}
        if len(self._goals) == STORED_RESULTS:
            del self._goals[next(k for k, goal in self._goals.items() if goal.over.is_set())]
        info = self._message("action_msgs/msg/GoalInfo")(goal_id=request.goal_id, stamp=stamp)
        goal = self._goals[id_] = _Goal(info, steps, now)
        if refusal := self._simulation.refusal(steps):
            self._set(goal, ABORTED, *refusal)
        else:
            self._set(goal, EXECUTING)
            stepped = self._stepping.step(steps * self._simulation.step)
            stepped.add_done_callback(functools.partial(self._stepped, goal))
            threading.Thread(
                target=self._publish_feedback_until_over, args=(goal,), daemon=True
            ).start()
        return {"accepted": True, "stamp": stamp}

    def _publish_feedback_until_over(self, goal: _Goal) -> None:
        """Publish feedback during steps, from a thread, as the loop's time is simulated."""
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            while not goal.over.is_set():
                time.sleep(PERIOD)
                elapsed = self._clock.now() - goal.start_time
                self._server.loop.call_soon_threadsafe(self._publish_feedback, goal, elapsed)

    def _publish_feedback(self, goal: _Goal, elapsed: int) -> int:
        """Publish and return the number of steps done after `elapsed` ns."""
        done = min(elapsed // self._simulation.step, goal.steps)
        if not goal.over.is_set():
            counts = {"completed_steps": done, "remaining_steps": goal.steps - done}
            feedback = self._message(f"{STEPS}_Feedback")(**counts)
            self._feedback_publisher(goal_id=goal.info.goal_id, feedback=feedback)
        return done

    def _stepped(self, goal: _Goal, stepped: asyncio.Future[int]) -> None:
        done = self._publish_feedback(goal, stepped.result())
        progress = f"after {done} of {goal.steps} steps"
        if done == goal.steps:
            self._set(goal, SUCCEEDED, OK)
        elif goal.status == CANCELING:
            self._set(goal, CANCELED, OPERATION_FAILED, f"canceled {progress}")
        else:
            self._set(goal, ABORTED, OPERATION_FAILED, f"ended from elsewhere {progress}")

    def _set(self, goal: _Goal, status: int, *result: Any) -> None:
        """Publish a status; a result ends the goal for good."""
        if goal.over.is_set():
            return
        if result:
            goal.result = self._simulation.result(*result)
            goal.over.set()
        goal.status = status
        make, goals = self._message("action_msgs/msg/GoalStatus"), self._goals.values()
        self._status(
            status_list=[make(goal_info=entry.info, status=entry.status) for entry in goals]
        )

    async def _get_result(self, request: Any) -> dict[str, Any]:
        status, result = UNKNOWN, self._simulation.result(OPERATION_FAILED, "no such goal is known")
        if goal := self._goals.get(bytes(request.goal_id.uuid)):
            try:
                await goal.over.wait()
            except asyncio.CancelledError:  # the client must not wait for ever
                self._set(goal, ABORTED, OPERATION_FAILED, "the run has ended")
            status, result = goal.status, goal.result
        return {"status": status, "result": self._message(f"{STEPS}_Result")(**result)}

    async def _cancel(self, request: Any) -> dict[str, Any]:
        """Cancel the goal of an id, or accepted up to a time; if neither is given, any."""
        id_, stamp = bytes(request.goal_info.goal_id.uuid), request.goal_info.stamp
        until = stamp.sec * SECOND + stamp.nanosec
        for goal_id, goal in self._goals.items():
            matches_time = goal.start_time <= until if until else not any(id_)
            if not goal.over.is_set() and (goal_id == id_ or matches_time):
                self._set(goal, CANCELING)
                self._stepping.pause()
                return {"return_code": NO_ERROR, "goals_canceling": [goal.info]}
        code = GOAL_TERMINATED if id_ in self._goals else UNKNOWN_GOAL
        return {"return_code": code if any(id_) else NO_ERROR, "goals_canceling": []}


class _Order(NamedTuple):
    """Command, event of completion, time limit (s); superfluous if the vehicle is (not) armed."""

    command: type[Command]
    done: type[VehicleEvent]
    limit: float
    superfluous: bool | None = None


_ORDERS = {
    "arm": _Order(events.Arm, events.Armed, 1.0, superfluous=True),
    "disarm": _Order(events.Disarm, events.Disarmed, 1.0, superfluous=False),
    "take_off": _Order(events.Takeoff, events.TakenOff, 60.0),
    "land": _Order(events.Land, events.Landed, 300.0, superfluous=False),
}


class VehicleServices:
    """Sends commands to vehicles, and waits until they are carried out."""

    def __init__(self, server: ServiceServer, send: Callable[[Command], None]) -> None:
        self._server = server
        self._node = server.node
        self._send = send
        self._armed: dict[str, bool] = {}  # whether a vehicle is armed, by name, where known
        self._waiting: set[tuple[str, type[VehicleEvent], asyncio.Future[None]]] = set()

    def declare(self, vehicle: str) -> None:
        """Declare the services of a vehicle; called in any thread."""
        if not self._node.restarts:
            self._armed[vehicle] = False
        for name, order in _ORDERS.items():

            async def serve(_: Any, order: _Order = order) -> dict[str, Any]:
                success, message = await self._execute(vehicle, order)
                return {"success": success, "message": message}

            self._server.declare(f"{ros_name(vehicle)}/{name}", TRIGGER, serve)

    def handle_event(self, event: VehicleEvent) -> None:
        """Record a vehicle's event, and complete the requests waiting for its type."""
        if isinstance(event, events.Armed | events.Disarmed):
            self._armed[event.source] = isinstance(event, events.Armed)
        for vehicle, done, waiter in self._waiting:
            if vehicle == event.source and isinstance(event, done) and not waiter.done():
                waiter.set_result(None)

    async def _execute(self, vehicle: str, order: _Order) -> tuple[bool, str]:
        if self._armed.get(vehicle) is order.superfluous is not None:
            return True, f"{vehicle} is {'armed' if order.superfluous else 'disarmed'} already"
        waiter = asyncio.get_running_loop().create_future()
        waiting = (vehicle, order.done, waiter)
        self._waiting.add(waiting)
        try:
            now, source = self._node.clock.now(), self._node.name
            self._send(order.command(stamp=now, source=source, vehicle=vehicle))
            if self._node.stepping.state == "paused":  # the client itself steps the time
                return True, f"{order.command.__name__} is sent; time stands"
            async with asyncio.timeout(order.limit):
                await waiter
        except TimeoutError:
            name, done = order.command.__name__, order.done.__name__
            return False, f"{vehicle} did not say {done} within {order.limit:g} s of {name}"
        finally:
            self._waiting.discard(waiting)
        return True, order.done.__name__


class Services(ServiceServer):
    """Services of a bridge; commands to vehicles go by `send`."""

    def __init__(self, send: Callable[[Command], None], *server: Any) -> None:
        super().__init__(*server)
        self._vehicles = VehicleServices(self, send)
        self.handle_event = self._vehicles.handle_event

    def offer(self, vehicles: Iterable[str]) -> None:
        """Declare all services of the settings, for these vehicles; called in a thread."""
        for type_, definition in DEFINITIONS.items():
            self.store.add(type_, definition)
        if "simulation" in self.node.config.services:
            simulation = SimulationServices(self)
            SimulateSteps(self, simulation).declare()
            simulation.declare()
        if "vehicle" in self.node.config.services:
            for vehicle in vehicles:
                self._vehicles.declare(vehicle)
