"""Sensors on a vehicle: announced, mounted, at their rate, in time, and without side effects."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from events import (
    BarometerAnnouncement,
    Event,
    FluidPressure,
    Imu,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    Odometry,
    Range,
    RangeAnnouncement,
    Teleport,
    TransformStamped,
)
from events.frames import cross, rotate
from runtime.errors import ConfigError
from runtime.testing import NodeResult, run_node, spec
from sims.multirotor import Multirotor
from sims.sensors.sensor import pressure_at
from tests.sims.vehicle.flight import WORLD

SECOND = 1_000_000_000

world = ""


@pytest.fixture(scope="module", autouse=True)
def _world(tmp_path_factory: pytest.TempPathFactory) -> None:
    global world
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    world = str(path)


def fly(*orders: Event, **config: Any) -> NodeResult:
    config |= {"world": world}
    return run_node(Multirotor, inputs=orders, config=config, duration=0.5, name="drone")


def test_a_barometer_is_announced_mounted_and_read_at_its_rate() -> None:
    result = fly(barometer={"rate": 20, "position": [0.0, 0.1, -0.05], "orientation": [0, 0, 90]})
    (announced,) = result.of(BarometerAnnouncement)
    assert (announced.source, announced.rate, announced.noise) == ("drone/barometer", 20, 2.7)
    assert announced.altitude == 122.0
    (mounted,) = result.of(TransformStamped)
    assert mounted.static
    assert (mounted.frame_id, mounted.child_frame_id) == ("base_link", "drone/barometer")
    assert mounted.translation == announced.position == (0.0, 0.1, -0.05)
    assert mounted.rotation == announced.orientation == pytest.approx((0.5**0.5, 0, 0, 0.5**0.5))
    assert [e.stamp for e in result.of(FluidPressure)] == [k * SECOND // 20 for k in range(10)]
    assert result.of(FluidPressure)[0].fluid_pressure == pytest.approx(pressure_at(122.15), abs=15)


@pytest.mark.slow
def test_a_measurement_comes_latency_after_its_stamp_and_first_after_the_start() -> None:
    result = fly(barometer={"rate": 50, "latency": "45ms", "startup_delay": "100ms"}, imu_rate=1000)
    stamps = [e.stamp for e in result.of(FluidPressure)]
    assert stamps[0] == SECOND // 10
    assert len(stamps) == 18  # those of 0.10 to 0.44 s
    for index, event in enumerate(result.sent):
        if isinstance(event, FluidPressure):
            now = max(e.stamp for e in result.sent[:index] if isinstance(e, Imu))
            assert event.stamp + 0.044 * SECOND <= now <= event.stamp + 0.046 * SECOND


def test_the_velocity_of_a_fix_is_that_of_the_antenna() -> None:
    """On a vehicle that tumbles as it falls."""
    antenna = (1.0, 0.5, -0.3)
    thrown = Teleport(
        stamp=SECOND // 20,
        source="test",
        position=(0.0, 0.0, -9.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        linear_velocity=(2.0, 0.0, 0.0),
        angular_velocity=(1.0, -2.0, 3.0),
    )
    result = fly(thrown, gnss={"position": antenna, "startup_delay": 0, "latency": 0})
    truths = {e.stamp: e for e in result.of(Odometry)}
    for fix in result.of(NavSatFix)[5:]:
        true = truths[fix.stamp]
        body = np.add(true.linear_velocity, cross(true.angular_velocity, antenna))
        expected = rotate(true.orientation, tuple(body.tolist()))
        assert fix.velocity == pytest.approx(expected, abs=1e-9)
        assert math.dist(fix.velocity, rotate(true.orientation, true.linear_velocity)) > 1.0


def test_a_sensor_changes_nothing_of_the_others() -> None:
    """A barometer takes no random number from the IMU."""
    assert fly().of(Imu) == fly(barometer={}).of(Imu)


def test_equal_seeds_give_equal_measurements_whatever_else_is_measured() -> None:
    alone, again = fly(barometer={}), fly(barometer={}, imu_rate=100)
    assert alone.of(FluidPressure) == again.of(FluidPressure)


def test_all_sensors_are_announced_mounted_and_sent() -> None:
    down = {"name": "altimeter", "orientation": [0, -90, 0], "rate": 10, "min_range": 0.01}
    ahead = {"name": "bumper", "rate": 20, "max_range": 3.0}
    result = fly(
        origin=[10.0, 20.0, 300.0],
        gnss={"startup_delay": 0, "latency": 0, "rate": 10},
        magnetometer={"rate": 25},
        range_finders=[down, ahead],
    )
    (gnss,), (field,) = result.of(NavSatAnnouncement), result.of(MagnetometerAnnouncement)
    assert (gnss.latitude, gnss.longitude, gnss.altitude) == (10.0, 20.0, 300.0)
    assert field.field[0] > 3e-5  # near the equator the field points north
    assert [e.source for e in result.of(RangeAnnouncement)] == ["drone/altimeter", "drone/bumper"]
    children = {e.child_frame_id for e in result.of(TransformStamped)}
    assert children == {"drone/gnss", "drone/magnetometer", "drone/altimeter", "drone/bumper"}
    assert len(result.of(NavSatFix)) == 5
    assert result.of(NavSatFix)[-1].altitude == pytest.approx(300.1, abs=0.01)
    assert len(result.of(MagneticField)) == 13
    ranges = {
        source: [e.range for e in result.of(Range) if e.source == source]
        for source in ("drone/altimeter", "drone/bumper")
    }
    assert len(ranges["drone/altimeter"]) == 5
    assert ranges["drone/altimeter"] == pytest.approx([0.1] * 5, abs=0.1)
    assert ranges["drone/bumper"] == [math.inf] * 10


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"range_finders": [{"name": "gnss"}]}, "gnss: expected a name of its own"),
        (
            {"cameras": [{"name": "front"}], "range_finders": [{"name": "front"}]},
            "range_finders: front: expected a name of its own",
        ),
        ({"origin": [91.0, 0.0, 0.0]}, "origin"),
        ({"barometer": {"nois": 1.0}}, "nois"),
        ({"magnetometer": {"year": 2035.0}}, "year"),
        ({"barometer": {"drift_time": 0}}, "barometer.*: drift_time: expected more than 0 s"),
        (
            {"gnss": {"horizontal_drift": 1.0, "drift_time": "0s"}},
            "gnss.*: drift_time: expected more than 0 s",
        ),
        (
            {"gnss": {"vertical_drift": 1.0, "drift_time": "0s"}},
            "gnss.*: drift_time: expected more than 0 s",
        ),
    ],
)
def test_settings_that_cannot_be_are_refused_with_the_file(
    config: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        spec(Multirotor, "drone", config)


def test_without_a_drift_its_time_constant_may_be_zero() -> None:
    spec(
        Multirotor, "drone", {"barometer": {"drift": 0, "drift_time": 0}, "gnss": {"drift_time": 0}}
    )


@pytest.mark.slow
def test_lidars_send_turns_with_the_stamp_of_their_first_ray_when_they_are_over() -> None:
    lidar = {"name": "top", "rate": 20, "columns": 90, "channels": 4, "latency": "13ms"}
    flash = {"name": "front", "pattern": "solid_state", "channels": 1, "azimuths": [-30, 30]}
    flash |= {"columns": 200, "rate": 30, "startup_delay": "100ms"}
    result = fly(lidars=[lidar, flash], imu_rate=1000)
    announced = {e.source: e for e in result.of(LidarAnnouncement)}
    assert announced["drone/top"].channels == 4
    assert announced["drone/front"].horizontal_fov == pytest.approx(math.pi / 3)
    scans = [e for e in result.of(LidarScan) if e.source == "drone/top"]
    assert [e.stamp for e in scans] == [k * SECOND // 20 for k in range(9)]
    assert all(0.0 <= e.times.min() <= e.times.max() < 0.05 for e in scans)
    others = [e.stamp for e in result.of(LidarScan) if e.source == "drone/front"]
    assert others == [k * SECOND // 30 for k in range(3, 14)]
    for index, event in enumerate(result.sent):
        if isinstance(event, LidarScan) and event.source == "drone/top":
            now = max(e.stamp for e in result.sent[:index] if isinstance(e, Imu))
            assert now - event.stamp == pytest.approx(0.063 * SECOND, abs=0.0011 * SECOND)


@pytest.mark.slow
def test_equal_runs_give_equal_scans() -> None:
    lidar = {"name": "top", "columns": 90, "channels": 4, "noise": 0.02, "dropout": 0.1}
    one, again = (fly(lidars=[lidar]).of(LidarScan) for _ in range(2))
    assert len(one) == 4
    for a, b in zip(one, again, strict=True):
        assert a.points.tobytes() == b.points.tobytes()
