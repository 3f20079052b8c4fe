"""Small messages: what ROS reads in them."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    BarometerAnnouncement,
    FluidPressure,
    Imu,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatFix,
    PoseEstimate,
    PoseStamped,
    Range,
    RangeAnnouncement,
    Score,
    Wind,
)
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.outgoing import Outgoing
from nodes.ros2.messages.topics import PublishingConfig
from nodes.ros2.messages.transforms import Transform
from nodes.ros2.messages.typestore import Stamps, TypeStore
from tests.nodes.ros2.messages import samples
from tests.nodes.ros2.messages.samples import S

TIME = (3, 7)


def xyz(vector: Any) -> tuple[float, float, float]:
    return (vector.x, vector.y, vector.z)


def wxyz(q: Any) -> tuple[float, float, float, float]:
    return (q.w, q.x, q.y, q.z)


def test_odometry_has_its_pose_in_enu_and_its_twist_in_flu() -> None:
    message = samples.message(outgoing.odometry, samples.odometry())
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == TIME
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    assert xyz(message.pose.pose.position) == (2.5, 1.0, 3.0)
    np.testing.assert_allclose(wxyz(message.pose.pose.orientation), (1, 0, 0, 0), atol=1e-12)
    assert xyz(message.twist.twist.linear) == (1.0, -2.0, -3.0)
    assert xyz(message.twist.twist.angular) == (0.1, -0.2, -0.3)


def test_an_imu_at_rest_feels_the_ground_push_up() -> None:
    event = Imu(
        stamp=0,
        source="drone",
        angular_velocity=(1.0, 2.0, 3.0),
        linear_acceleration=(0.0, 0.0, -9.81),
    )
    message = samples.message(outgoing.imu, event, imu=samples.imu())
    assert xyz(message.linear_acceleration) == (0.0, 0.0, 9.81)
    assert xyz(message.angular_velocity) == (1.0, -2.0, -3.0)
    assert message.orientation_covariance[0] == -1.0
    np.testing.assert_allclose(message.angular_velocity_covariance[[0, 4, 8]], 0.001**2 * 200)
    np.testing.assert_allclose(message.linear_acceleration_covariance[[0, 4, 8]], 0.01**2 * 200)


def test_a_camera_s_pose_is_that_of_its_optical_frame() -> None:
    looking_north = (0.5, 0.5, 0.5, 0.5)
    camera = samples.camera()
    event = PoseStamped(
        stamp=0, source=camera.source, position=(1.0, 2.0, -3.0), orientation=looking_north
    )
    message = samples.message(outgoing.pose, event, camera)
    assert xyz(message.pose.position) == (2.0, 1.0, 3.0)
    # z (optical) points north, which is y in ENU; x (right) east; y down.
    w, x, y, z = wxyz(message.pose.orientation)
    np.testing.assert_allclose((abs(w), x / w, y, z), (S, -1, 0, 0), atol=1e-12)


def test_an_estimate_in_odom_is_turned_as_a_body_is() -> None:
    event = PoseEstimate(
        stamp=0,
        source="vo",
        position=(1.0, 2.0, 3.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        covariance=tuple(np.diag([1.0, 2, 3, 4, 5, 6]).ravel().tolist()),
    )
    message = samples.message(outgoing.estimate_with_covariance, event)
    assert message.header.frame_id == "odom"
    assert xyz(message.pose.pose.position) == (1.0, -2.0, -3.0)
    assert wxyz(message.pose.pose.orientation) == (1.0, 0.0, 0.0, 0.0)
    np.testing.assert_array_equal(np.diag(message.pose.covariance.reshape(6, 6)), range(1, 7))


def test_a_calibration_has_k_r_p_and_plumb_bob() -> None:
    info = samples.camera().info
    message = samples.calibration(samples.camera())
    assert message.header.frame_id == "camera_optical_frame"
    assert (message.width, message.height, message.distortion_model) == (64, 48, "plumb_bob")
    np.testing.assert_array_equal(message.k.reshape(3, 3), info.matrix())
    np.testing.assert_array_equal(message.r.reshape(3, 3), np.eye(3))
    np.testing.assert_array_equal(message.p.reshape(3, 4)[:, :3], info.matrix())
    np.testing.assert_array_equal(message.p.reshape(3, 4)[:, 3], 0.0)
    assert len(message.d) == 5


def test_transforms_clock_range_and_score_arrive_as_they_are() -> None:
    given = [Transform("a", "b", (1.0, 2.0, 3.0), (0.5, 0.5, -0.5, 0.5))]
    (got,) = samples.message(lambda out, tree: out.tree(TIME, tree), given).transforms
    assert (got.header.frame_id, got.child_frame_id) == ("a", "b")
    assert xyz(got.transform.translation) == (1.0, 2.0, 3.0)
    assert wxyz(got.transform.rotation) == (0.5, 0.5, -0.5, 0.5)
    clock = samples.message(outgoing.clock, samples.STAMP).clock
    assert (clock.sec, clock.nanosec) == TIME
    limits: dict[str, Any] = {"min_range": 0.5, "max_range": 4.0}
    distance = Range(
        stamp=0, source="drone/down", frame_id="down", range=1.5, field_of_view=0.1, **limits
    )
    sensor = RangeAnnouncement(stamp=0, source="drone/down", rate=20.0, noise=0.02, **limits)
    message = samples.message(outgoing.distance, distance, range=sensor)
    assert (message.range, message.min_range, message.max_range) == (1.5, 0.5, 4.0)
    assert message.header.frame_id == "down"
    assert message.field_of_view == pytest.approx(0.1)
    assert message.variance == pytest.approx(4e-4)
    score = Score(stamp=0, source="e", subject="vo", metric="ate", value=0.25, unit="m")
    assert samples.message(outgoing.score, score).data == 0.25


def test_pressure_field_and_fix_are_in_the_bodys_frame_and_axes() -> None:
    pressure = FluidPressure(stamp=7, source="drone", fluid_pressure=101_325.0, variance=4.0)
    message = samples.message(outgoing.pressure, pressure)
    assert (message.fluid_pressure, message.variance) == (101_325.0, 4.0)
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("base_link", 7)
    field = MagneticField(stamp=0, source="drone", magnetic_field=(2e-5, 1e-6, 4e-5))
    message = samples.message(outgoing.magnetic_field, field)
    assert xyz(message.magnetic_field) == (2e-5, -1e-6, -4e-5)
    assert not message.magnetic_field_covariance.any()
    fix = NavSatFix(stamp=0, source="drone", latitude=47.4, longitude=8.5, altitude=488.0)
    none = msgspec.structs.replace(fix, status=-1)
    assert samples.message(outgoing.fix, none).status.status == -1
    message = samples.message(outgoing.fix, fix)
    assert (message.latitude, message.longitude, message.altitude) == (47.4, 8.5, 488.0)
    assert (message.status.status, message.status.service) == (0, 1)
    assert message.position_covariance_type == message.COVARIANCE_TYPE_UNKNOWN


def test_what_sensors_announce_is_in_their_messages() -> None:
    magnetometer = MagnetometerAnnouncement(
        stamp=0, source="drone/mag", rate=50.0, noise=1e-7, field=(2e-5, 0.0, 4e-5)
    )
    field = MagneticField(stamp=0, source="drone/mag", magnetic_field=(2e-5, 1e-6, 4e-5))
    message = samples.message(outgoing.magnetic_field, field, magnetic=magnetometer)
    np.testing.assert_allclose(np.diag(message.magnetic_field_covariance.reshape(3, 3)), 1e-14)
    pressure = FluidPressure(stamp=0, source="drone/baro", fluid_pressure=101_325.0)
    barometer = BarometerAnnouncement(
        stamp=0, source="drone/baro", rate=50.0, frame_id="board", noise=3.0, altitude=0.0
    )
    message = samples.message(outgoing.pressure, pressure, pressure=barometer)
    assert message.header.frame_id == "board"


def test_a_fix_has_its_covariance_and_velocity_in_enu() -> None:
    fix = NavSatFix(
        stamp=0,
        source="drone/gps",
        latitude=47.4,
        longitude=8.5,
        altitude=488.0,
        position_covariance=(1.0, 0.1, 0.2, 0.1, 2.0, 0.3, 0.2, 0.3, 3.0),  # north, east, down
        velocity=(1.0, 2.0, -3.0),
    )
    message = samples.message(outgoing.fix, fix)
    assert message.position_covariance_type == message.COVARIANCE_TYPE_KNOWN
    np.testing.assert_allclose(
        message.position_covariance.reshape(3, 3), [[2, 0.1, -0.3], [0.1, 1, -0.2], [-0.3, -0.2, 3]]
    )
    message = samples.message(outgoing.fix_velocity, fix)
    assert message.header.frame_id == "map"
    assert xyz(message.twist.linear) == (2.0, 1.0, 3.0)
    wind = Wind(stamp=0, source="drone", velocity=(1.0, 2.0, -3.0))
    message = samples.message(outgoing.wind, wind)
    assert (message.header.frame_id, xyz(message.vector)) == ("map", (2.0, 1.0, 3.0))


def test_a_range_of_humble_has_no_variance() -> None:
    old = TypeStore("humble")
    distance = Range(stamp=0, source="drone", range=1.5, min_range=0.5, max_range=4.0)
    made = outgoing.distance(Outgoing(old, PublishingConfig(), Stamps().out), distance)
    data = old.serialize(made)
    assert old.deserialize(bytes(data), "sensor_msgs/msg/Range").range == 1.5


def test_stores_share_what_is_compiled_but_for_types_of_ones_own() -> None:
    """A type compiled in one store is another's, too; one of the same name may differ."""
    time, sample = "builtin_interfaces/msg/Time", "own_msgs/msg/Sample"
    first = TypeStore()
    first.add(sample, "uint8 value")
    data = bytes(first.serialize(first.message(sample)(value=7)))
    first.check(time)
    second = TypeStore()
    second.add(sample, "float64 value")
    assert len(second.serialize(second.message(sample)(value=7.0))) == len(data) + 7
    assert first.deserialize(data, sample).value == 7
    assert second._store.get_msgdef(time) is first._store.get_msgdef(time)
    assert TypeStore("humble")._store.get_msgdef(time) is not first._store.get_msgdef(time)
