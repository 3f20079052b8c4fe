"""Events to Foxglove's messages. Our frames keep their names and axes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    Odometry,
    PointCloud,
    PoseEstimate,
    Quaternion,
    Score,
    TrackedFeatures,
    TrackingLost,
    Vector3,
)
from nodes.foxglove_server.scene import Trail
from nodes.viewing.appearance import INLIER, OUTLIER, VEHICLE, Colour, describe
from nodes.viewing.encoding import depth_in_steps, encode_image
from runtime.schedule import SECOND

_VECTOR = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}

IMU_SCHEMA = {
    "title": "Imu",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "angular_velocity": _VECTOR,
        "linear_acceleration": _VECTOR,
    },
}
SCORE_SCHEMA = {
    "title": "Score",
    "type": "object",
    "properties": {"timestamp": _TIME, "value": {"type": "number"}, "unit": {"type": "string"}},
}


class Messages:
    """Makes messages.

    Args:
        types: ``foxglove.messages``.
    """

    def __init__(self, types: Any) -> None:
        self._m = types

    def transforms(self, *transforms: Any) -> Any:
        """Return a FrameTransforms of what `transform` returns."""
        return self._m.FrameTransforms(transforms=list(transforms))

    def transform(
        self, stamp: int, parent: str, child: str, position: Vector3, orientation: Quaternion
    ) -> Any:
        """Return a FrameTransform: a child frame's pose in its parent."""
        return self._m.FrameTransform(
            timestamp=self._time(stamp),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=self._vector(position),
            rotation=self._quaternion(orientation),
        )

    def odometry(self, event: Odometry, body: str) -> Any:
        """Return an Odometry; `body` is what the body's frame is called."""
        return self._m.Odometry(
            timestamp=self._time(event.stamp),
            frame_id=event.frame_id,
            body_frame_id=body,
            pose=self._pose(event.position, event.orientation),
            linear_velocity=self._vector(event.linear_velocity),
            angular_velocity=self._vector(event.angular_velocity),
        )

    def pose(self, event: PoseEstimate, frame_id: str) -> Any:
        """Return a PoseInFrame; `frame_id` is what its parent frame is called."""
        pose = self._pose(event.position, event.orientation)
        return self._m.PoseInFrame(timestamp=self._time(event.stamp), frame_id=frame_id, pose=pose)

    def calibration(self, camera: CameraAnnouncement) -> Any:
        """Return a CameraCalibration: plumb_bob; K, R (one) and P of a single camera."""
        info, k = camera.info, camera.info.matrix()
        return self._m.CameraCalibration(
            timestamp=self._time(camera.stamp),
            frame_id=camera.frame_id,
            width=info.width,
            height=info.height,
            distortion_model="plumb_bob",
            D=list(info.distortion),
            K=k.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.hstack([k, np.zeros((3, 1))]).ravel().tolist(),
        )

    def compressed(self, event: Image, quality: int) -> Any:
        """Return a CompressedImage."""
        return self._m.CompressedImage(
            timestamp=self._time(event.stamp),
            frame_id=event.frame_id,
            data=encode_image(event.data, "jpeg", quality).tobytes(),
            format="jpeg",
        )

    def image(self, event: Image) -> Any:
        """Return a RawImage."""
        return self._raw(event, event.data, "rgb8" if event.data.ndim == 3 else "mono8")

    def depth(self, event: DepthImage) -> Any:
        """Return a RawImage in millimetres; 0 where there is no depth, or more than 65.5 m."""
        return self._raw(event, depth_in_steps(event.data, 1000.0).astype("<u2"), "16UC1")

    def cloud(self, event: PointCloud, frame_id: str) -> Any:
        """Return a PointCloud; `frame_id` is what its frame is called."""
        rows = np.zeros(len(event.points), np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)]))
        rows["xyz"] = event.points
        rows["rgba"] = 255
        if len(event.colors):
            rows["rgba"][:, :3] = event.colors
        numbers, field = self._m.PackedElementFieldNumericType, self._m.PackedElementField
        fields = [(name, 4 * i, numbers.Float32) for i, name in enumerate("xyz")]
        colours = ("red", "green", "blue", "alpha")
        fields += [(name, 12 + i, numbers.Uint8) for i, name in enumerate(colours)]
        return self._m.PointCloud(
            timestamp=self._time(event.stamp),
            frame_id=frame_id,
            pose=self._pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
            point_stride=rows.itemsize,
            fields=[field(name=name, offset=at, type=kind) for name, at, kind in fields],
            data=rows.tobytes(),
        )

    def features(self, event: TrackedFeatures) -> Any:
        """Return an ImageAnnotations: what agrees in green, the rest in red."""
        groups = [
            self._m.PointsAnnotation(
                timestamp=self._time(event.stamp),
                type=self._m.PointsAnnotationType.Points,
                points=[self._m.Point2(x=x, y=y) for x, y in event.points[chosen].tolist()],
                outline_color=self._colour(colour),
                fill_color=self._colour(colour),
                thickness=4.0,
            )
            for chosen, colour in ((event.inliers, INLIER), (~event.inliers, OUTLIER))
        ]
        return self._m.ImageAnnotations(points=groups)

    def imu(self, event: Imu) -> dict[str, Any]:
        """Return what `IMU_SCHEMA` describes."""
        return {
            "timestamp": _json_time(event.stamp),
            "frame_id": event.frame_id,
            "angular_velocity": dict(zip("xyz", event.angular_velocity, strict=True)),
            "linear_acceleration": dict(zip("xyz", event.linear_acceleration, strict=True)),
        }

    def score(self, event: Score) -> dict[str, Any]:
        """Return what `SCORE_SCHEMA` describes."""
        return {"timestamp": _json_time(event.stamp), "value": event.value, "unit": event.unit}

    def log(self, event: Event) -> Any:
        """Return a Log."""
        levels = self._m.LogLevel
        return self._m.Log(
            timestamp=self._time(event.stamp),
            level=levels.Warning if isinstance(event, TrackingLost) else levels.Info,
            message=describe(event),
            name=event.source,
        )

    def scene(self, *entities: Any) -> Any:
        """Return a SceneUpdate of what `line` and `vehicle` return."""
        return self._m.SceneUpdate(entities=list(entities))

    def line(self, trail: Trail, name: str, piece: list[Vector3]) -> Any:
        """Return a piece of a path as a SceneEntity."""
        strip = self._m.LinePrimitive(
            type=self._m.LinePrimitiveLineType.LineStrip,
            thickness=trail.thickness,
            points=[self._m.Point3(x=x, y=y, z=z) for x, y, z in piece],
            color=self._colour(trail.colour),
        )
        return self._m.SceneEntity(frame_id=trail.frame_id, id=name, lines=[strip])

    def vehicle(self, name: str, frame_id: str) -> Any:
        """Return a body with four rotors as a SceneEntity that goes where its frame goes."""
        cubes = [
            self._m.CubePrimitive(
                pose=self._pose(centre, (1.0, 0.0, 0.0, 0.0)),
                size=self._vector(size),
                color=self._colour(colour),
            )
            for centre, size, colour in VEHICLE
        ]
        return self._m.SceneEntity(frame_id=frame_id, id=name, frame_locked=True, cubes=cubes)

    def _raw(self, event: Image | DepthImage, data: npt.NDArray[Any], encoding: str) -> Any:
        data = np.ascontiguousarray(data)
        return self._m.RawImage(
            timestamp=self._time(event.stamp),
            frame_id=event.frame_id,
            width=data.shape[1],
            height=data.shape[0],
            encoding=encoding,
            step=data.strides[0],
            data=data.tobytes(),
        )

    def _pose(self, position: Vector3, orientation: Quaternion) -> Any:
        return self._m.Pose(
            position=self._vector(position), orientation=self._quaternion(orientation)
        )

    def _vector(self, vector: Vector3) -> Any:
        x, y, z = vector
        return self._m.Vector3(x=x, y=y, z=z)

    def _quaternion(self, rotation: Quaternion) -> Any:
        w, x, y, z = rotation
        return self._m.Quaternion(x=x, y=y, z=z, w=w)

    def _colour(self, colour: Colour) -> Any:
        r, g, b = colour
        return self._m.Color(r=r / 255, g=g / 255, b=b / 255, a=1.0)

    def _time(self, stamp: int) -> Any:
        return self._m.Timestamp(sec=stamp // SECOND, nsec=stamp % SECOND)


def _json_time(stamp: int) -> dict[str, int]:
    return {"sec": stamp // SECOND, "nsec": stamp % SECOND}
