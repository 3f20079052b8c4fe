"""Sensors as scripts read them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from events import Arm, Event, PositionSetpoint, Takeoff
from tests.sims.airsim.scripts import Caller, RefusedError, drone, with_script

ALL: dict[str, Any] = {
    "barometer": {"noise": 0.0, "drift": 0.0},
    "magnetometer": {"noise": 0.0, "model": "airsim"},
    "gnss": {},
    "range_finders": [
        {"name": "down", "orientation": (0.0, -90.0, 0.0), "noise": 0.0, "min_range": 0.0},
        {"name": "ahead", "position": (0.1, 0.0, 0.0), "noise": 0.0, "max_range": 3.0},
    ],
}


def test_sensors_are_read_in_airsims_units(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("getGpsData", "", "")["is_valid"] is False
        assert airsim("getBarometerData", "", "")["time_stamp"] == 0
        airsim("simContinueForTime", 3.0)
        imu = airsim("getImuData", "", "")
        assert imu["time_stamp"] == 3_000_000_000
        assert imu["orientation"]["w_val"] == pytest.approx(1.0)
        assert imu["linear_acceleration"]["z_val"] == pytest.approx(-9.81, abs=0.2)
        # AirSim's own figures: AIRSIM's model of the atmosphere and of the field at its origin.
        barometer = airsim("getBarometerData", "barometer", "")
        assert barometer["altitude"] == pytest.approx(121.947 + 0.1, abs=0.01)
        assert barometer["pressure"] == pytest.approx(99867.98 - 1.2, abs=0.2)
        assert barometer["qnh"] == 1013.25
        magnetometer = airsim("getMagnetometerData", "", "drone")
        field = [*magnetometer["magnetic_field_body"].values()]
        assert field == pytest.approx([0.25043, 0.03409, 0.36581], abs=2e-4)
        assert magnetometer["magnetic_field_covariance"] == []
        gps = airsim("getGpsData", "gps", "")
        assert gps["time_stamp"] == 2_800_000_000  # 0.2 s late
        assert gps["gnss"]["time_utc"] == 2_800_000
        assert gps["gnss"]["eph"] == pytest.approx(0.1 + 99.9 * math.exp(-2.8 / 0.9), rel=0.02)
        assert gps["gnss"]["fix_type"] == 0
        airsim("simContinueForTime", 0.2)
        assert airsim("getGpsData", "", "")["gnss"]["fix_type"] == 2
        airsim("simContinueForTime", 0.3)
        gps = airsim("getGpsData", "gnss", "")
        assert gps["gnss"]["fix_type"] == 3
        assert gps["gnss"]["geo_point"]["latitude"] == pytest.approx(47.641468, abs=1e-9)
        down = airsim("getDistanceSensorData", "", "")
        assert down["distance"] == pytest.approx(0.1, abs=0.01)
        assert down["relative_pose"]["orientation"]["y_val"] == pytest.approx(-math.sqrt(0.5))
        ahead = airsim("getDistanceSensorData", "ahead", "")
        assert ahead["distance"] == ahead["max_distance"] == 3.0

    with_script(script, [drone(world=tiny_world, **ALL)])


@pytest.mark.parametrize(
    ("method", "called"),
    [
        ("getImuData", "IMU"),
        ("getBarometerData", "barometer"),
        ("getMagnetometerData", "magnetometer"),
        ("getGpsData", "gps"),
        ("getDistanceSensorData", "distance sensor"),
        ("getLidarData", "lidar"),
    ],
)
def test_sensors_that_are_not_there_are_refused(method: str, called: str, tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        with pytest.raises(RefusedError, match=f"No {called} with name X exist on vehicle"):
            airsim(method, "X", "")
        with pytest.raises(RefusedError, match="Vehicle API for 'nobody' is not available"):
            airsim(method, "", "nobody")

    with_script(script, [drone(world=tiny_world)])


def test_each_vehicle_has_its_own_sensors_by_the_names_of_the_settings(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        near = airsim("getDistanceSensorData", "Distance", "near")
        assert near["distance"] == pytest.approx(2.0)
        assert airsim("getDistanceSensorData", "", "far")["distance"] == pytest.approx(3.0)

    finder = [{"name": "ahead", "noise": 0.0}]
    with_script(
        script,
        [
            drone("far", world=tiny_world, range_finders=finder, position=(1.0, -1.0)),
            drone("near", world=tiny_world, range_finders=finder, position=(2.0, 1.0)),
        ],
        sensor_names={"Distance": "ahead"},
    )


def turning() -> list[Event]:
    """Return what has a vehicle fly past the wall while it turns."""
    orders: list[Event] = [Arm(stamp=0, source="test"), Takeoff(stamp=0, source="test")]
    orders.extend(
        PositionSetpoint(
            stamp=round((2.0 + 0.1 * step) * 1e9),
            source="test",
            position=(0.0, 0.1 * step, -2.0),
            yaw=0.05 * step,
        )
        for step in range(40)
    )
    return orders


@pytest.mark.parametrize(
    ("frame", "flavour"), [("VehicleInertialFrame", "airsim"), ("SensorLocalFrame", "cosys")]
)
def test_points_of_a_lidar_in_motion_lie_on_the_walls(
    frame: str, flavour: str, tiny_world: str
) -> None:
    def script(airsim: Caller) -> None:
        assert airsim("getLidarData", "", "")["point_cloud"] == []
        airsim("simContinueForTime", 5.0)
        lidar = airsim("getLidarData", "lidar", "")
        cloud = np.array(lidar["point_cloud"]).reshape(-1, 3)
        assert len(cloud) > 3000
        seen = ("groundtruth", "") if flavour == "cosys" else ("segmentation", -1)
        assert lidar[seen[0]] == [seen[1]] * len(cloud)
        assert lidar["time_stamp"] == 4_900_000_000
        w, x, y, z = (lidar["pose"]["orientation"][f"{axis}_val"] for axis in "wxyz")
        assert abs(z) > 0.3
        place = np.array([lidar["pose"]["position"][f"{axis}_val"] for axis in "xyz"])
        assert place[2] < -1.0
        if frame == "SensorLocalFrame":
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ]
            )
            cloud = cloud @ turn.T + place
        # The world: a floor, and a wall 3 m before the vehicle's start.
        floor = np.abs(cloud[:, 2] - 0.1) < 0.01
        wall = np.abs(cloud[:, 0] - 3.0) < 0.01
        assert floor.sum() > 1000
        assert wall.sum() > 200
        assert (floor | wall).all()

    lidar = {"name": "lidar", "channels": 16, "columns": 512, "elevations": (-45.0, 15.0)}
    with_script(
        script,
        [drone(world=tiny_world, lidars=[lidar], position=(1.0, 0.0))],
        inputs=turning(),
        lidar_frame=frame,
        flavour=flavour,
    )
