"""Events to Foxglove's messages. Our frames keep their names and axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_type_hints

import numpy as np
import numpy.typing as npt

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    LidarScan,
    NavSatFix,
    Odometry,
    PointCloud,
    PoseEstimate,
    Quaternion,
    Score,
    TrackedFeatures,
    TrackingLost,
    Vector3,
)
from events.frames import convert_covariance
from nodes.ros_messages.calibration import projection_matrix
from nodes.ros_messages.images import LIDAR_POINT
from nodes.viewing.appearance import INLIER, OUTLIER, VEHICLE, Box, Colour, describe
from nodes.viewing.encoding import depth_in_steps, encode_image
from nodes.viewing.measurements import as_json, fields_of
from nodes.viewing.paths import Trail
from runtime.schedule import SECOND

_VECTOR = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}

SCORE_SCHEMA = {
    "title": "Score",
    "type": "object",
    "properties": {"timestamp": _TIME, "value": {"type": "number"}, "unit": {"type": "string"}},
}

_DISTORTIONS = {"equidistant": "kannala_brandt"}
"""What Foxglove calls distortion models that it has another name for."""


def measurement_schema(kind: type[Event]) -> dict[str, Any]:
    """Return the JSON schema of what `Messages.measurement` makes of events of a type."""
    hints = get_type_hints(kind)
    properties = {
        field: {"type": "number"} if hints[field] is float else _VECTOR for field in fields_of(kind)
    }
    frame = {"timestamp": _TIME, "frame_id": {"type": "string"}}
    return {"title": kind.__name__, "type": "object", "properties": frame | properties}


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
        """Return a CameraCalibration: K, D, R (one) and P, with a stereo rig's baseline."""
        info = camera.info
        return self._m.CameraCalibration(
            timestamp=self._time(camera.stamp),
            frame_id=camera.frame_id,
            width=info.width,
            height=info.height,
            distortion_model=_DISTORTIONS.get(info.distortion_model, info.distortion_model),
            D=list(info.distortion),
            K=info.matrix().ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=projection_matrix(camera).ravel().tolist(),
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
        kind = self._m.PackedElementFieldNumericType.Uint8
        colours = ("red", "green", "blue", "alpha")
        fields = [(name, 12 + i, kind) for i, name in enumerate(colours)]
        return self._points(event.stamp, frame_id, rows, fields)

    def scan(self, event: LidarScan, frame_id: str) -> Any:
        """Return a PointCloud of a lidar's turn, with its intensities, rings and times."""
        rows = np.zeros(len(event.points), LIDAR_POINT)
        rows["xyz"] = event.points
        rows["intensity"], rows["ring"], rows["time"] = event.intensities, event.rings, event.times
        kinds = self._m.PackedElementFieldNumericType
        fields = [("intensity", 12, kinds.Float32), ("ring", 16, kinds.Uint16)]
        return self._points(event.stamp, frame_id, rows, [*fields, ("time", 18, kinds.Float32)])

    def _points(
        self,
        stamp: int,
        frame_id: str,
        rows: npt.NDArray[np.void],
        more: list[tuple[str, int, Any]],
    ) -> Any:
        """Return a PointCloud whose rows begin with x, y and z; `more` are its other fields."""
        field, number = self._m.PackedElementField, self._m.PackedElementFieldNumericType.Float32
        fields = [*((name, 4 * i, number) for i, name in enumerate("xyz")), *more]
        return self._m.PointCloud(
            timestamp=self._time(stamp),
            frame_id=frame_id,
            pose=self._pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
            point_stride=rows.itemsize,
            fields=[field(name=name, offset=at, type=kind) for name, at, kind in fields],
            data=rows.tobytes(),
        )

    def fix(self, event: NavSatFix, frame_id: str) -> Any:
        """Return a LocationFix, for Foxglove's map; its covariance is in ENU."""
        kinds, covariance = self._m.LocationFixPositionCovarianceType, [0.0] * 9
        if event.position_covariance:
            turned = convert_covariance("world", np.array(event.position_covariance))
            covariance = turned.tolist()
        return self._m.LocationFix(
            timestamp=self._time(event.stamp),
            frame_id=frame_id,
            latitude=event.latitude,
            longitude=event.longitude,
            altitude=event.altitude,
            position_covariance=covariance,
            position_covariance_type=kinds.Known if event.position_covariance else kinds.Unknown,
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

    def measurement(self, event: Event) -> dict[str, Any]:
        """Return what `measurement_schema` describes."""
        frame = getattr(event, "frame_id", "")
        return {"timestamp": _json_time(event.stamp), "frame_id": frame, **as_json(event)}

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
        """Return a SceneUpdate of what `line` and `body` return."""
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

    def body(self, name: str, frame_id: str, boxes: Sequence[Box] = VEHICLE) -> Any:
        """Return a body as a SceneEntity that goes where its frame goes; by default a vehicle's."""
        cubes = [
            self._m.CubePrimitive(
                pose=self._pose(centre, (1.0, 0.0, 0.0, 0.0)),
                size=self._vector(size),
                color=self._colour(colour),
            )
            for centre, size, colour in boxes
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
