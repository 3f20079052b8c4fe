"""The action SimulateSteps as a plain Zenoh session uses it: its states, and what ends a goal."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh

from nodes.ros2.bridge.keys import Attachment, pack
from nodes.ros2.bridge.services import STORED_RESULTS
from nodes.ros2.messages.topics import CANCEL_GOAL, DEFINITIONS, STEPS
from nodes.ros2.messages.typestore import TypeStore
from runtime.config.model import Config, NodeSpec, RunConfig
from runtime.run.execute import execute
from tests.nodes.ros2.bridge.test_services import GID, STORE, Client, driven

ACTION = "/simulate_steps/_action"
EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = 2, 3, 4, 5, 6
FOREVER = 86_400_000
"""Steps of 1 ms: more than a test waits for."""


class ActionClient:
    """Sends goals, and hears of them."""

    def __init__(self, client: Client) -> None:
        self.client = client
        client.key(f"{ACTION}/send_goal")  # declared last, so all is there
        kinds = {"feedback": f"{STEPS}_FeedbackMessage"}
        kinds["status"] = "action_msgs/msg/GoalStatusArray"
        self.heard: dict[str, queue.SimpleQueue[Any]] = {}
        self._subscribers = []
        for name, type_ in kinds.items():
            package, folder, kind = type_.split("/")
            key = f"0{ACTION}/{name}/{package}::{folder}::dds_::{kind}_/{STORE.hash(type_)}"
            heard = self.heard[name] = queue.SimpleQueue()

            def hear(sample: zenoh.Sample, type_: str = type_, heard: Any = heard) -> None:
                heard.put(STORE.deserialize(sample.payload.to_bytes(), type_))

            self._subscribers.append(client.session.declare_subscriber(key, hear))

    def send(self, id_: int, steps: int) -> bool:
        goal = STORE.message(f"{STEPS}_Goal")(steps=steps)
        type_ = f"{STEPS}_SendGoal"
        response = self.client.call(f"{ACTION}/send_goal", type_, goal_id=uuid(id_), goal=goal)
        accepted: bool = response.accepted
        return accepted

    def result(self, id_: int) -> tuple[int, int, str]:
        type_ = f"{STEPS}_GetResult"
        response = self.client.call(f"{ACTION}/get_result", type_, goal_id=uuid(id_))
        result = response.result.result
        return response.status, result.result, result.error_message

    def cancel(self, id_: int, stamp: tuple[int, int] = (0, 0)) -> tuple[int, list[int]]:
        time = STORE.message("builtin_interfaces/msg/Time")(sec=stamp[0], nanosec=stamp[1])
        info = STORE.message("action_msgs/msg/GoalInfo")(goal_id=uuid(id_), stamp=time)
        response = self.client.call(f"{ACTION}/cancel_goal", CANCEL_GOAL, goal_info=info)
        return response.return_code, [number(goal) for goal in response.goals_canceling]

    def feedback(self) -> tuple[int, int, int]:
        message = self.heard["feedback"].get(timeout=20)
        counts = message.feedback
        return number(message), counts.completed_steps, counts.remaining_steps

    def statuses(self) -> dict[int, int]:
        message = self.heard["status"].get(timeout=20)
        return {number(status.goal_info): status.status for status in message.status_list}


def uuid(id_: int) -> Any:
    data = np.frombuffer(id_.to_bytes(16, "big"), np.uint8)
    return STORE.message("unique_identifier_msgs/msg/UUID")(uuid=data)


def number(of: Any) -> int:
    return int.from_bytes(bytes(of.goal_id.uuid), "big")


def acted(drive: Callable[[ActionClient], None], **config: Any) -> Any:
    return driven(lambda client: drive(ActionClient(client)), **config)


@pytest.mark.parametrize(
    ("type_", "expected"),
    [  # of ROS 2 Jazzy's own type descriptions of example_interfaces and action_msgs
        ("X_SendGoal", "d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557"),
        ("X_GetResult", "1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57"),
        ("X_FeedbackMessage", "c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2"),
        (CANCEL_GOAL, "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a"),
    ],
)
def test_parts_of_actions_have_the_hashes_that_ros_gives_them(type_: str, expected: str) -> None:
    """The definitions are those of SimulateSteps, with another action's fields in their places."""
    name, store = "example_interfaces/action/Fibonacci", TypeStore()
    own = {"Goal": "int32 order", "Result": "int32[] sequence", "Feedback": "int32[] sequence"}
    for type_name, definition in DEFINITIONS.items():
        part = type_name.rpartition("_")[2]
        if type_name.startswith(STEPS):
            text = own.get(part, definition.replace(STEPS, name))
            store.add(f"{name}_{part}", text)
    store.add(CANCEL_GOAL, DEFINITIONS[CANCEL_GOAL])
    assert store.hash(type_.replace("X", name)) == f"RIHS01_{expected}"


@pytest.mark.slow
def test_a_goal_steps_time_and_tells_how_far_it_is() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(7, 250)
        assert action.result(7) == (SUCCEEDED, 1, "")
        assert action.result(7) == (SUCCEEDED, 1, "")  # as often as one asks
        heard = [action.feedback()]
        while heard[-1][2]:
            heard.append(action.feedback())
        assert heard == sorted(heard)
        assert heard[-1] == (7, 250, 0)
        assert all(counts[1] + counts[2] == 250 for counts in heard)
        assert [action.statuses() for _ in range(2)] == [{7: EXECUTING}, {7: SUCCEEDED}]
        assert action.client.state() == 2
        assert action.client.step(1) == (1, "")

    result = acted(drive, step="2ms")
    assert result.seconds == 0.502


