"""Sensors on a vehicle: announced, mounted, at their rate, in time, and without side effects."""

from __future__ import annotations

from typing import Any

import pytest

from events import BarometerAnnouncement, FluidPressure, Imu, TransformStamped
from runtime.testing import NodeResult, run_node
from sims.multirotor import Multirotor
from sims.sensors.barometer import pressure_at
from tests.sims.vehicle.flight import WORLD

SECOND = 1_000_000_000

world = ""


@pytest.fixture(scope="module", autouse=True)
def _world(tmp_path_factory: pytest.TempPathFactory) -> None:
    global world
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    world = str(path)


def fly(duration: float = 0.5, **config: Any) -> NodeResult:
    return run_node(Multirotor, config={"world": world} | config, duration=duration, name="drone")


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


def test_a_measurement_comes_latency_after_its_stamp_and_first_after_the_start() -> None:
    result = fly(barometer={"rate": 50, "latency": "45ms", "startup_delay": "100ms"}, imu_rate=1000)
    stamps = [e.stamp for e in result.of(FluidPressure)]
    assert stamps[0] == SECOND // 10
    assert len(stamps) == 18  # those of 0.10 to 0.44 s
    for index, event in enumerate(result.sent):
        if isinstance(event, FluidPressure):
            now = max(e.stamp for e in result.sent[:index] if isinstance(e, Imu))
            assert event.stamp + 0.044 * SECOND <= now <= event.stamp + 0.046 * SECOND


def test_a_sensor_changes_nothing_of_the_others() -> None:
    """A barometer takes no random number from the IMU."""
    assert fly().of(Imu) == fly(barometer={}).of(Imu)


def test_equal_seeds_give_equal_measurements_whatever_else_is_measured() -> None:
    alone, again = fly(barometer={}), fly(barometer={}, imu_rate=100)
    assert alone.of(FluidPressure) == again.of(FluidPressure)
