"""ROS messages to events: frames, stamps, and what is refused."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import (
    CameraInfo,
    Event,
    FluidPressure,
    Imu,
    MagneticField,
    NavSatFix,
    Odometry,
    PoseEstimate,
    PoseSetpoint,
    PositionSetpoint,
    Range,
    Setpoint,
    VelocitySetpoint,
)
from events.frames import normalize
from nodes.ros2.bridge.settings import Subscription
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.incoming import MessageContext, camera_announcement, camera_info
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.typestore import Stamps
from tests.nodes.ros2.messages import samples
from tests.nodes.ros2.messages.samples import S

NOW = 5_000_000_000
POSE = "geometry_msgs/msg/PoseStamped"


def make(type_: str, **fields: Any) -> Any:
    return samples.store().message(type_)(**fields)


def vector(x: float, y: float, z: float) -> Any:
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def twist(linear: Any, angular: Any) -> Any:
    return make("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def pose(
    frame_id: str = "map",
    stamp: tuple[int, int] = (3, 7),
    position: tuple[float, float, float] = (1.0, 2.0, 3.0),
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Any:
    x, y, z = position
    qw, qx, qy, qz = wxyz
    return make(
        POSE,
        header=samples.store().header(stamp, frame_id),
        pose=make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


def read(message: Any, use: str, **context: Any) -> Any:
    given: dict[str, Any] = {"source": "s", "now": NOW} | context
    return READERS[message.__msgtype__, use].read(message, MessageContext(**given))


def test_a_pose_in_the_map_becomes_an_estimate_in_ned() -> None:
    event = read(pose(), "estimate")
    assert isinstance(event, PoseEstimate)
    assert (event.stamp, event.source, event.frame_id) == (3_000_000_007, "s", "map")
    assert event.position == (2.0, 1.0, -3.0)
    np.testing.assert_allclose(event.orientation, (S, 0, 0, S))  # facing east


def test_the_end_of_a_path_becomes_an_estimate() -> None:
    head = pose().header
    path = make("nav_msgs/msg/Path", header=head, poses=[pose(""), pose("", stamp=(4, 0))])
    event = read(path, "estimate")
    assert isinstance(event, PoseEstimate)
    assert (event.stamp, event.frame_id) == (4_000_000_000, "map")
    assert event.position == (2.0, 1.0, -3.0)
    path.poses.clear()
    with pytest.raises(ValueError, match="poses: expected one or more, found none"):
        read(path, "estimate")


def test_a_pose_in_odom_becomes_an_estimate_from_the_start() -> None:
    event = read(pose("odom", wxyz=(0.0, 0.0, 0.0, 2.0)), "estimate")
    assert event.frame_id == "odom"
    assert event.position == (1.0, -2.0, -3.0)
    np.testing.assert_allclose(np.abs(event.orientation), (0, 0, 0, 1), atol=1e-12)


def test_the_file_may_say_in_which_frame_a_pose_is() -> None:
    event = read(pose("camera_init"), "estimate", frame_id="map")
    assert (event.frame_id, event.position) == ("map", (2.0, 1.0, -3.0))


numbers = st.floats(-100, 100)


@pytest.mark.slow
@given(
    st.tuples(numbers, numbers, numbers),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01),
    st.sampled_from(["map", "odom"]),
)
def test_what_is_published_comes_back_as_it_was(
    position: tuple[float, float, float],
    rotation: tuple[float, float, float, float],
    frame_id: str,
) -> None:
    covariance = tuple(float(i) for i in range(36))
    estimate = PoseEstimate(
        stamp=samples.STAMP,
        source="s",
        frame_id=frame_id,
        position=position,
        orientation=normalize(rotation),
        covariance=covariance,
    )
    back = read(samples.message(outgoing.estimate_with_covariance, estimate), "estimate")
    assert back.position == position
    np.testing.assert_allclose(np.abs(np.dot(back.orientation, estimate.orientation)), 1.0)
    assert back.covariance == covariance
    odometry = Odometry(
        stamp=samples.STAMP,
        source="s",
        frame_id=frame_id,
        position=position,
        orientation=normalize(rotation),
        linear_velocity=position,
        angular_velocity=position,
    )
    event = read(samples.message(outgoing.odometry, odometry), "odometry")
    assert (event.linear_velocity, event.angular_velocity) == (position, position)
    assert (event.position, event.stamp, event.frame_id) == (position, samples.STAMP, frame_id)
    measured = Imu(
        stamp=samples.STAMP, source="s", angular_velocity=position, linear_acceleration=position
    )
    assert read(samples.message(outgoing.imu, measured), "imu") == measured


def test_a_twist_is_a_velocity_along_the_heading() -> None:
    event = read(twist(vector(1, 2, 3), vector(0, 0, 0.5)), "velocity")
    assert event == VelocitySetpoint(
        stamp=NOW, source="s", frame_id="heading", velocity=(1.0, -2.0, -3.0), yaw_rate=-0.5
    )


def test_a_stamped_twist_may_be_in_the_map() -> None:
    inner = twist(vector(1, 2, 3), vector(0, 0, 0.5))
    for frame_id, frame, velocity in (
        ("map", "map", (2.0, 1.0, -3.0)),
        ("base_link", "heading", (1.0, -2.0, -3.0)),
    ):
        header = samples.store().header((3, 7), frame_id)
        event = read(make("geometry_msgs/msg/TwistStamped", header=header, twist=inner), "velocity")
        assert (event.frame_id, event.velocity, event.yaw_rate) == (frame, velocity, -0.5)


def test_a_pose_becomes_a_place_with_a_heading() -> None:
    event = read(pose(wxyz=(S, 0.0, 0.0, S)), "position")  # facing north
    assert isinstance(event, PositionSetpoint)
    assert event.position == (2.0, 1.0, -3.0)
    assert event.yaw == pytest.approx(0.0)
    event = read(pose(), "pose")
    assert isinstance(event, PoseSetpoint)
    np.testing.assert_allclose(event.orientation, (S, 0, 0, S))


def test_small_sensors_come_back_as_they_went() -> None:
    covariance = (1.0, 0.1, 0.2, 0.1, 2.0, 0.3, 0.2, 0.3, 3.0)
    common: dict[str, Any] = {"stamp": samples.STAMP, "source": "s"}
    down = Range(
        **common, frame_id="down", range=2.5, field_of_view=0.5, min_range=0.5, max_range=4.0
    )
    pressure = FluidPressure(**common, fluid_pressure=99_000.5, variance=9.0)
    field = MagneticField(**common, magnetic_field=(2e-5, 1e-6, 4e-5))
    fix = NavSatFix(
        **common, latitude=47.5, longitude=8.5, altitude=450.0, position_covariance=covariance
    )
    for write, use, sent in (
        (outgoing.distance, "range", down),
        (outgoing.pressure, "pressure", pressure),
        (outgoing.magnetic_field, "magnetic_field", field),
        (outgoing.fix, "fix", fix),
    ):
        message = samples.message(write, sent)
        assert read(message, use) == sent
    message.status.status = -1
    with pytest.raises(ValueError, match="expected a fix, found none"):
        read(message, "fix")
    far = samples.message(outgoing.distance, down)
    far.range = 4.5
    event = read(far, "range")
    assert isinstance(event, Range)
    assert event.range == np.inf


def test_a_setpoint_is_for_the_vehicle_that_the_subscription_names() -> None:
    context = MessageContext(source="ros", now=NOW, vehicle="drone2")
    twist = make("geometry_msgs/msg/Twist", linear=vector(1, 0, 0), angular=vector(0, 0, 0))
    for message, use in ((twist, "velocity"), (pose(), "position"), (pose(), "pose")):
        event = READERS[message.__msgtype__, use].read(message, context)
        assert isinstance(event, Setpoint)
        assert event.vehicle == "drone2"


def test_a_calibration_becomes_an_announcement() -> None:
    announcement = camera_announcement(samples.calibration(samples.camera()), "ros/eye", ("rgb",))
    assert announcement.info == samples.camera().info
    assert (announcement.source, announcement.images) == ("ros/eye", ("rgb",))
    assert announcement.frame_id == "camera_optical_frame"


LENSES = [
    CameraInfo(width=64, height=48, fx=50.0, fy=51.0, cx=31.0, cy=24.0, **lens)
    for lens in (
        {"distortion": (-0.3, 0.1, 1e-3, -2e-3, 0.02)},
        {
            "distortion_model": "rational_polynomial",
            "distortion": (0.4, -0.1, 1e-4, 2e-4, 0.02, 0.7, -0.05, 0.01),
        },
        {"distortion_model": "equidistant", "distortion": (-0.01, 0.012, -0.008, 0.001)},
        {"distortion_model": "equidistant", "distortion": (0.0,) * 4},
    )
]


@pytest.mark.parametrize("info", LENSES, ids=["radtan", "rational", "kb4", "ideal fisheye"])
def test_each_distortion_goes_to_ros_and_back(info: CameraInfo) -> None:
    camera = msgspec.structs.replace(samples.camera(), info=info, baseline=0.11)
    message = samples.calibration(camera)
    assert message.distortion_model == info.distortion_model
    assert message.p[3] == pytest.approx(-50.0 * 0.11)  # as stereo_image_proc reads it
    announcement = camera_announcement(message, "eye", ("rgb",))
    assert announcement.info == info
    assert announcement.baseline == pytest.approx(0.11)


def test_coefficients_may_be_as_few_or_as_many_as_calibrators_write() -> None:
    message = samples.calibration(samples.camera())
    message.d = np.array([-0.3, 0.1, 1e-3, -2e-3])
    assert camera_info(message).distortion == (-0.3, 0.1, 1e-3, -2e-3, 0.0)
    message.distortion_model, message.d = "rational_polynomial", np.r_[np.full(8, 0.1), np.zeros(6)]
    assert camera_info(message).distortion == (0.1,) * 8
    message.d = np.full(14, 0.1)  # with a thin prism
    with pytest.raises(ValueError, match=r"rational_polynomial with 8.* coefficients, found"):
        camera_info(message)


def part(width: int, height: int) -> Any:
    names = {"width": width, "height": height, "x_offset": 0, "y_offset": 0, "do_rectify": False}
    return make("sensor_msgs/msg/RegionOfInterest", **names)


def test_a_calibration_may_name_the_whole_image() -> None:
    message = samples.calibration(samples.camera())
    message.roi, message.binning_x, message.binning_y = part(64, 48), 1, 1
    assert camera_announcement(message, "eye", ("rgb",)).info == samples.camera().info


@pytest.mark.parametrize("frame", ["eye_optical", "eye_imu_optical_frame"])
def test_optical_axes_stay_as_they_are(frame: str) -> None:
    """Of a camera's own IMU, and of an odometry whose body is the camera."""
    message = samples.message(outgoing.odometry, samples.odometry())
    message.child_frame_id = frame
    q = message.pose.pose.orientation
    q.w, q.x, q.y, q.z = S, -S, 0.0, 0.0  # looks north: x (right) is east, y is down
    for use in ("odometry", "estimate"):
        event: Any = read(message, use)
        assert event.child_frame_id == frame
        np.testing.assert_allclose(event.orientation, (0.5, 0.5, 0.5, 0.5), atol=1e-12)
    twist = message.twist.twist
    event = read(message, "odometry")
    assert event.linear_velocity == (twist.linear.x, twist.linear.y, twist.linear.z)
    assert event.angular_velocity == (twist.angular.x, twist.angular.y, twist.angular.z)
    measured = make(
        "sensor_msgs/msg/Imu",
        header=samples.store().header((3, 7), frame),
        orientation=q,
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(1.0, 2.0, 3.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(0.0, -9.8, 0.0),
        linear_acceleration_covariance=np.zeros(9),
    )
    event = read(measured, "imu")
    assert event.angular_velocity == (1.0, 2.0, 3.0)
    assert event.linear_acceleration == (0.0, -9.8, 0.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"k": np.zeros(9)},
        {"k": np.full(9, np.nan)},
        {"distortion_model": "fov", "d": np.ones(1)},
        {"d": np.array([0.1, np.nan, 0.0, 0.0, 0.0])},
        {"d": np.array([0.1, np.inf, 0.0, 0.0, 0.0])},
        {"binning_x": 2, "binning_y": 2},
        {"roi": part(32, 48)},
        {"roi": part(64, 24)},
    ],
)
def test_a_calibration_that_is_none_is_refused(wrong: dict[str, Any]) -> None:
    message = samples.calibration(samples.camera())
    for field, value in wrong.items():
        setattr(message, field, value)
    with pytest.raises(ValueError, match="expected"):
        camera_announcement(message, "eye", ("rgb",))


