"""From poses of a camera to poses of the body that carries it."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    LidarAnnouncement,
    PoseEstimate,
    TrajectoryEstimate,
    VehicleAnnouncement,
)
from events.poses import pose_matrix, pose_tuples
from nodes.estimators.result import TrackingResult

Floats = npt.NDArray[np.float64]


class Mount(msgspec.Struct, frozen=True, eq=False):
    """The pose of a camera on a body, and that of the body at the first image.

    Attributes:
        frame_id: Parent frame of the estimates: ``map``, or ``odom``, ``odom_1``, …
        child_frame_id: Frame of the body.
        start: The body at the first image in the parent frame, shape (4, 4).
        camera: The optical frame in the body's frame, shape (4, 4).
    """

    frame_id: str
    child_frame_id: str
    start: Floats
    camera: Floats

    @classmethod
    def of(
        cls,
        camera: CameraAnnouncement | LidarAnnouncement,
        vehicle: VehicleAnnouncement | None,
        frame_id: str = "odom",
    ) -> Mount:
        """Make the mount of an announced camera, or of a lidar in its place.

        Args:
            camera: The announcement of the sensor.
            vehicle: The announcement of the vehicle, if the body had the announced pose at the
                first image; `None` if its pose there is unknown.
            frame_id: Parent frame of the estimates if the pose is unknown.
        """
        return cls(
            frame_id=frame_id if vehicle is None else "map",
            child_frame_id=camera.parent_frame_id,
            start=np.eye(4)
            if vehicle is None
            else pose_matrix(vehicle.position, vehicle.orientation),
            camera=pose_matrix(camera.position, camera.orientation),
        )

    def estimate(self, stamp: int, source: str, result: TrackingResult) -> PoseEstimate:
        """Return the body's pose as an event.

        The body's velocity is that of the camera: what the lever between them adds when the body
        turns is not known here, and small (0.1 m/s at 1 rad/s and 0.1 m).

        Args:
            stamp: Stamp of the image (ns).
            source: Name of the estimator.
            result: With the optical camera in its own first frame.
        """
        body = self._bodies(result.pose)
        position, orientation = pose_tuples(body)
        turn = (self.start @ self.camera)[:3, :3]
        velocity = None if result.velocity is None else tuple((turn @ result.velocity).tolist())
        covariance: tuple[float, ...] = ()
        if result.covariance is not None:
            # A rotation about the camera moves the body, which is not there.
            moved = np.eye(6)
            moved[:3, :3] = moved[3:, 3:] = turn
            lever = body[:3, 3] - (body @ self.camera)[:3, 3]
            moved[:3, 3:] = -_cross(lever) @ turn
            covariance = tuple((moved @ result.covariance @ moved.T).ravel().tolist())
        return PoseEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            position=position,
            orientation=orientation,
            velocity=velocity,
            covariance=covariance,
        )

    def trajectory(
        self, stamp: int, source: str, stamps: npt.NDArray[np.int64], poses: Floats
    ) -> TrajectoryEstimate:
        """Return the body's poses as an event.

        Args:
            stamp: When it is sent (ns).
            source: Name of the estimator.
            stamps: Those of the poses (ns), shape (n,).
            poses: The optical camera in its own first frame, shape (n, 4, 4).
        """
        bodies = self._bodies(poses)
        turns = Rotation.from_matrix(bodies[:, :3, :3])
        return TrajectoryEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            stamps=np.asarray(stamps, np.int64),
            positions=np.ascontiguousarray(bodies[:, :3, 3]),
            orientations=turns.as_quat(scalar_first=True),
        )

    def _bodies(self, poses: Floats) -> Floats:
        """Return poses of the body, shape (..., 4, 4), from those of the camera."""
        bodies: Floats = self.start @ self.camera @ poses @ np.linalg.inv(self.camera)
        return bodies


def _cross(vector: Floats) -> Floats:
    """Return the matrix of a cross product with a vector from the left, shape (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
