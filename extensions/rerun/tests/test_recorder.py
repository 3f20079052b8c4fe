"""What a recording holds, read back from its file."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from events import (
    Announcement,
    Event,
    FluidPressure,
    PlannedPose,
    PointCloud,
    PoseStamped,
    PositionSetpoint,
    TrackingLost,
    Wind,
)
from tests.nodes.viewers.common.samples import (
    CAMERA,
    ESTIMATOR,
    LIDAR,
    MS,
    PERSON,
    SECOND_CAMERA,
    SECOND_VEHICLE,
    UPRIGHT,
    VEHICLE,
    Recorded,
    camera_pose,
    decoded,
    depth,
    estimate,
    features,
    fix,
    image,
    imu,
    odometry,
    scan,
    score,
)
from visnav_rerun.node import Recorder
from visnav_rerun.sdk import RerunConfig

TRANSLATION, QUATERNION = "Transform3D:translation", "Transform3D:quaternion"


def record(tmp_path: Path, *batches: list[Event], **settings: float) -> Recorded:
    """Record batches of events and read them back."""
    file = tmp_path / "flight.rrd"
    recorder = Recorder(msgspec.convert(settings, RerunConfig), "test", file)
    recorder.begin([VEHICLE, CAMERA, ESTIMATOR])
    number = 0
    for batch in batches:
        recorder.log([(number + i, event) for i, event in enumerate(batch)])
        number += len(batch)
    recorder.close()
    recorder.close()  # as a worker's end does once more
    return Recorded(file)


@pytest.mark.slow
def test_a_pose_lands_where_it_was_said_on_both_time_lines(tmp_path: Path) -> None:
    events: list[Event] = [odometry((3 + i) * MS, (1.0 + i, 2.0, -3.0)) for i in range(4)]
    shown = record(tmp_path, events[:2], events[2:])
    rows = shown.of("map/drone", TRANSLATION)
    assert [(stamp, number) for stamp, number, _ in rows] == [((3 + i) * MS, i) for i in range(4)]
    assert shown.values("map/drone", TRANSLATION)[:, 0] == pytest.approx(
        np.array([[1.0 + i, 2.0, -3.0] for i in range(4)])
    )
    # w comes last in Rerun
    assert shown.values("map/drone", QUATERNION)[0, 0] == pytest.approx([0.1, 0.7, 0.5, 0.5])


@pytest.mark.slow
def test_the_world_points_north_east_down(tmp_path: Path) -> None:
    shown = record(tmp_path)
    forward, right, down = 5, 3, 2  # rerun.components.ViewCoordinates
    assert shown.values("map", "ViewCoordinates:xyz").ravel().tolist() == [forward, right, down]


def test_a_camera_sits_on_its_vehicle_and_sees_as_announced(tmp_path: Path) -> None:
    shown = record(tmp_path)
    entity = "map/drone/camera"
    assert shown.values(entity, TRANSLATION).ravel() == pytest.approx([0.1, 0.2, 0.3])
    for kind, stride in (("rgb", 1), ("depth", 2)):
        matrix = shown.values(f"{entity}/{kind}", "Pinhole:image_from_camera").reshape(3, 3).T
        expected = [[4 / stride, 0, 3.5 / stride + 0.5], [0, 4 / stride, 2.5 / stride + 0.5]]
        assert matrix[:2] == pytest.approx(np.array(expected))


def test_a_camera_of_another_name_sits_on_the_vehicle_all_the_same(tmp_path: Path) -> None:
    recorder = Recorder(RerunConfig(), "test", tmp_path / "flight.rrd")
    recorder.begin([msgspec.structs.replace(CAMERA, source="front"), VEHICLE])
    recorder.close()
    entity = "map/drone/front"
    position = Recorded(tmp_path / "flight.rrd").values(entity, TRANSLATION).ravel()
    assert position == pytest.approx([0.1, 0.2, 0.3])


def test_a_cloud_lies_in_its_frame(tmp_path: Path) -> None:
    """A map from poses in an estimator's own frame goes where that frame was laid."""
    points = np.ones((2, 3), np.float32)
    none = np.zeros((0, 3), np.uint8)
    clouds: list[Event] = [
        PointCloud(stamp=MS, source="map", frame_id=frame_id, points=points, colors=none)
        for frame_id in ("map", "odom", "base_link", "drone/camera_optical")
    ]
    shown = record(tmp_path, [odometry(0), estimate(0, (0.0, 0.0, 0.0), "odom")], clouds)
    places = {entity for entity in shown.entities if "cloud" in entity}
    assert places == {
        "map/clouds/map",
        "map/estimates/vo/cloud/map",
        "map/drone/cloud/map",
        "map/drone/camera/cloud/map",
    }