@pytest.mark.parametrize(
    ("message", "use"),
    [
        (pose(position=(np.nan, 0, 0)), "estimate"),
        (pose(position=(0, np.inf, 0)), "position"),
        (pose(wxyz=(0, 0, 0, 0)), "estimate"),
        (pose(wxyz=(np.nan, 0, 0, 1)), "pose"),
        (pose("odom"), "position"),
        (pose(stamp=(-5, 0)), "estimate"),
        (pose(stamp=(2**31 - 1, 0)), "estimate"),
        (pose(stamp=(1_700_000_000, 0)), "estimate"),
        (twist(vector(np.nan, 0, 0), vector(0, 0, 0)), "velocity"),
        (twist(vector(0, 0, 0), vector(0, 0, -np.inf)), "velocity"),
    ],
)
def test_what_is_not_sane_is_refused(message: Any, use: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        read(message, use)


def test_stamps_go_to_the_wall_clock_and_back() -> None:
    wall = Stamps(1_700_000_000_000_000_000)
    seconds, nanoseconds = wall.out(samples.STAMP)
    assert (seconds, nanoseconds) == (1_700_000_003, 7)
    assert wall.back(seconds, nanoseconds, NOW) == samples.STAMP
    assert wall.back(0, 0, NOW) == NOW


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"topic": "a", "type": POSE}, "either as"),
        ({"topic": "a", "type": POSE, "as": "pose", "mapping": "a:b"}, "either as"),
        ({"topic": "a", "type": POSE, "as": "velocity"}, "found velocity from"),
        ({"topic": "a", "type": POSE, "mapping": "a.b"}, "module:function"),
        ({"topic": "1a", "type": POSE, "as": "pose"}, "expected a topic"),
        ({"topic": "a", "type": "Pose", "as": "pose"}, "expected a type"),
    ],
)
def test_a_subscription_that_makes_no_sense_says_why(table: dict[str, str], message: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert(table, Subscription)


def test_all_events_are_events() -> None:
    assert isinstance(read(pose(), "estimate"), Event)
