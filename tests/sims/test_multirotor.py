"""The multirotor as a node: what it announces, obeys, refuses and tells.

A multirotor that is teleported and reset: what it, its sensors and its autopilot make of it.
"""

from __future__ import annotations

import logging
import re
from fractions import Fraction
from itertools import pairwise
from math import hypot
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    Arm,
    BodyRateSetpoint,
    CameraAnnouncement,
    Collision,
    Command,
    Disarm,
    Disarmed,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Land,
    LidarScan,
    Odometry,
    PoseStamped,
    PositionSetpoint,
    Reset,
    TakenOff,
    Takeoff,
    Teleport,
    Vector3,
    VehicleAnnouncement,
    VehicleEvent,
    VelocitySetpoint,
)
from events import frames as rotations
from runtime.config.model import NodeSpec
from runtime.errors import ConfigError, NodeError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from sims.multirotor import Multirotor
from sims.vehicle import STANDING_HEIGHT
from tests.runtime.samples_runs import supervise
from tests.sims.vehicle.flight import WORLD

SECOND = 1_000_000_000

world = ""


@pytest.fixture(scope="module", autouse=True)
def _world(tmp_path_factory: pytest.TempPathFactory) -> None:
    global world
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    world = str(path)


def fly(*inputs: Event, duration: float = 1.0, **config: Any) -> NodeResult:
    config = {"world": world} | config
    return run_node(Multirotor, inputs=inputs, config=config, duration=duration, name="drone")


def place(stamp: int, x: float, y: float, z: float) -> PositionSetpoint:
    return PositionSetpoint(stamp=stamp, source="test", position=(x, y, z))


def takeoff(stamp: int = 0, altitude: float = 1.0) -> Takeoff:
    return Takeoff(stamp=stamp, source="test", altitude=altitude)


def test_it_announces_vehicle_and_imu() -> None:
    result = fly(position=[1.0, -2.0], yaw=90, imu_rate=100, duration=0.01)
    (vehicle,), (imu,) = result.of(VehicleAnnouncement), result.of(ImuAnnouncement)
    assert vehicle.source == "drone"
    assert vehicle.position == pytest.approx((1.0, -2.0, -STANDING_HEIGHT), abs=1e-3)
    assert vehicle.orientation == pytest.approx((0.5**0.5, 0, 0, 0.5**0.5))
    assert vehicle.max_thrust > vehicle.mass * 9.81
    assert (imu.source, imu.rate, imu.frame_id) == ("drone/imu", 100, "base_link")
    assert imu.gyroscope_noise_density > 0