def test_a_path_is_logged_once_in_pieces(tmp_path: Path) -> None:
    events: list[Event] = [odometry(i * 10 * MS, (0.02 * i, 0.0, 0.0)) for i in range(100)]
    shown = record(tmp_path, events[:30], events[30:])
    strips = [strip for _, _, (strip,) in shown.of("map/truth/drone", "LineStrips3D:strips")]
    assert len(strips) == 4
    assert sum(len(strip) for strip in strips) == 100 + 3
    assert strips[-1][-1] == pytest.approx([1.98, 0.0, 0.0])


def test_estimates_in_map_are_left_as_they_are(tmp_path: Path) -> None:
    shown = record(tmp_path, [odometry(0), estimate(0, (5.0, 6.0, -7.0))])
    assert shown.of("map/estimates/vo", TRANSLATION) == []
    assert shown.values("map/estimates/vo/body", TRANSLATION).ravel() == pytest.approx([5, 6, -7])


def test_estimates_in_a_frame_of_their_own_begin_at_the_truth(tmp_path: Path) -> None:
    truth = odometry(10 * MS, (1.0, 2.0, -3.0))
    shown = record(tmp_path, [odometry(0), truth, estimate(10 * MS, (0.0, 0.0, 0.0), "odom")])
    assert shown.values("map/estimates/vo", TRANSLATION).ravel() == pytest.approx([1, 2, -3])
    turned = shown.values("map/estimates/vo", QUATERNION).ravel()
    assert turned == pytest.approx([0.1, 0.7, 0.5, 0.5])


def test_images_and_features_are_below_their_camera(tmp_path: Path) -> None:
    events: list[Event] = [camera_pose(0), depth(0), image(0), features(0)]
    shown = record(tmp_path, events, points_max_height=9.0)
    entity = "map/drone/camera"
    ((_, _, (blob,)),) = shown.of(f"{entity}/rgb", "EncodedImage:blob")
    assert decoded(blob, cv2.IMREAD_COLOR)[3, 4] == pytest.approx([50, 100, 200], abs=4)
    ((_, _, (blob,)),) = shown.of(f"{entity}/depth", "EncodedDepthImage:blob")
    assert decoded(blob, cv2.IMREAD_UNCHANGED).tolist() == [[200] * 4] * 3
    points = shown.values(f"{entity}/rgb/features/vo", "Points2D:positions")
    assert points[0] == pytest.approx(np.array([[1.5, 2.5], [3.5, 4.5]]))
    assert len(shown.values("map/points/drone/camera", "Points3D:positions")[0]) == 2


def test_images_that_nobody_announced_are_shown_by_themselves(tmp_path: Path) -> None:
    stray = msgspec.structs.replace(image(0), source="web/cam", frame_id="web_optical")
    points = msgspec.structs.replace(features(0), frame_id="web_optical")
    shown = record(tmp_path, [stray, points])
    assert len(shown.of("images/web/cam/rgb", "EncodedImage:blob")) == 1
    assert len(shown.of("images/web/cam/rgb/features/vo", "Points2D:positions")) == 1


def test_quality_nought_leaves_images_as_they_are(tmp_path: Path) -> None:
    shown = record(tmp_path, [image(0)], jpeg_quality=0)
    assert len(shown.of("map/drone/camera/rgb", "Image:buffer")) == 1
    assert shown.of("map/drone/camera/rgb", "EncodedImage:blob") == []


def test_curves_have_handy_units(tmp_path: Path) -> None:
    shown = record(tmp_path, [imu(0), imu(MS), score(0), score(0, "rotation_error", "rad")])
    scalars = "Scalars:scalars"
    turning = shown.values("imu/angular_velocity/drone/imu", scalars)
    assert turning == pytest.approx(np.array([[0.1, 0.2, 0.3]] * 2))
    assert shown.values("scores/position_error/vo", scalars).ravel() == pytest.approx([0.5])
    degrees = shown.values("scores/rotation_error/vo", scalars).ravel()
    assert degrees == pytest.approx(np.degrees([0.5]))


def test_the_plan_and_what_happened_are_there(tmp_path: Path) -> None:
    plan: list[Event] = [
        PositionSetpoint(stamp=i * 20 * MS, source="tour", position=(0.1 * i, 0.0, -1.0))
        for i in range(5)
    ]
    lost = TrackingLost(stamp=MS, source="vo", reason="too dark")
    shown = record(tmp_path, [*plan, lost])
    assert len(shown.of("map/plan", "LineStrips3D:strips")) == 1
    assert shown.of("log", "TextLog:text")[0][2] == ["vo: TrackingLost (too dark)"]


