"""Calls services with zenoh-ros2-sdk, a client that nobody here wrote, in a process of its own.

    python sdk_services.py PORT

Each line of standard input is a call as JSON: its id, the service's name, type and two definitions,
the fields of the request, and seconds. Each line of standard output is an answer: the id and the
response, or null. Types' hashes are the client's own, from the definitions given to it.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
import time
from typing import Any

from tests.nodes.ros2.bridge.sdk_client import brief

sdk: Any = importlib.import_module("zenoh_ros2_sdk")
discovery: Any = importlib.import_module("zenoh_ros2_sdk.discovery")
sessions: Any = importlib.import_module("zenoh_ros2_sdk.session")
utils: Any = importlib.import_module("zenoh_ros2_sdk.utils")

MESSAGES = {
    "simulation_interfaces/msg/Result": "uint8 result\nstring error_message",
    "simulation_interfaces/msg/SimulationState": "uint8 state",
    "simulation_interfaces/msg/SimulatorFeatures": (
        "uint16[] features\nstring[] spawn_formats\nstring custom_info"
    ),
}
EMPTY = "uint8 structure_needs_at_least_one_member"
lock = threading.Lock()
known: set[str] = set()


def made(session: Any, value: Any) -> Any:
    """Return a field of a request, made from JSON; a message names its type."""
    if not isinstance(value, dict):
        return value
    fields = {name: made(session, field) for name, field in value.items() if name != "type"}
    return session.store.types[value["type"]](**fields)


def call(port: int, asked: dict[str, Any]) -> Any:
    where: dict[str, Any] = {"router_ip": "127.0.0.1", "router_port": port, "domain_id": 0}
    name, type_, end = asked["name"], asked["type"], time.monotonic() + asked["seconds"]
    while name not in known and discovery.get_service_info(name, **where) is None:
        if time.monotonic() > end:
            return f"no service {name}"
    known.add(name)
    session = sessions.ZenohSession.get_instance("127.0.0.1", port)
    request, response = (part.strip() or EMPTY for part in asked["definition"].split("---"))
    with lock:  # the client's store is not for threads
        for message, definition in MESSAGES.items():
            session.register_message_type(definition, message)
        client = sdk.ROS2ServiceClient(
            service_name=name,
            srv_type=type_,
            request_definition=request,
            response_definition=response,
            type_hash=utils.compute_service_type_hash(type_, request, response, MESSAGES),
            timeout=asked["seconds"],
            **where,
        )
    fields = {key: made(session, value) for key, value in asked["fields"].items()}
    if request == EMPTY:
        fields["structure_needs_at_least_one_member"] = 0
    return brief(client.call(**fields))


def answer(port: int, asked: dict[str, Any]) -> None:
    response = call(port, asked)
    with lock:
        print(json.dumps({"id": asked["id"], "response": response}), flush=True)


def main() -> None:
    for line in sys.stdin:
        asked = json.loads(line)
        threading.Thread(target=answer, args=(int(sys.argv[1]), asked), daemon=True).start()


if __name__ == "__main__":
    main()
