"""Has time stepped by the action SimulateSteps with zenoh-ros2-sdk, in a process of its own.

    python sdk_action.py PORT STEPS...

That client knows services and topics, of which actions are made. One goal after the other does so
many steps; the last is canceled once there is feedback. Then time runs. What was heard is printed
as JSON. Hashes are the client's own, but for the services of the action: it knows no such types.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np

from tests.nodes.ros2.bridge.sdk_services import discovery, sdk, sessions, utils

PORT = int(sys.argv[1])
WHERE: dict[str, Any] = {"router_ip": "127.0.0.1", "router_port": PORT, "domain_id": 0}
ACTION, BELOW = "simulation_interfaces/action/SimulateSteps", "/simulate_steps/_action"
ID, FEEDBACK = "unique_identifier_msgs/UUID goal_id", f"{ACTION}_Feedback feedback"
MESSAGES = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "unique_identifier_msgs/msg/UUID": "uint8[16] uuid",
    "action_msgs/msg/GoalInfo": f"{ID}\nbuiltin_interfaces/Time stamp",
    "action_msgs/msg/GoalStatus": "action_msgs/GoalInfo goal_info\nint8 status",
    "simulation_interfaces/msg/Result": "uint8 result\nstring error_message",
    "simulation_interfaces/msg/SimulationState": "uint8 state",
    f"{ACTION}_Goal": "uint64 steps",
    f"{ACTION}_Result": "simulation_interfaces/Result result",
    f"{ACTION}_Feedback": "uint64 completed_steps\nuint64 remaining_steps",
}


def service(name: str, type_: str, request: str, response: str) -> Any:
    info, end = None, time.monotonic() + 300
    while (info is None or not info.servers) and time.monotonic() < end:
        info = discovery.get_service_info(name, verbose=True, **WHERE)
    assert info is not None
    hash_ = utils.compute_service_type_hash(type_, request, response, MESSAGES)
    hash_ = info.servers[0].type_hash if "/action/" in type_ else hash_
    return sdk.ROS2ServiceClient(name, type_, request, response, type_hash=hash_, **WHERE)


def subscribe(name: str, type_: str, definition: str, take: Any) -> Any:
    hash_ = utils.get_type_hash(type_, msg_definition=definition, dependencies=MESSAGES)
    topic = f"{BELOW}/{name}"
    return sdk.ROS2Subscriber(topic, type_, take, definition, type_hash=hash_, **WHERE)


def main() -> None:
    session = sessions.ZenohSession.get_instance("127.0.0.1", PORT)
    for type_, definition in MESSAGES.items():
        session.register_message_type(definition, type_)
    make = session.store.types
    send = service(
        f"{BELOW}/send_goal",
        f"{ACTION}_SendGoal",
        f"{ID}\n{ACTION}_Goal goal",
        "bool accepted\nbuiltin_interfaces/Time stamp",
    )
    result = service(
        f"{BELOW}/get_result",
        f"{ACTION}_GetResult",
        ID,
        f"int8 status\n{ACTION}_Result result",
    )
    cancel = service(
        f"{BELOW}/cancel_goal",
        "action_msgs/srv/CancelGoal",
        "action_msgs/GoalInfo goal_info",
        "int8 return_code\naction_msgs/GoalInfo[] goals_canceling",
    )
    play = service(
        "/set_simulation_state",
        "simulation_interfaces/srv/SetSimulationState",
        "simulation_interfaces/SimulationState state",
        "simulation_interfaces/Result result",
    )
    feedback: list[tuple[int, int]] = []
    statuses: list[list[int]] = []

    def told(message: Any) -> None:
        counts = message.feedback
        feedback.append((counts.completed_steps, counts.remaining_steps))

    kept = [
        subscribe("feedback", f"{ACTION}_FeedbackMessage", f"{ID}\n{FEEDBACK}", told),
        subscribe(
            "status",
            "action_msgs/msg/GoalStatusArray",
            "action_msgs/GoalStatus[] status_list",
            lambda message: statuses.append([status.status for status in message.status_list]),
        ),
    ]
    results, steps = [], [int(word) for word in sys.argv[2:]]
    zero = make["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    for number, count in enumerate(steps, 1):
        id_ = make["unique_identifier_msgs/msg/UUID"](uuid=np.full(16, number, np.uint8))
        heard = len(feedback)
        assert send.call(goal_id=id_, goal=make[f"{ACTION}_Goal"](steps=count)).accepted
        if number == len(steps):
            while len(feedback) == heard:
                time.sleep(0.01)
            info = make["action_msgs/msg/GoalInfo"](goal_id=id_, stamp=zero)
            assert len(cancel.call(goal_info=info).goals_canceling) == 1
        reply = result.call(goal_id=id_)
        results.append((reply.status, reply.result.result.result))
    play.call(state=make["simulation_interfaces/msg/SimulationState"](state=1))
    print(json.dumps({"results": results, "feedback": feedback, "statuses": statuses}))
    del kept
    session.close()


if __name__ == "__main__":
    main()
