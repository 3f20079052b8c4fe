"""Sensors as scripts read them, estimates that they publish, and recordings read back."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from events import Arm, EstimatorAnnouncement, Event, PoseEstimate, PositionSetpoint, Takeoff
from events.frames import angle_between, from_rpy, multiply
from extensions.airsim.tests.scripts import Caller, RefusedError, Script, drone, with_script
from runtime.testing import NodeResult
from visnav_airsim.server.measurements import HEADER

ALL: dict[str, Any] = {
    "barometer": {"noise": 0.0, "drift": 0.0},
    "magnetometer": {"noise": 0.0, "model": "airsim"},
    "gnss": {},
    "range_finders": [
        {"name": "down", "orientation": (0.0, -90.0, 0.0), "noise": 0.0, "min_range": 0.0},
        {"name": "ahead", "position": (0.1, 0.0, 0.0), "noise": 0.0, "max_range": 3.0},
    ],
}


@pytest.mark.slow
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


def test_sensors_that_are_not_there_are_refused(tiny_world: str) -> None:
    kinds = {
        "getImuData": "IMU",
        "getBarometerData": "barometer",
        "getMagnetometerData": "magnetometer",
        "getGpsData": "gps",
        "getDistanceSensorData": "distance sensor",
        "getLidarData": "lidar",
    }

    def script(airsim: Caller) -> None:
        for method, kind in kinds.items():
            airsim.refuses(f"No {kind} with name X exist on vehicle", method, "X", "")
            airsim.refuses("Vehicle API for 'nobody' is not available", method, "", "nobody")

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


@pytest.mark.slow
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


@pytest.mark.slow
def test_points_of_a_lidar_lie_where_its_announced_mounting_puts_them(tiny_world: str) -> None:
    reply: dict[str, Any] = {}

    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.3)
        reply.update(airsim("getLidarData", "lidar", ""))

    lidar = {"name": "lidar", "channels": 4, "columns": 64, "elevations": (-45.0, -15.0)}
    lidar |= {"calibration_error": {"position": [0.0, 0.0, 0.25]}}
    with_script(
        script, [drone(world=tiny_world, lidars=[lidar])], lidar_frame="VehicleInertialFrame"
    )
    assert reply["pose"]["position"]["z_val"] == pytest.approx(0.25, abs=0.02)
    heights = np.array(reply["point_cloud"]).reshape(-1, 3)[:, 2]
    assert np.median(heights) == pytest.approx(0.1 + 0.25, abs=0.02)  # the floor


START = (2.0, -1.0)


def pose(*numbers: float) -> dict[str, dict[str, float]]:
    """Return a pose as clients send it: x, y, z, and the quaternion w, x, y, z."""
    x, y, z, w, a, b, c = (*numbers, *(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)[len(numbers) :])
    return {
        "position": {"x_val": x, "y_val": y, "z_val": z},
        "orientation": {"w_val": w, "x_val": a, "y_val": b, "z_val": c},
    }


def published(world: str, script: Script, **estimator: Any) -> NodeResult:
    """Run a script beside a drone that does not start at the origin."""
    settings = {"name": "odometry", **estimator}
    return with_script(script, [drone(world=world, position=START)], estimators=[settings])


def test_a_pose_becomes_an_estimate_of_its_image(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 400_000_000, pose(1, 2, -3))

    result = published(tiny_world, script, method="sparse", scale_free=True, reads=["grey"])
    (estimate,) = result.of(PoseEstimate)
    assert (estimate.stamp, estimate.source, estimate.frame_id) == (400_000_000, "odometry", "odom")
    assert estimate.position == (1.0, 2.0, -3.0)
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.source, said.method, said.scale_free, said.reads) == (
        "odometry", "sparse", True, ("grey",)
    )  # fmt: skip


def test_the_local_frame_becomes_the_map(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 1, pose(1, 2, 0))

    result = published(tiny_world, script, frame_id="map", vehicle="drone")
    (estimate,) = result.of(PoseEstimate)
    assert estimate.frame_id == "map"
    (said,) = result.of(EstimatorAnnouncement)
    assert (estimate.source, said.vehicle) == ("odometry", "drone")
    assert estimate.position[:2] == pytest.approx((START[0] + 1, START[1] + 2))


NO_ESTIMATES: list[tuple[tuple[Any, ...], str]] = [
    (("nobody", 1, pose()), "expected an estimator of the settings (odometry), found 'nobody'"),
    (("odometry", 500_000_001, pose()), "expected a stamp after 5 and up to 500000000 ns"),
    (("odometry", 5, pose()), "expected a stamp after 5 and up to 500000000 ns, found 5"),
    (("odometry", -1, pose()), "expected a stamp after 5"),
    (("odometry", 6, pose(math.nan)), "expected a pose of finite numbers"),
    (("odometry", 6, pose(0, 0, math.inf)), "expected a pose of finite numbers"),
    (("odometry", 6, pose(0, 0, 0, 0)), "whose orientation is a unit quaternion"),
    (("odometry", 6, pose(0, 0, 0, math.nan)), "whose orientation is a unit quaternion"),
    (("odometry", 6, pose(0, 0, 0, 2)), "whose orientation is a unit quaternion"),
    (("odometry", "6", pose()), "Expected `int`, got `str`"),
    (("odometry", 6), "invalid number of arguments. Expected: 3, got: 2"),
]


def test_what_is_no_estimate_is_refused(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 5, pose())
        for call, error in NO_ESTIMATES:
            airsim.refuses(error, "visnavPublishPose", *call)
        airsim("visnavPublishPose", "odometry", 6, pose())  # what was refused has changed nothing

    assert [e.stamp for e in published(tiny_world, script).of(PoseEstimate)] == [5, 6]


def test_poses_of_a_camera_become_those_of_the_vehicle(tiny_world: str) -> None:
    """Of a camera that looks down from 0.3 m ahead, on a body that has turned by 90°."""
    mount = {"name": "eye", "position": [0.3, 0.0, 0.1], "orientation": [0.0, -90.0, 0.0]}
    body = from_rpy(0.0, 0.0, math.radians(90.0))
    turn = multiply(body, from_rpy(0.0, math.radians(-90.0), 0.0))

    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.1)
        airsim("visnavPublishPose", "odometry", 1, pose(1.0, 2.3, -1.9, *turn))

    with_camera: dict[str, Any] = {
        "estimators": [{"name": "odometry", "camera": "eye"}],
        "cameras": [mount],
    }
    (estimate,) = with_script(script, [drone(world=tiny_world)], **with_camera).of(PoseEstimate)
    assert estimate.position == pytest.approx((1.0, 2.0, -2.0))
    assert angle_between(estimate.orientation, body) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("estimators", "error"),
    [
        ([{"name": "a", "camera": "nowhere"}], "estimators: a: expected a camera of drone"),
        ([{"name": "a", "vehicle": "nobody"}], "estimators: a: .*'nobody' is not available"),
        ([{"name": "a"}, {"name": "a"}], "estimators: expected names of their own"),
    ],
)
def test_an_estimator_of_nothing_is_an_error_of_the_file(
    estimators: list[dict[str, str]], error: str, tiny_world: str
) -> None:
    with pytest.raises(Exception, match=error):
        with_script(lambda _: None, [drone(world=tiny_world)], estimators=estimators)


SMALL = {"captures": [{"width": 32, "height": 16}, {"image_type": 1, "width": 32, "height": 16}]}
CAMERAS = [{"name": "eye", **SMALL}]
PNG = {"camera": "eye"}
PPM = {"camera": "eye", "compress": False}
PFM = {"camera": "eye", "image_type": 1, "pixels_as_float": True}


def read_back(out: Path) -> list[dict[str, str]]:
    """Return the rows of the only recording, split on tabs, as pandas does."""
    (table,) = out.glob("recording/*/airsim_rec.txt")
    assert re.fullmatch(r"\d{4}(-\d\d){5}(-\d+)?", table.parent.name)
    header, *rows = table.read_text().splitlines()
    assert header == HEADER
    names = header.split("\t")
    return [dict(zip(names, row.split("\t"), strict=True)) for row in rows]


def image_file(out: Path, name: str) -> Path:
    return next(out.glob(f"recording/*/images/{name}"))


def recorded(
    script: Any, world: str, out: Path, images: Any = (PNG,), vehicles: Any = None, **settings: Any
) -> NodeResult:
    return with_script(
        script,
        vehicles or [drone(world=world)],
        out=out,
        cameras=CAMERAS,
        recording={"images": images, **settings},
    )


@pytest.mark.slow
def test_a_recording_is_read_back_as_airsims(tiny_world: str, tmp_path: Path) -> None:
    taken: list[Any] = []

    def script(airsim: Caller) -> None:
        assert airsim("isRecording") is False
        requests = [
            {"camera_name": "eye", "image_type": type_, "pixels_as_float": float_, "compress": png}
            for type_, float_, png in ((0, False, True), (0, False, False), (1, True, False))
        ]
        taken.extend(airsim("simGetImages", requests, "", False))
        airsim("startRecording")
        assert airsim("isRecording") is True
        airsim("simContinueForTime", 0.25)
        airsim("stopRecording")
        assert airsim("isRecording") is False
        airsim("simContinueForTime", 0.2)

    recorded(script, tiny_world, tmp_path, [PNG, PPM, PFM], interval="100ms")
    rows = read_back(tmp_path)
    assert [row["TimeStamp"] for row in rows] == ["0", "100", "200"]
    assert {row["VehicleName"] for row in rows} == {"drone"}
    assert float(rows[0]["POS_Z"]) == pytest.approx(0.0, abs=0.01)
    assert float(rows[0]["Q_W"]) == pytest.approx(1.0, abs=0.01)
    names = rows[0]["ImageFile"].split(";")
    assert names == ["img_drone_eye_0_0.png", "img_drone_eye_0_0.ppm", "img_drone_eye_1_0.pfm"]
    png, ppm, pfm = (image_file(tmp_path, name) for name in names)
    assert png.read_bytes() == taken[0]["image_data_uint8"]
    colours = np.frombuffer(taken[1]["image_data_uint8"], np.uint8).reshape(16, 32, 3)  # BGR
    np.testing.assert_array_equal(cv2.imread(str(ppm)), colours)
    header, size, scale, data = pfm.read_bytes().split(b"\n", 3)
    assert (header, size, scale) == (b"Pf", b"32 16", b"-1")
    np.testing.assert_array_equal(
        np.frombuffer(data, "<f4"), np.array(taken[2]["image_data_float"], np.float32)
    )


@pytest.mark.slow
def test_each_row_has_the_pose_of_its_images_instant(tiny_world: str, tmp_path: Path) -> None:
    poses: dict[str, float] = {}

    def script(airsim: Caller) -> None:
        airsim("startRecording")
        for _ in range(10):
            pose = airsim("simGetVehiclePose", "")
            state = airsim("getMultirotorState", "")
            poses[str(state["timestamp"] // 10**6)] = pose["position"]["z_val"]
            airsim("simContinueForTime", 0.05)

    recorded(script, tiny_world, tmp_path, vehicles=[drone(world=tiny_world, height=2.0)])
    rows = {row["TimeStamp"]: float(row["POS_Z"]) for row in read_back(tmp_path)}
    assert len(rows) >= 10
    assert rows["450"] > 0.8  # it falls
    for stamp, height in poses.items():
        assert rows[stamp] == pytest.approx(height, abs=1e-6)


@pytest.mark.slow
def test_a_vehicle_that_stands_is_left_out_if_asked(tiny_world: str, tmp_path: Path) -> None:
    vehicles = [
        drone("falls", world=tiny_world, height=3.0, position=(2.0, 0.0)),
        drone("stands", world=tiny_world),
    ]

    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.25)

    recorded(script, tiny_world, tmp_path, vehicles=vehicles, on_move=True, enabled=True)
    rows = read_back(tmp_path)
    assert [row["VehicleName"] for row in rows].count("falls") >= 5
    assert [row["VehicleName"] for row in rows].count("stands") < 5


@pytest.mark.slow
def test_two_recordings_at_a_time_are_one_and_two_in_turn_are_two(
    tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        for _ in range(2):
            airsim("startRecording")
            airsim("startRecording")
            airsim("simContinueForTime", 0.01)
            airsim("stopRecording")
            airsim("stopRecording")

    recorded(script, tiny_world, tmp_path)
    assert len(list(tmp_path.glob("recording/*/airsim_rec.txt"))) == 2


@pytest.mark.slow
def test_a_folder_that_is_lost_ends_the_recording_and_not_the_run(
    tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        airsim("startRecording")
        airsim("simContinueForTime", 0.05)
        (images,) = tmp_path.glob("recording/*/images")
        images.rename(tmp_path / "gone")
        airsim("simContinueForTime", 0.2)
        assert airsim("isRecording") is False
        with pytest.raises(RefusedError, match=r"recording has ended: .*No such file"):
            airsim("stopRecording")
        airsim("stopRecording")
        assert airsim("ping")

    recorded(script, tiny_world, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "error"),
    [
        ([{"camera": "nobody"}], "found 'nobody'"),
        ([{"camera": "eye", "image_type": 9}], "images of type 9"),
    ],
)
def test_what_cannot_be_taken_ends_the_recording(
    images: Any, error: str, tiny_world: str, tmp_path: Path
) -> None:
    def script(airsim: Caller) -> None:
        airsim("startRecording")
        airsim("simContinueForTime", 0.1)
        with pytest.raises(RefusedError, match=error):
            airsim("stopRecording")

    recorded(script, tiny_world, tmp_path, images)


def test_without_a_folder_for_results_nothing_is_recorded(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim.refuses("expected a run with a folder of results", "startRecording")
        assert airsim("isRecording") is False

    with_script(script, [drone(world=tiny_world)], recording={"enabled": True})


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_is_told(tiny_world: str, tmp_path: Path) -> None:
    (tmp_path / "recording").write_text("in the way")

    def script(airsim: Caller) -> None:
        airsim.refuses("the recording could not begin", "startRecording")

    recorded(script, tiny_world, tmp_path)
