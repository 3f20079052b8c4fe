"""The other side of the tests: zenoh-ros2-sdk, a client that nobody here wrote, in its process.

    python sdk_client.py PORT SECONDS TOPICS

Waits for so many topics, subscribes to each and decodes it, publishes a pose and a twist until it
has heard all, and prints what it saw as JSON. It gets the definitions of messages from rosbags,
since it would otherwise fetch them from the network; the types' hashes it takes from what is on
offer.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
import time
from typing import Any

from rosbags.typesys import Stores, get_typestore

sdk: Any = importlib.import_module("zenoh_ros2_sdk")
discovery: Any = importlib.import_module("zenoh_ros2_sdk.discovery")
qos: Any = importlib.import_module("zenoh_ros2_sdk.qos")
sessions: Any = importlib.import_module("zenoh_ros2_sdk.session")

STORE = get_typestore(Stores.ROS2_JAZZY)
LATCHED = qos.QosProfile(durability=qos.QosDurability.TRANSIENT_LOCAL, history_depth=1)


def definition(type_: str) -> str:
    return STORE.generate_msgdef(type_, ros_version=2)[0]


def brief(value: Any) -> Any:
    """Return a message as JSON has it; of arrays only the size and the first numbers."""
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value) if field.name[0] != "_"]
        return {name: brief(getattr(value, name)) for name in names}
    if hasattr(value, "tolist"):
        return {"size": len(value), "first": value[:4].tolist()}
    return [brief(element) for element in value] if isinstance(value, list) else value


def main() -> None:
    port, end = int(sys.argv[1]), time.monotonic() + float(sys.argv[2])
    where: dict[str, Any] = {"router_ip": "127.0.0.1", "router_port": port, "domain_id": 0}
    session = sessions.ZenohSession.get_instance("127.0.0.1", port)
    topics: dict[str, list[str]] = {}
    while len(topics) < int(sys.argv[3]) and time.monotonic() < end:
        topics = dict(discovery.get_topic_names_and_types(**where))
    nodes = {
        str(reply.ok.key_expr)
        for reply in session.liveliness.get("@ros2_lv/0/*/*/*/NN/**", timeout=2.0)
        if reply.ok is not None
    }
    heard: dict[str, Any] = {}
    subscribers = []
    for name, types in topics.items():
        type_ = types[0]
        info = discovery.get_topic_info(name, verbose=True, **where)
        if info is None or not info.publishers:
            continue
        subscribers.append(
            sdk.ROS2Subscriber(
                topic=name,
                msg_type=type_,
                callback=lambda message, name=name: heard.setdefault(name, brief(message)),
                msg_definition=definition(type_),
                type_hash=info.publishers[0].type_hash,
                qos=LATCHED if name == "/tf_static" else None,
                **where,
            )
        )
    out = []
    for topic, type_ in (
        ("/cmd_vel", "geometry_msgs/msg/Twist"),
        ("/slam/pose", "geometry_msgs/msg/PoseStamped"),
    ):
        out.append(
            sdk.ROS2Publisher(
                topic=topic,
                msg_type=type_,
                msg_definition=definition(type_),
                type_hash=STORE.hash_rihs01(type_),
                **where,
            )
        )
    make = session.store.types
    vector = make["geometry_msgs/msg/Vector3"]
    while len(heard) < len(subscribers) and time.monotonic() < end:
        time.sleep(0.05)
    for _ in range(20):
        out[0].publish(linear=vector(x=1.0, y=2.0, z=3.0), angular=vector(x=0.0, y=0.0, z=0.5))
        out[1].publish(
            header=make["std_msgs/msg/Header"](
                stamp=make["builtin_interfaces/msg/Time"](sec=0, nanosec=1), frame_id="map"
            ),
            pose=make["geometry_msgs/msg/Pose"](
                position=make["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0),
                orientation=make["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            ),
        )
        time.sleep(0.05)
    print(json.dumps({"topics": topics, "nodes": sorted(nodes), "heard": heard}))
    session.close()


if __name__ == "__main__":
    main()
