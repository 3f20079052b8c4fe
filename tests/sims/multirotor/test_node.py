"""The multirotor as a node: what it announces, obeys, refuses and tells."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from events import (
    BodyRateSetpoint,
    CameraAnnouncement,
    Collision,
    Disarm,
    Disarmed,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Land,
    Odometry,
    PositionSetpoint,
    TakenOff,
    Takeoff,
    VehicleAnnouncement,
    VehicleEvent,
    VelocitySetpoint,
)
from runtime.errors import NodeError
from runtime.testing import NodeResult, run_node, spec
from sims.multirotor import STANDING_HEIGHT
from sims.multirotor.node import Multirotor
from tests.runtime.samples_runs import supervise
from tests.sims.multirotor.flight import WORLD

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
    assert vehicle.position == pytest.approx((1.0, -2.0, -STANDING_HEIGHT))
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


def test_it_runs_in_real_time() -> None:
    """At 400 Hz, whatever else the machine does: late ticks are counted, not lost."""
    outcome = supervise([spec(Multirotor, "drone", {"world": world})], clock="real", duration=1.0)
    assert outcome.error is None
    ticker = outcome.supervisor.tickers["drone.control"]
    assert 395 <= ticker.calls + ticker.missed <= 402
    assert ticker.calls > 200
    stamps = [e.stamp for e in outcome.sent if isinstance(e, Odometry)]
    assert stamps == sorted(stamps)
    assert 0.9 < stamps[-1] / SECOND < 1.1


def test_cameras_announce_themselves_and_deliver() -> None:
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


def test_a_world_that_is_not_there_is_named() -> None:
    with pytest.raises(NodeError, match=r"drone: .*hal\b"):
        fly(world="hal")
