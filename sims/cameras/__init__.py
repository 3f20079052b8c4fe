"""Cameras: settings, mounting, rendering. Pure functions and one renderer."""

from sims.cameras.frame import Frame
from sims.cameras.free import add_free_camera, pose_to_qpos, qvel_between
from sims.cameras.graphics import GraphicsError
from sims.cameras.renderer import CameraRenderer, model_from_bytes, model_to_bytes
from sims.cameras.spec import (
    CameraSpec,
    add_camera,
    announcement,
    camera_info,
    check_cameras,
    optical_frame,
    optical_in_body,
)

__all__ = [
    "CameraRenderer",
    "CameraSpec",
    "Frame",
    "GraphicsError",
    "add_camera",
    "add_free_camera",
    "announcement",
    "camera_info",
    "check_cameras",
    "model_from_bytes",
    "model_to_bytes",
    "optical_frame",
    "optical_in_body",
    "pose_to_qpos",
    "qvel_between",
]
