"""Events that the tests of the view share, and a reader of what was recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    BodyAnnouncement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    Imu,
    LidarAnnouncement,
    LidarScan,
    NavSatFix,
    Odometry,
    PoseEstimate,
    PoseStamped,
    Quaternion,
    Score,
    TrackedFeatures,
    Vector3,
    VehicleAnnouncement,
)

MS = 1_000_000
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
AHEAD: Quaternion = (0.5, 0.5, 0.5, 0.5)
"""An optical frame on a body: z forward, x right, y down."""

VEHICLE = VehicleAnnouncement(
    stamp=0,
    source="drone",
    mass=1.0,
    max_thrust=20.0,
    control_rate=400.0,
    position=(0.0, 0.0, 0.0),
    orientation=UPRIGHT,
)
CAMERA = CameraAnnouncement(
    stamp=0,
    source="drone/camera",
    images=("rgb", "depth"),
    info=CameraInfo(width=8, height=6, fx=4.0, fy=4.0, cx=3.5, cy=2.5),
    rate=30.0,
    latency=0.0,
    frame_id="drone/camera_optical",
    parent_frame_id="base_link",
    position=(0.1, 0.2, 0.3),
    orientation=AHEAD,
)
ESTIMATOR = EstimatorAnnouncement(stamp=0, source="vo", method="features")


def odometry(stamp: int, position: Vector3 = (1.0, 2.0, -3.0)) -> Odometry:
    return Odometry(
        stamp=stamp,
        source="drone",
        position=position,
        orientation=(0.5, 0.1, 0.7, np.sqrt(0.25)),
        linear_velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
    )


def estimate(stamp: int, position: Vector3, frame_id: str = "map") -> PoseEstimate:
    return PoseEstimate(
        stamp=stamp, source="vo", frame_id=frame_id, position=position, orientation=UPRIGHT
    )


def imu(stamp: int) -> Imu:
    return Imu(
        stamp=stamp,
        source="drone/imu",
        angular_velocity=(0.1, 0.2, 0.3),
        linear_acceleration=(0.0, 0.0, -9.81),
    )


def score(stamp: int, metric: str = "position_error", unit: str = "m") -> Score:
    return Score(stamp=stamp, source="e", subject="vo", metric=metric, value=0.5, unit=unit)


def image(stamp: int) -> Image:
    data = np.zeros((6, 8, 3), np.uint8)
    data[:] = (200, 100, 50)
    return Image(stamp=stamp, source="drone/camera", frame_id="drone/camera_optical", data=data)


def depth(stamp: int, metres: float = 2.0) -> DepthImage:
    data = np.full((6, 8), metres, np.float32)
    return DepthImage(
        stamp=stamp, source="drone/camera", frame_id="drone/camera_optical", data=data
    )


def camera_pose(stamp: int, position: Vector3 = (10.0, 20.0, -1.0)) -> PoseStamped:
    return PoseStamped(stamp=stamp, source="drone/camera", position=position, orientation=AHEAD)


def features(stamp: int) -> TrackedFeatures:
    return TrackedFeatures(
        stamp=stamp,
        source="vo",
        frame_id="drone/camera_optical",
        points=np.array([[1.0, 2.0], [3.0, 4.0]], np.float32),
        inliers=np.array([True, False]),
    )


def decoded(coded: bytes | list[int], mode: int) -> npt.NDArray[Any]:
    """Read a JPEG or PNG."""
    data = np.frombuffer(coded, np.uint8) if isinstance(coded, bytes) else np.array(coded, np.uint8)
    image = cv2.imdecode(data, mode)
    assert image is not None
    return image


class Recorded:
    """What a file holds, read back by the library."""

    def __init__(self, file: Path) -> None:
        import rerun.chunk

        self._rows: dict[tuple[str, str], list[tuple[int | None, int | None, Any]]] = {}
        self.entities: set[str] = set()
        for chunk in rerun.chunk.RrdReader(file).stream():
            entity = chunk.entity_path.removeprefix("/")
            self.entities.add(entity)
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            for name, column in columns.items():
                if name in ("run", "event") or ":" not in name:
                    continue
                rows = self._rows.setdefault((entity, name), [])
                for i, value in enumerate(column.to_pylist()):
                    rows.append((_time(columns, "run", i), _time(columns, "event", i), value))

    def of(self, entity: str, component: str) -> list[tuple[int | None, int | None, Any]]:
        """Return the rows of a component, by time: stamp (ns), number, values."""
        rows = [row for row in self._rows.get((entity, component), []) if row[2] is not None]
        return sorted(rows, key=lambda row: row[0] or 0)

    def stamps(self, entity: str, component: str) -> list[int | None]:
        """Return the stamps of a component."""
        return [stamp for stamp, _, _ in self.of(entity, component)]

    def values(self, entity: str, component: str) -> npt.NDArray[np.float64]:
        """Return the values of a component, one row for each time."""
        return np.array([value for _, _, value in self.of(entity, component)], np.float64)


def _time(columns: dict[str, Any], name: str, row: int) -> int | None:
    column = columns.get(name)
    if column is None:
        return None
    value = column.cast("int64")[row].as_py()
    return None if value is None else int(value)


SECOND_VEHICLE = msgspec.structs.replace(VEHICLE, source="other", position=(5.0, 0.0, 0.0))
SECOND_CAMERA = msgspec.structs.replace(
    CAMERA, source="other/camera", frame_id="other/camera_optical"
)
LIDAR = LidarAnnouncement(
    stamp=0,
    source="other/lidar",
    rate=10.0,
    frame_id="other/lidar",
    position=(0.0, 0.0, -0.1),
    channels=16,
    columns=1024,
    horizontal_fov=6.28,
    elevations=(-0.3, 0.3),
    noise=0.0,
    min_range=0.1,
    max_range=50.0,
)
PERSON = BodyAnnouncement(stamp=0, source="world/person", kind="person", object_ids=(3,))


def scan(stamp: int, source: str = "other/lidar") -> LidarScan:
    return LidarScan(
        stamp=stamp,
        source=source,
        frame_id=source,
        points=np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        intensities=np.array([0.25, 0.75], np.float32),
        times=np.array([0.0, 0.05], np.float32),
        rings=np.array([0, 15], np.uint16),
    )


def fix(stamp: int) -> NavSatFix:
    return NavSatFix(
        stamp=stamp,
        source="drone/gnss",
        latitude=47.5,
        longitude=8.25,
        altitude=450.0,
        position_covariance=(1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0),
        velocity=(1.0, 2.0, 3.0),
    )
