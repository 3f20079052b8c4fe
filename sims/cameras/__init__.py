"""Cameras: settings, mounting, rendering. Pure functions and a renderer."""

from sims.cameras.renderer import CameraRenderer, Frame, model_from_bytes, model_to_bytes
from sims.cameras.spec import (
    CameraSpec,
    add_camera,
    add_free_body,
    add_free_camera,
    announcement,
    camera_info,
    check_cameras,
    optical_frame,
    optical_in_body,
    pose_to_qpos,
    qvel_between,
)
from sims.cameras.stage import GraphicsError

__all__ = [
    "CameraRenderer", "CameraSpec", "Frame", "GraphicsError", "add_camera", "add_free_body",
    "add_free_camera", "announcement", "camera_info", "check_cameras", "model_from_bytes",
    "model_to_bytes", "optical_frame", "optical_in_body", "pose_to_qpos", "qvel_between",
]  # fmt: skip
