"""ORB-SLAM3's settings, made from the announcements of cameras and IMUs.

In the older of the two forms of ORB-SLAM3 1.0 (the parsers of its ``Tracking.cc``): only this one
lets RGB-D with an IMU initialize without a quick motion. A missing parameter would end the process.
The template is ``settings.yaml.jinja``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, CameraInfo, ImuAnnouncement
from events.geometry import pose_matrix
from nodes.data.dataset.recording import templates

Mode = Literal[
    "rgbd", "monocular", "stereo", "rgbd_inertial", "monocular_inertial", "stereo_inertial"
]

LENSES: dict[str, frozenset[str]] = {
    "rgbd": frozenset({"plumb_bob"}),
    "monocular": frozenset({"plumb_bob", "equidistant"}),
    "stereo": frozenset(),
}
"""Distortion models supported by ORB-SLAM3, by the mode without IMU.

With depth, key points are pinhole's or plumb_bob's (``Frame::UndistortKeyPoints``,
``Frame::UnprojectStereo``). Stereo partners are looked for in the same row of distorted images
(``Frame::ComputeStereoMatches``).
"""

Positive = Annotated[float, msgspec.Meta(gt=0)]
Threshold = Annotated[int, msgspec.Meta(ge=1, le=255)]


class OrbSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ORB-SLAM3's own settings, besides the calibration.

    Attributes:
        features: Corners looked for in an image. With depth, the first image with more than 500
            initializes.
        scale_factor: Factor between two levels of the image pyramid.
        levels: Levels of the image pyramid.
        fast_threshold: Grey levels by which a corner differs from its surroundings.
        min_fast_threshold: The same, for regions without corners by `fast_threshold`.
        baseline: Metres between two cameras, assumed for an RGB-D camera. It weighs depth: the
            variance is ``(z² / (baseline fx))²`` square metres per square pixel.
        close_depth: Depth in metres up to which a point enters the map at once; a farther one after
            two views.
        loop_closing: Whether known places correct the map.
    """

    features: Annotated[int, msgspec.Meta(ge=100, le=10_000)] = 1000
    scale_factor: Annotated[float, msgspec.Meta(gt=1, le=2)] = 1.2
    levels: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    fast_threshold: Threshold = 20
    min_fast_threshold: Threshold = 7
    baseline: Positive = 0.1
    close_depth: Positive = 4.0
    loop_closing: bool = True


class Settings(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Start-up settings of an ORB-SLAM3 process."""

    mode: Mode  # the sensors used
    text: str  # the settings file, as YAML
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy, in pixels
    # The (left) camera in the IMU's frame, shape (4, 4); identity without an IMU.
    camera_on_imu: npt.NDArray[np.float64]


def make_settings(
    mode: Mode,
    cameras: Sequence[CameraAnnouncement],
    imu: ImuAnnouncement | None = None,
    orb: OrbSettings | None = None,
) -> Settings:
    """Return the settings for announced cameras, and an IMU if the mode is inertial.

    Args:
        cameras: The camera, or the left and the right one of a rectified stereo rig.

    Raises:
        ValueError: The IMU is not on the body that carries the camera.
    """
    orb = orb or OrbSettings()
    camera, info = cameras[0], cameras[0].info
    baseline = orb.baseline
    if len(cameras) == 2:  # row by row: see `Estimator.aligned`
        baseline = float((np.linalg.inv(_pose(camera)) @ _pose(cameras[1]))[0, 3])
    on_imu = _on_imu(camera, imu) if imu is not None and "inertial" in mode else np.eye(4)
    environment = templates(Path(__file__).parent)
    environment.filters["real"] = _real
    text = environment.get_template("settings.yaml.jinja").render(
        mode=mode,
        camera=camera,
        lens=_distortion(info),
        imu=imu,
        pose=on_imu.ravel().tolist(),
        orb=orb,
        baseline=baseline,
    )
    return Settings(
        mode=mode,
        text=text,
        width=info.width,
        height=info.height,
        intrinsics=(info.fx, info.fy, info.cx, info.cy),
        camera_on_imu=on_imu,
    )


def _distortion(info: CameraInfo) -> dict[str, float]:
    if info.distortion_model == "equidistant":
        return dict(zip(("k1", "k2", "k3", "k4"), info.distortion, strict=True))
    k1, k2, p1, p2, k3 = info.distortion[:5]
    if any(info.distortion):
        k1 = k1 or 1e-12  # at 0, ORB-SLAM3 takes it that there is no distortion at all
    return {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}


def _pose(sensor: CameraAnnouncement | ImuAnnouncement) -> npt.NDArray[np.float64]:
    return pose_matrix(sensor.position, sensor.orientation)


def _on_imu(camera: CameraAnnouncement, imu: ImuAnnouncement) -> npt.NDArray[np.float64]:
    """Return the camera in the IMU's frame, shape (4, 4)."""
    if imu.parent_frame_id != camera.parent_frame_id:
        raise ValueError(
            f"expected an IMU on {camera.parent_frame_id}, on which {camera.source} is mounted, "
            f"found {imu.source} on {imu.parent_frame_id}"
        )
    pose: npt.NDArray[np.float64] = np.linalg.inv(_pose(imu)) @ _pose(camera)
    return pose


def _real(value: float) -> str:
    """Return a number as a real for OpenCV's YAML reader: with a point."""
    text = f"{value:.9g}"
    mantissa, e, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{e}{exponent}"
