"""From bytes to events: whatever the bytes are, an event or nothing, and never an exception."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import EstimatorAnnouncement, Event, FluidPressure, Imu, MagneticField, NavSatFix, Range
from nodes.ros2.bridge.incoming_topic import IncomingTopic
from nodes.ros2.bridge.keys import Complaints
from nodes.ros2.bridge.settings import Ros2BridgeConfig, Subscription
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.images import ImageWriter
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.typestore import MessageError, Stamps, TypeStore
from tests.nodes.ros2.bridge.mappings import Battery
from tests.nodes.ros2.messages import samples

HERE = "tests.nodes.ros2.bridge.mappings"
NOW = 10_000_000_000


class Ear:
    """A incoming, and what it complained of."""

    def __init__(self, type_: str, use: str = "", mapping: str = "") -> None:
        self.said: list[str] = []
        self.complaints = Complaints(self.said.append)
        table = Subscription(topic="/t", type=type_, use=use, mapping=mapping)
        self.incoming = IncomingTopic(
            table, Ros2BridgeConfig(), samples.store(), "ros2", self.complaints
        )

    def hear(self, data: bytes) -> Event | None:
        return self.incoming.event(data, NOW, Stamps())


def valid(type_: str) -> bytes:
    """Return a message of a type, as sane as can be."""
    store = samples.store()
    make, header = store.message, store.header((3, 7), "map")
    vector = make("geometry_msgs/msg/Vector3")(x=1.0, y=2.0, z=3.0)
    twist = make("geometry_msgs/msg/Twist")(linear=vector, angular=vector)
    common: dict[str, Any] = {"stamp": samples.STAMP, "source": "s"}
    odometry = samples.message(outgoing.odometry, samples.odometry())
    message: Any
    match type_.rpartition("/")[2]:
        case "Odometry":
            message = odometry
        case "Twist":
            message = twist
        case "TwistStamped":
            message = make(type_)(header=header, twist=twist)
        case "Image":
            pixels = np.zeros((3, 4, 3), np.uint8)
            return bytes(ImageWriter(store, "f", "rgb8").write((3, 7), pixels))
        case "CameraInfo":
            message = samples.calibration(samples.camera())
        case "Imu":
            imu = Imu(**common, angular_velocity=(1, 2, 3), linear_acceleration=(1, 2, 3))
            message = samples.message(outgoing.imu, imu)
        case "Range":
            event = Range(**common, range=1.5, min_range=0.5, max_range=4.0)
            message = samples.message(outgoing.distance, event)
        case "FluidPressure":
            pressure = FluidPressure(**common, fluid_pressure=1e5)
            message = samples.message(outgoing.pressure, pressure)
        case "MagneticField":
            field = MagneticField(**common, magnetic_field=(1e-5, 2e-5, 3e-5))
            message = samples.message(outgoing.magnetic_field, field)
        case "NavSatFix":
            fix = NavSatFix(**common, latitude=47.0, longitude=8.0, altitude=400.0)
            message = samples.message(outgoing.fix, fix)
        case "Path":
            pose = make("geometry_msgs/msg/PoseStamped")(header=header, pose=odometry.pose.pose)
            message = make(type_)(header=header, poses=[pose])
        case name:
            inner = odometry.pose if "Covariance" in name else odometry.pose.pose
            message = make(type_)(header=header, pose=inner)
    return bytes(store.serialize(message))


ALL = sorted(key for key, row in READERS.items() if row.use != "done" and not row.bags)
"""But for what becomes no event."""


@pytest.mark.parametrize(("type_", "use"), ALL)
def test_every_reader_reads_what_is_sane_and_refuses_what_is_cut_off(type_: str, use: str) -> None:
    ear, data = Ear(type_, use), valid(type_)
    if use == "depth":  # an rgb8 image is none
        assert ear.hear(data) is None
        assert ear.said[0].startswith("/t: message refused: encoding: expected 32FC1")
    else:
        assert (ear.hear(data) is None) == (use == "camera")
        assert ear.said == []
    ear = Ear(type_, use)
    for length in range(len(data) - 3):  # up to three bytes may be padding
        assert ear.hear(data[:length]) is None
    assert sum(ear.complaints.counts.values()) == len(data) - 3
    assert len(ear.said) == 1


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(ALL), st.data())
def test_garbled_messages_become_events_or_nothing(
    of: tuple[str, str], data: st.DataObject
) -> None:
    ear, message = Ear(*of), bytearray(valid(of[0]))
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(message) - 1))
        message[place] = data.draw(st.integers(0, 255))
    message += data.draw(st.binary(max_size=16))
    event = ear.hear(bytes(message))
    assert event is None or isinstance(event, Event)
    assert bool(ear.said) != (event is not None) or of[1] == "camera"


@pytest.mark.slow
@settings(max_examples=150)
@given(st.sampled_from(ALL), st.binary(max_size=400))
def test_noise_becomes_events_or_nothing(of: tuple[str, str], noise: bytes) -> None:
    for data in (noise, b"\0\1\0\0" + noise, b"\0\0\0\0" + noise):
        event = Ear(*of).hear(data)
        assert event is None or isinstance(event, Event)


def test_a_sequence_that_lies_about_its_length_takes_no_memory() -> None:
    data = bytearray(valid("sensor_msgs/msg/Image"))
    at = len(data) - 36 - 4
    assert data[at : at + 4] == (36).to_bytes(4, "little")
    data[at : at + 4] = b"\xff\xff\xff\xff"
    with pytest.raises(MessageError, match="Invalid sequence length"):
        samples.store().deserialize(bytes(data), "sensor_msgs/msg/Image")


def battery(percentage: float) -> bytes:
    make: Any = samples.store().message
    header = samples.store().header((3, 7), "f")
    nothing = np.zeros(0, np.float32)
    fields = [12.0, 20.0, 1.0, 1.0, 1.0, 1.0, percentage, 0, 0, 0, True, nothing, nothing, "", ""]
    return bytes(samples.store().serialize(make("sensor_msgs/msg/BatteryState")(header, *fields)))


def test_a_mapping_of_the_user_s_own_makes_events() -> None:
    ear = Ear("sensor_msgs/msg/BatteryState", mapping=f"{HERE}:battery")
    assert ear.hear(battery(0.5)) == Battery(stamp=3_000_000_007, source="ros2/t", percentage=0.5)
    assert ear.hear(battery(-1.0)) is None
    assert ear.said == []


@pytest.mark.parametrize(
    ("name", "message"), [("broken", "KeyError"), ("no_event", "expected an event, found str")]
)
def test_a_mapping_that_fails_is_left_out(name: str, message: str) -> None:
    ear = Ear("sensor_msgs/msg/BatteryState", mapping=f"{HERE}:{name}")
    assert ear.hear(battery(0.5)) is None
    assert ear.said[0].startswith("/t: mapping failed")
    assert message in ear.said[0]


@pytest.mark.parametrize("name", ["no.such:thing", f"{HERE}:nothing", f"{HERE}:HERE"])
def test_a_mapping_that_is_not_there_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=r"/t: mapping: expected (a function|something)"):
        Ear("sensor_msgs/msg/BatteryState", mapping=name)


def test_types_may_be_defined_by_files(tmp_path: Path) -> None:
    file = tmp_path / "Wind.msg"
    file.write_text("std_msgs/Header header\nfloat64 speed\n")
    store = TypeStore("jazzy", {"weather_msgs/msg/Wind": str(file)})
    make: Any = store.message("weather_msgs/msg/Wind")
    data = store.serialize(make(header=store.header((1, 2), "f"), speed=3.5))
    message = store.deserialize(bytes(data), "weather_msgs/msg/Wind")
    assert message.speed == 3.5
    assert len(store.hash("weather_msgs/msg/Wind")) == 71
    with pytest.raises(ValueError, match=r"weather_msgs/msg/Rain: expected a readable"):
        TypeStore("jazzy", {"weather_msgs/msg/Rain": str(tmp_path / "none.msg")})


@pytest.mark.parametrize(("answers_to", "cameras"), [("drone/camera", ("drone/camera",)), ("", ())])
def test_an_estimator_that_answers_images_announces_whose(
    answers_to: str, cameras: tuple[str, ...]
) -> None:
    table = Subscription(
        topic="/pose",
        type="geometry_msgs/msg/PoseStamped",
        use="estimate",
        answers_to=answers_to,
    )
    complaints = Complaints(lambda _: None)
    topic = IncomingTopic(table, Ros2BridgeConfig(), samples.store(), "ros2", complaints)
    (announced,) = topic.announce()
    assert isinstance(announced, EstimatorAnnouncement)
    assert announced.cameras == cameras
