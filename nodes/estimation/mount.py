"""From poses of a camera to poses of the body that carries it."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, PoseEstimate, VehicleAnnouncement
from events.poses import pose_matrix, pose_tuples

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
        cls, camera: CameraAnnouncement, vehicle: VehicleAnnouncement | None, frame_id: str = "odom"
    ) -> Mount:
        """Make the mount of an announced camera.

        Args:
            camera: The announcement of the camera.
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

    def estimate(self, stamp: int, source: str, pose: Floats) -> PoseEstimate:
        """Return the body's pose as an event.

        Args:
            stamp: Stamp of the image (ns).
            source: Name of the estimator.
            pose: The optical camera in its own first frame, shape (4, 4).
        """
        body = self.start @ self.camera @ pose @ np.linalg.inv(self.camera)
        position, orientation = pose_tuples(body)
        return PoseEstimate(
            stamp=stamp,
            source=source,
            frame_id=self.frame_id,
            child_frame_id=self.child_frame_id,
            position=position,
            orientation=orientation,
        )