def record_all(tmp_path: Path, announced: list[Announcement], events: list[Event]) -> Recorded:
    """Record events of what is announced beside the vehicle, its camera and the estimator."""
    file = tmp_path / "flight.rrd"
    recorder = Recorder(RerunConfig(), "test", file)
    recorder.begin([VEHICLE, CAMERA, ESTIMATOR, *announced])
    recorder.log(list(enumerate(events)))
    recorder.close()
    return Recorded(file)


def test_sensors_are_plotted_and_lidars_wind_and_bodies_stand_in_the_world(tmp_path: Path) -> None:
    wind = Wind(stamp=0, source="drone", velocity=(3.0, 4.0, 0.0))
    pressure = FluidPressure(stamp=0, source="drone/barometer", fluid_pressure=1e5)
    walks: list[Event] = [
        PoseStamped(
            stamp=i * 100 * MS,
            source="world/person",
            position=(1.0, 0.1 * i, -0.9),
            orientation=UPRIGHT,
        )
        for i in range(8)
    ]
    events = [odometry(0), wind, pressure, fix(0), scan(0), *walks]
    shown = record_all(tmp_path, [SECOND_VEHICLE, LIDAR, PERSON], events)
    assert shown.values("pressures/fluid_pressure/drone/barometer", "Scalars:scalars") == 1e5
    velocity = shown.values("fixes/velocity/drone/gnss", "Scalars:scalars").ravel()
    assert velocity.tolist() == [1.0, 2.0, 3.0]
    place = shown.values("gps/drone/gnss", "GeoPoints:positions").ravel()
    assert place.tolist() == [47.5, 8.25]
    assert shown.values("map/other/lidar", TRANSLATION).ravel() == pytest.approx([0, 0, -0.1])
    points = shown.values("map/other/lidar/points", "Points3D:positions")[0]
    assert points.tolist() == scan(0).points.tolist()
    assert shown.values("map/wind/drone", "Arrows3D:vectors").ravel().tolist() == [3.0, 4.0, 0.0]
    assert shown.values("map/wind/drone", "Arrows3D:origins").ravel().tolist() == [1.0, 2.0, -3.0]
    assert len(shown.of("map/world/person", TRANSLATION)) == 8
    assert shown.of("map/paths/world/person", "LineStrips3D:strips")


def test_of_two_vehicles_each_has_its_path_plan_and_estimates(tmp_path: Path) -> None:
    second = msgspec.structs.replace(odometry(0), source="other", position=(9.0, 0.0, 0.0))
    seen = msgspec.structs.replace(features(0), frame_id="other/camera_optical")
    plan: list[Event] = [
        PlannedPose(
            stamp=i * 100 * MS, source="p", vehicle="other", position=(0.1 * i, 0, 0), yaw=0.0
        )
        for i in range(8)
    ]
    events = [odometry(0), second, seen, estimate(0, (0.0, 0.0, 0.0), "odom"), *plan]
    shown = record_all(tmp_path, [SECOND_VEHICLE, SECOND_CAMERA], events)
    assert shown.values("map/estimates/vo", TRANSLATION).ravel() == pytest.approx([9, 0, 0])
    assert shown.of("map/plan/other", "LineStrips3D:strips")
    assert shown.of("map/other", TRANSLATION)
    assert "map/other/camera" in shown.entities


def test_of_a_distorted_camera_it_is_said_that_rerun_shows_none(tmp_path: Path) -> None:
    info = msgspec.structs.replace(CAMERA.info, distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))
    bent = msgspec.structs.replace(CAMERA, source="drone/bent", frame_id="bent", info=info)
    twin = msgspec.structs.replace(
        bent, source="drone/bent/undistorted", info=CAMERA.info, undistorted="drone/bent"
    )
    seen = msgspec.structs.replace(image(0), source="drone/bent", frame_id="bent")
    straight = msgspec.structs.replace(seen, source="drone/bent/undistorted")
    shown = record_all(tmp_path, [bent, twin], [seen, straight])
    (note,) = (entity for entity in shown.entities if entity.startswith("log/notes"))
    assert note == "log/notes/drone/bent"
    assert shown.of("map/drone/bent/rgb", "EncodedImage:blob")
    assert shown.of("map/drone/bent/undistorted/rgb", "EncodedImage:blob")
    # It is below its camera in the tree, and so at the same place.
    assert shown.values("map/drone/bent", TRANSLATION).size == 3
    assert shown.of("map/drone/bent/undistorted", TRANSLATION) == []