@pytest.mark.slow
def test_feedback_comes_while_steps_go_on_and_cancel_lets_time_stand() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, FOREVER)
        first, second = action.feedback(), action.feedback()
        while second[1] == first[1]:  # on a busy machine no step may fit between the two
            second = action.feedback()
        assert 0 <= first[1] < second[1] < FOREVER
        assert action.client.state() == 1
        assert action.cancel(9) == (2, [])
        assert action.cancel(1) == (0, [1])
        status, result, text = action.result(1)
        done = int(text.split()[2])
        assert (status, result) == (CANCELED, 4)
        assert text == f"canceled after {done} of {FOREVER} steps"
        assert second[1] <= done < FOREVER
        assert action.client.state() == 2
        assert action.cancel(1) == (3, [])
        assert action.cancel(0) == (0, [])
        expected = [{1: EXECUTING}, {1: CANCELING}, {1: CANCELED}]
        assert [action.statuses() for _ in expected] == expected
        assert action.send(2, 10)  # and the next one goes
        assert action.result(2) == (SUCCEEDED, 1, "")

    acted(drive)


@pytest.mark.slow
def test_all_goals_or_those_of_before_are_canceled() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, 1000)
        assert action.result(1)[0] == SUCCEEDED
        assert action.send(2, FOREVER)  # at 1 s
        assert action.cancel(0, (0, 999_999_999)) == (0, [])
        assert action.cancel(0, (1, 0)) == (0, [2])
        assert action.result(2)[0] == CANCELED
        assert action.send(3, FOREVER)
        assert action.cancel(0) == (0, [3])
        assert action.result(3)[0] == CANCELED

    acted(drive)


@pytest.mark.slow
def test_what_cannot_be_done_is_aborted_and_says_why() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, 0)
        assert action.result(1) == (ABORTED, 4, "expected 1 to 86400000 steps, found 0")
        assert action.send(2, 2**64 - 1)
        assert action.result(2)[:2] == (ABORTED, 4)
        assert action.client.set_state(1) == 1
        assert action.send(3, 1)
        assert action.result(3) == (ABORTED, 4, "expected time to stand, found it running")
        assert action.client.set_state(2) == 1
        assert action.send(4, FOREVER)
        assert not action.send(4, 1)  # that goal is there already
        assert action.send(5, 1)
        assert action.result(5) == (ABORTED, 4, "expected time to stand, found it stepping")
        assert action.client.step(1) == (4, "expected time to stand, found it stepping")
        assert action.client.set_state(2) == 1
        status, result, text = action.result(4)
        assert (status, result) == (ABORTED, 4)
        assert text.startswith("ended from elsewhere after ")
        assert action.result(6) == (0, 4, "no such goal is known")

    acted(drive)


@pytest.mark.slow
def test_goals_are_forgotten_but_for_the_last() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, FOREVER)
        for id_ in range(2, STORED_RESULTS + 3):
            assert action.send(id_, 1)
            assert action.result(id_)[0] == ABORTED
        assert action.result(2)[0] == 0
        assert action.result(STORED_RESULTS + 2)[0] == ABORTED
        assert action.cancel(1) == (0, [1])  # which goes on, and is kept
        assert action.result(1)[0] == CANCELED

    acted(drive)


@pytest.mark.slow
def test_the_end_of_the_run_aborts_a_goal() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, FOREVER)
        action.feedback()
        type_ = f"{STEPS}_GetResult"
        request = STORE.serialize(STORE.message(f"{type_}_Request")(goal_id=uuid(1)))
        key, attachment = action.client.key(f"{ACTION}/get_result"), pack(Attachment(1, 0, GID))
        session = action.client.session
        replies = session.get(key, payload=bytes(request), attachment=attachment, timeout=20.0)
        action.result(99)  # of no goal: once that is answered, the one before it waits
        assert action.client.set_state(0) == 1
        action.client.over = True
        (reply,) = replies
        assert reply.ok is not None
        response = STORE.deserialize(reply.ok.payload.to_bytes(), f"{type_}_Response")
        assert (response.status, response.result.result.result) == (ABORTED, 4)
        last = action.statuses()
        while last != {1: ABORTED}:
            last = action.statuses()

    assert acted(drive).reason == "ended by ROS"


@pytest.mark.slow
def test_real_time_aborts_and_says_that_it_cannot_be_stepped() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, 1)
        status, result, text = action.result(1)
        assert (status, result) == (ABORTED, 0)
        assert "the run is in real time" in text

    def run(nodes: list[NodeSpec]) -> str:
        return execute(Config(run=RunConfig(clock="real"), nodes=tuple(nodes))).reason

    assert acted(drive, run=run, paused=False) == "ended by ROS"


@pytest.mark.slow
def test_a_client_that_joins_late_gets_the_last_status() -> None:
    def drive(action: ActionClient) -> None:
        assert action.send(1, 1)
        assert action.result(1)[0] == SUCCEEDED
        type_ = "action_msgs/msg/GoalStatusArray"
        key = f"0{ACTION}/status/action_msgs::msg::dds_::GoalStatusArray_/{STORE.hash(type_)}"
        (reply,) = action.client.session.get(key, timeout=20.0)
        assert reply.ok is not None
        (state,) = STORE.deserialize(reply.ok.payload.to_bytes(), type_).status_list
        assert (number(state.goal_info), state.status) == (1, SUCCEEDED)

    acted(drive)