def test_imu_and_odometry_come_together_at_their_rate() -> None:
    result = fly(imu_rate=100, duration=0.5)
    stamps = [e.stamp for e in result.of(Imu)]
    assert stamps == [k * SECOND // 100 for k in range(50)]
    assert [e.stamp for e in result.of(Odometry)] == stamps
    assert result.of(Imu)[10].linear_acceleration[2] == pytest.approx(-9.81, abs=0.3)
    assert result.ticks["drone.control"].calls == 200


def test_at_rest_the_imu_feels_gravity_from_its_first_sample_on() -> None:
    result = fly(duration=1.0)
    accelerations = np.array([e.linear_acceleration for e in result.of(Imu)])
    density = result.of(ImuAnnouncement)[0].accelerometer_noise_density
    np.testing.assert_allclose(
        accelerations, np.tile((0.0, 0.0, -9.81), (200, 1)), atol=6 * density * 200**0.5
    )


def test_samples_stay_on_their_own_grid_at_any_rate() -> None:
    """Not on the physics' milliseconds, which 300 Hz are not."""
    result = fly(imu_rate=300, duration=0.5)
    assert [e.stamp for e in result.of(Imu)] == [k * SECOND // 300 for k in range(150)]
    assert [e.stamp for e in result.of(Odometry)] == [k * SECOND // 300 for k in range(150)]


CAMERA = {"name": "front", "width": 8, "height": 6, "images": ["grey"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "imu_rate", "latency"), [(30, 200, "40ms"), (70, 200, 0), (50, 20, 0), (7.3, 33, 0)]
)
def test_exposures_are_equidistant_and_true_at_their_own_stamps(
    rate: float, imu_rate: float, latency: str | float
) -> None:
    """Whatever the IMU's rate: nothing drifts, nothing comes twice; the truth is told at the very
    stamp, and is the pose in the camera's; and before an image comes all IMU samples up to it."""
    camera = CAMERA | {"rate": rate, "latency": latency, "position": [0.2, 0.0, 0.0]}
    result = fly(takeoff(), cameras=[camera], camera_processes=1, imu_rate=imu_rate, duration=1.0)
    images, moves = result.of(Image), result.of(Odometry)
    hz = Fraction(rate).limit_denominator(1000)
    expected = [int(k * SECOND / hz) for k in range(len(images))]
    assert len(images) >= 0.9 * rate
    assert [e.stamp for e in images] == expected
    assert [e.stamp for e in result.of(Imu)] == [
        int(k * SECOND / Fraction(imu_rate)) for k in range(len(result.of(Imu)))
    ]
    stamps = [e.stamp for e in moves]
    assert stamps == sorted(set(stamps))
    truth = {e.stamp: e for e in moves}
    for pose in result.of(PoseStamped):
        body = truth[pose.stamp]
        ahead = rotations.rotate(body.orientation, (0.2, 0.0, 0.0))
        place = [a + b for a, b in zip(body.position, ahead, strict=True)]
        assert pose.position == pytest.approx(place, abs=1e-9)
    for index, event in enumerate(result.sent):
        if isinstance(event, Image):
            before = [e.stamp for e in result.sent[:index] if isinstance(e, Imu)]
            due = int(event.stamp * Fraction(imu_rate) / SECOND)
            assert len(before) > due


@pytest.mark.slow
def test_the_truth_between_imu_samples_is_the_one_that_a_fast_imu_tells() -> None:
    """Exposures at 70 Hz beside an IMU of 20 Hz, against one of 1000 Hz: within a micrometre of
    the straight line between milliseconds, and no exposure changes the flight."""

    def moves(imu_rate: int, **config: Any) -> list[Odometry]:
        return fly(takeoff(), imu_rate=imu_rate, duration=1.2, **config).of(Odometry)

    fine = moves(1000)
    camera = CAMERA | {"rate": 70, "loss": 1.0}
    grid = np.array([e.stamp for e in fine])
    places = np.array([e.position for e in fine])
    samples = moves(20, cameras=[camera], camera_processes=1)
    assert len(samples) > 90
    for event in samples:
        if event.stamp <= grid[-1]:
            straight = [np.interp(event.stamp, grid, places[:, axis]) for axis in range(3)]
            assert event.position == pytest.approx(straight, abs=1e-6)


@pytest.mark.slow
def test_an_imu_may_trigger_the_cameras(caplog: pytest.LogCaptureFixture) -> None:
    """Then every exposure has the stamp of an IMU sample, unless the rates do not fit."""
    caplog.set_level(logging.WARNING, "visnav.drone")
    cameras = [CAMERA | {"rate": 30}, CAMERA | {"name": "even", "rate": 40}]
    result = fly(cameras=cameras, camera_processes=1, trigger="imu", duration=0.5)
    samples = {e.stamp for e in result.of(Imu)}
    even, free = (
        [e.stamp for e in result.of(Image) if e.source == f"drone/{name}"]
        for name in ("even", "front")
    )
    assert set(even) <= samples
    assert {e.stamp for e in result.of(Odometry)} >= samples | set(free)
    assert {(b - a) // 1000 for a, b in pairwise(free)} == {33_333}
    (said,) = [r.getMessage() for r in caplog.records]
    assert said.startswith("front: 30 Hz does not divide the 200 Hz of the IMU")


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"cameras": [CAMERA | {"rate": 1001}]}, r"rate.*1000"),
        ({"cameras": [CAMERA, CAMERA]}, r"front: expected a name of its own"),
        (
            {"cameras": [CAMERA | {"rate": 50, "exposure": "21ms"}]},
            r"front: exposure: expected at most the 20 ms .* found 21 ms",
        ),
    ],
)
def test_cameras_that_cannot_be_are_refused_with_the_file(
    config: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        spec(Multirotor, "drone", config)


@pytest.mark.slow
def test_several_vehicles_are_each_steered_by_their_own_pilot() -> None:
    def obeying(name: str) -> NodeSpec:
        inputs = {"commands": f"{name}/pilot", "setpoints": f"{name}/pilot"}
        config = {"world": world, "position": [0.0, 5.0 * (name == "b")]}
        return msgspec.structs.replace(spec(Multirotor, name, config), inputs=inputs)

    orders = [
        Takeoff(stamp=0, source="a/pilot", altitude=1.0),
        Takeoff(stamp=SECOND, source="b/pilot", altitude=2.0),
        PositionSetpoint(stamp=4 * SECOND, source="a/pilot", position=(1.0, 0.0, -1.0)),
    ]
    result = run_nodes([obeying("a"), obeying("b")], inputs=orders, duration=7.0)
    for name, place in (("a", (1.0, 0.0, -1.0)), ("b", (0.0, 5.0, -2.1))):
        (up,) = [e for e in result.of(TakenOff) if e.source == name]
        last = [e for e in result.of(Odometry) if e.source == name][-1]
        assert last.position == pytest.approx(place, abs=0.1)
        assert up.stamp > (name == "b") * SECOND


def test_take_off_and_landing_are_told() -> None:
    land = Land(stamp=4 * SECOND, source="test")
    result = fly(takeoff(), land, duration=9)
    told = [type(e).__name__ for e in result.sent if isinstance(e, VehicleEvent)]
    assert told == ["Armed", "TakenOff", "Landed", "Disarmed"]
    (up,) = result.of(TakenOff)
    height = next(e.position[2] for e in result.of(Odometry) if e.stamp >= up.stamp)
    assert height == pytest.approx(-STANDING_HEIGHT - 1.0, abs=0.15)
    assert result.of(Collision) == []


def test_a_row_of_refused_setpoints_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "visnav.drone")
    fly(*(place(k * SECOND // 50, 0, 0, -1) for k in range(30)))
    assert [r.getMessage() for r in caplog.records] == ["PositionSetpoint refused: disarmed"]


def test_each_refused_order_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "visnav.drone")
    fly(Land(stamp=0, source="t"), Disarm(stamp=0, source="t"), takeoff(altitude=-1.0))
    assert [r.getMessage() for r in caplog.records] == [
        "Land refused: not in the air",
        "Disarm refused: already disarmed",
        "Takeoff refused: Takeoff.altitude: expected a number > 0, found -1.0",
    ]


@pytest.mark.slow
def test_a_collision_is_told_once_while_it_lasts() -> None:
    """Flown against a wall and pressed against it for four seconds."""
    push = [
        VelocitySetpoint(stamp=3 * SECOND + k * SECOND // 20, source="t", velocity=(1.5, 0.0, 0.0))
        for k in range(120)
    ]
    result = fly(takeoff(), *push, duration=9)
    hits = [hit for hit in result.of(Collision) if hit.other == "wall"]
    assert 1 <= len(hits) <= 12
    assert hits[0].speed > 0.5
    assert hits[0].normal == pytest.approx((-1, 0, 0), abs=0.2)
    assert hits[0].position[0] == pytest.approx(4.0, abs=0.05)


@pytest.mark.slow
def test_a_fall_ends_in_a_collision_with_the_floor() -> None:
    result = fly(takeoff(), Disarm(stamp=3 * SECOND, source="t"), duration=5)
    assert [type(e) for e in result.of(Disarmed)] == [Disarmed]
    spin = BodyRateSetpoint(
        stamp=3 * SECOND, source="t", angular_velocity=(0.0, 0.0, 0.0), thrust=0.0
    )
    hits = fly(takeoff(altitude=2.0), spin, duration=4.49).of(Collision)
    assert hits
    assert hits[0].other == "floor"
    assert hits[0].speed > 1.0


def test_the_same_seed_gives_the_same_flight_and_another_another() -> None:
    def measured(seed: int) -> list[Imu]:
        node = spec(Multirotor, "drone", {"world": world})
        return [e for e in supervise([node], duration=0.2, seed=seed).sent if isinstance(e, Imu)]

    assert measured(1) == measured(1)
    assert measured(1) != measured(2)


@pytest.mark.slow
def test_it_runs_in_real_time() -> None:
    """At 400 Hz, whatever else the machine does: late ticks are counted, not lost."""
    outcome = supervise([spec(Multirotor, "drone", {"world": world})], clock="real", duration=1.0)
    assert outcome.error is None
    ticker, end = (
        outcome.supervisor.state.tickers["drone.control"],
        outcome.supervisor.state.clock.now(),
    )
    assert 395 <= ticker.calls + ticker.missed <= 400 * end / SECOND + 1
    stamps = [e.stamp for e in outcome.sent if isinstance(e, Odometry)]
    assert stamps == sorted(set(stamps))
    assert 0.9 * SECOND < stamps[-1] <= end


@pytest.mark.slow
def test_cameras_announce_themselves_and_deliver(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    camera = {"name": "front", "width": 32, "height": 24, "rate": 20, "latency": "40ms"}
    result = fly(cameras=[camera], camera_processes=1, duration=0.3)
    (announced,) = result.of(CameraAnnouncement)
    assert (announced.source, announced.parent_frame_id) == ("drone/front", "base_link")
    assert (announced.rate, announced.latency) == (20, 0.04)
    assert (announced.info.width, announced.info.height) == (32, 24)
    images = result.of(Image)
    assert [e.stamp for e in images] == [k * SECOND // 20 for k in range(6)]
    assert {(e.source, e.frame_id, e.data.shape) for e in images} == {
        ("drone/front", announced.frame_id, (24, 32, 3))
    }
    assert re.search(r"images are drawn by \w+", caplog.text)


def test_a_world_that_is_not_there_is_named() -> None:
    with pytest.raises(NodeError, match=r"drone: .*hal\b"):
        fly(world="hal")


TURNED = rotations.from_rpy(0.0, 0.0, 1.0)


def say(kind: type[Command], seconds: float, **fields: Any) -> Command:
    return kind(stamp=round(seconds * SECOND), source="test", **fields)


def teleport(seconds: float, *position: float, **fields: Any) -> Command:
    return say(Teleport, seconds, position=position, orientation=TURNED, **fields)


def apart(a: Vector3, b: Vector3) -> float:
    return hypot(*(x - y for x, y in zip(a, b, strict=True)))


@pytest.mark.slow
@pytest.mark.parametrize("before", [0.5, 4.0, 5.5], ids=["taking off", "flying", "landing"])
def test_whoever_is_teleported_in_the_air_holds_the_new_place(before: float) -> None:
    orders = [say(Takeoff, 0.0), say(Land, 5.0)]
    place = (-3.0, 2.0, -7.0)
    at = before + 0.0004  # between two steps of the physics
    result = fly(
        *(order for order in orders if order.stamp < at * SECOND),
        teleport(at, *place),
        duration=before + 3.0,
    )
    poses = [pose for pose in result.of(Odometry) if pose.stamp > at * SECOND]
    assert apart(poses[0].position, place) < 1e-3
    assert apart(poses[-1].position, place) < 0.1
    assert max(apart(pose.position, place) for pose in poses) < 0.5
    assert rotations.yaw_of(poses[-1].orientation) == pytest.approx(1.0, abs=0.02)


def test_one_that_does_not_fly_falls_from_where_it_is_put() -> None:
    last = fly(teleport(0.1, 0.0, 0.0, -1.0), duration=1.5).of(Odometry)[-1]
    assert -0.2 < last.position[2] < 0.0


@pytest.mark.slow
@pytest.mark.parametrize("sampling", ["instant", "mean"])
def test_an_imu_feels_no_jump(sampling: str) -> None:
    result = fly(
        say(Takeoff, 0.0),
        PositionSetpoint(stamp=3 * SECOND, source="test", position=(0.0, 0.0, -1.5)),
        teleport(4.0026, 3.0, 0.0, -9.0, linear_velocity=(0.0, 0.0, 0.0)),
        duration=4.5,
        imu={"ideal": True, "sampling": sampling, "position": [0.1, 0.0, 0.0]},
    )
    late = [sample for sample in result.of(Imu) if sample.stamp > 3.8 * SECOND]
    assert len(late) == 139
    assert max(abs(s.linear_acceleration[2] + 9.81) for s in late) < 3.0
    assert max(hypot(*s.angular_velocity) for s in late) < 1.0


@pytest.mark.slow
def test_exposures_and_scans_in_progress_survive_a_jump() -> None:
    camera = {
        "name": "rolling", "width": 32, "height": 24, "rate": 20, "readout": "40ms",
        "exposure": "5ms",
    }  # fmt: skip
    lidar = {"name": "lidar", "channels": 2, "columns": 64}
    result = fly(
        say(Takeoff, 0.0),
        teleport(2.5053, -3.0, 2.0, -7.0),
        say(Reset, 3.0113),
        duration=3.5,
        cameras=[camera],
        lidars=[lidar],
    )
    images, scans = result.of(Image), result.of(LidarScan)
    assert np.diff([image.stamp for image in images]).tolist() == [SECOND // 20] * (len(images) - 1)
    assert images[-1].stamp >= 3.35 * SECOND
    assert np.diff([s.stamp for s in scans]).tolist() == [SECOND // 10] * (len(scans) - 1)


def test_where_physics_would_break_it_refuses_to_be(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        result = fly(
            teleport(0.1, 0.0, 0.0, -1e6),
            teleport(0.2, 0.0, 0.0, 5000.0),
            teleport(0.3, 0.0, 0.0, -1.0, linear_velocity=(1e4, 0.0, 0.0)),
            teleport(0.4, 0.0, 0.0, -1.0, angular_velocity=(0.0, 1e4, 0.0)),
            duration=0.5,
        )
    assert sum("Teleport refused" in record.message for record in caplog.records) == 4
    assert apart(result.of(Odometry)[-1].position, (0.0, 0.0, -0.1)) < 1e-3


@pytest.mark.slow
def test_a_reset_in_the_air_brings_it_to_the_start_and_it_takes_off_as_before() -> None:
    result = fly(
        say(Takeoff, 0.0),
        VelocitySetpoint(stamp=4 * SECOND, source="test", velocity=(2.0, 1.0, 0.0), yaw_rate=2.0),
        say(Reset, 4.4),
        say(Takeoff, 5.0),
        duration=9.0,
        position=[1.0, 2.0],
    )
    poses = {pose.stamp: pose for pose in result.of(Odometry)}
    first = result.of(Odometry)[0]
    for seconds in (4.405, 4.9):
        rested = poses[round(seconds * SECOND)]
        assert apart(rested.position, first.position) < 1e-6
        assert apart(rested.linear_velocity, (0.0, 0.0, 0.0)) < 1e-4
    (disarmed,) = result.of(Disarmed)
    assert disarmed.stamp == 4_400_000_000
    once, again = result.of(TakenOff)
    assert again.stamp - once.stamp == pytest.approx(5 * SECOND, abs=5_000_000)
    assert poses[9 * SECOND - 5_000_000].position == pytest.approx(
        poses[4 * SECOND].position, abs=0.01
    )


@pytest.mark.slow
def test_a_reset_forgets_the_heading_of_the_last_velocity() -> None:
    turning = VelocitySetpoint(
        stamp=4 * SECOND, source="test", velocity=(2.0, 1.0, 0.0), yaw_rate=2.0
    )
    result = fly(
        say(Takeoff, 0.0),
        turning,
        say(Reset, 4.4),
        say(Arm, 4.5),
        VelocitySetpoint(stamp=round(4.6 * SECOND), source="test", velocity=(0.0, 0.0, -1.0)),
        duration=5.5,
    )
    yaws = {pose.stamp: rotations.yaw_of(pose.orientation) for pose in result.of(Odometry)}
    assert yaws[round(4.395 * SECOND)] > 0.4
    assert max(abs(yaw) for stamp, yaw in yaws.items() if stamp > 4.4 * SECOND) < 0.02
