"""Mappings of the user's own: from events to messages, and what may be wrong with them."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Imu
from nodes.ros2.bridge.incoming_topic import OutgoingTopic
from nodes.ros2.bridge.keys import Complaints
from nodes.ros2.bridge.settings import OwnPublication, Ros2BridgeConfig
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.typestore import MessageBuilder
from tests.nodes.ros2.bridge.mappings import Battery
from tests.nodes.ros2.messages import samples

TYPE = "sensor_msgs/msg/BatteryState"
HERE = "tests.nodes.ros2.bridge.mappings"
GIVEN = OwnPublication(
    topic="battery", type=TYPE, event=f"{HERE}:Battery", mapping=f"{HERE}:make_battery"
)


def builder() -> MessageBuilder:
    return MessageBuilder(samples.store(), FrameNames(), lambda stamp: divmod(stamp, 10**9))


def made(**changes: Any) -> tuple[OutgoingTopic, Counter[tuple[str, str]], list[str]]:
    lines: list[str] = []
    complaints = Complaints(lines.append)
    given = msgspec.structs.replace(GIVEN, **changes)
    config = Ros2BridgeConfig(namespace="/fleet")
    return OutgoingTopic(given, config, samples.store(), complaints), complaints.counts, lines


def battery(percentage: float = 0.75, source: str = "drone/pack") -> Battery:
    return Battery(stamp=3_000_000_007, source=source, percentage=percentage)


def test_an_event_becomes_a_message() -> None:
    outgoing, wrong, _ = made()
    assert outgoing.topic.name == "/fleet/battery"
    data = outgoing.message(battery(), builder())
    assert data is not None
    message: Any = samples.store().deserialize(bytes(data), TYPE)
    assert message.percentage == 0.75
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 7)
    assert (message.header.frame_id, message.present, message.location) == ("base_link", True, "")
    assert not wrong


def test_a_mapping_may_say_nothing() -> None:
    outgoing, wrong, _ = made()
    assert outgoing.message(battery(-1.0), builder()) is None
    assert not wrong


@pytest.mark.parametrize(
    ("source", "wanted"),
    [("", True), ("drone", True), ("drone/pack", True), ("dron", False), ("drone/pack/1", False)],
)
def test_a_source_narrows_it(source: str, wanted: bool) -> None:
    outgoing, _, _ = made(source=source)
    assert outgoing.accepts(battery()) is wanted
    zero = (0.0, 0.0, 0.0)
    imu = Imu(stamp=0, source="drone/pack", angular_velocity=zero, linear_acceleration=zero)
    assert not outgoing.accepts(imu)


@pytest.mark.parametrize(
    ("mapping", "what"),
    [
        ("make_broken", "KeyError"),
        ("make_another_type", "expected a sensor_msgs/msg/BatteryState, found std_msgs/msg/Float"),
        ("make_nonsense", "expected a sensor_msgs/msg/BatteryState, found str"),
        ("make_a_text_for_a_number", "mapping failed"),
        ("make_no_such_field", "has no field 'charm'"),
    ],
)
def test_what_a_mapping_does_wrong_is_counted_and_told(mapping: str, what: str) -> None:
    outgoing, wrong, lines = made(mapping=f"{HERE}:{mapping}")
    assert outgoing.message(battery(), builder()) is None
    assert wrong == {("/fleet/battery", "mapping failed"): 1}
    assert what in lines[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"type": "a/msg/B"}, "/fleet/battery: expected a known message type"),
        ({"event": f"{HERE}:Nothing"}, "battery: event: expected something that can be imported"),
        ({"event": f"{HERE}:make_battery"}, "battery: event: expected a type of event"),
        ({"mapping": "no_such_module:f"}, "battery: mapping: expected something that can be impor"),
        ({"mapping": f"{HERE}:PERCENT"}, "battery: mapping: expected a function, found 100"),
    ],
)
def test_what_cannot_be_is_refused_at_the_start(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(**changes)


@pytest.mark.parametrize("field", ["event", "mapping"])
def test_a_path_has_a_module_and_a_name(field: str) -> None:
    table = {"topic": "b", "type": TYPE, "event": "a:B", "mapping": "a:b", field: "a.b"}
    with pytest.raises(msgspec.ValidationError, match=f'b: {field}: expected "module:'):
        msgspec.convert(table, OwnPublication)


@pytest.mark.parametrize(
    "type_",
    [TYPE, "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Path", "sensor_msgs/msg/PointCloud2"],
)
def test_messages_of_zeros_can_be_written_and_read(type_: str) -> None:
    zero = samples.store().zero(type_)
    back: Any = samples.store().deserialize(bytes(samples.store().serialize(zero)), type_)
    assert back.header.frame_id == ""
    if hasattr(back, "position_covariance"):
        np.testing.assert_array_equal(back.position_covariance, np.zeros(9))
