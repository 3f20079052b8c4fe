"""ORB-SLAM3's settings, made from the announcements of cameras and IMUs.

They are in the older of the two forms that ORB-SLAM3 1.0 reads (the parsers of its
``Tracking.cc``): only this one has a parameter with which RGB-D with an IMU initializes without a
quick motion. Every required parameter is given, since it ends the process if one is missing;
the file is the template ``settings.yaml.jinja``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from events import CameraAnnouncement, CameraInfo, ImuAnnouncement
from events.poses import pose_matrix
from nodes.dataset.recording import templates

Mode = Literal["rgbd", "monocular", "rgbd_inertial", "monocular_inertial"]

Positive = Annotated[float, msgspec.Meta(gt=0)]
Threshold = Annotated[int, msgspec.Meta(ge=1, le=255)]


class OrbSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ORB-SLAM3's own settings, besides the calibration.

    Attributes:
        features: Corners looked for in an image. With depth, it initializes with the first image in
            which it finds more than 500.
        scale_factor: Factor between two levels of the image pyramid.
        levels: Levels of the image pyramid.
        fast_threshold: Grey levels by which a corner differs from its surroundings.
        min_fast_threshold: The same, for regions without corners by `fast_threshold`.
        baseline: Distance of two cameras, in metres, which ORB-SLAM3 assumes for an RGB-D camera.
            It gives the weight of depth: the variance of its error is ``(z² / (baseline fx))²``
            square metres per square pixel.
        close_depth: Depth in metres up to which a point is put into the map from its depth at once;
            a farther one when it has been seen from two sides. Any measured depth is used.
        loop_closing: Whether places seen before correct the map.
    """

    features: Annotated[int, msgspec.Meta(ge=100, le=10_000)] = 1000
    scale_factor: Annotated[float, msgspec.Meta(gt=1, le=2)] = 1.2
    levels: Annotated[int, msgspec.Meta(ge=1, le=16)] = 8
    fast_threshold: Threshold = 20
    min_fast_threshold: Threshold = 7
    baseline: Positive = 0.1
    close_depth: Positive = 4.0
    loop_closing: bool = True


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """All that an ORB-SLAM3 process needs to start.

    Attributes:
        mode: The sensors that are used.
        text: The settings file, as YAML.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        intrinsics: fx, fy, cx, cy, in pixels.
    """

    mode: Mode
    text: str
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]


def make_settings(
    mode: Mode,
    camera: CameraAnnouncement,
    imu: ImuAnnouncement | None = None,
    orb: OrbSettings | None = None,
) -> Settings:
    """Return the settings for an announced camera, and an IMU if the mode is inertial.

    Raises:
        ValueError: The mode needs something that was not announced, or an IMU in a frame other
            than the one that the camera is mounted on.
    """
    orb = orb or OrbSettings()
    info = camera.info
    if "rgbd" in mode and "depth" not in camera.images:
        raise ValueError(
            f"mode {mode!r}: expected {camera.source} to give depth, "
            f"found {', '.join(camera.images)}"
        )
    if unknown := unknown_lens(mode, info):
        raise ValueError(f"{camera.source}: {unknown}")
    if "inertial" in mode:
        _check_mounting(mode, camera, imu)
    environment = templates(Path(__file__).parent)
    environment.filters["real"] = _real
    text = environment.get_template("settings.yaml.jinja").render(
        mode=mode,
        camera=camera,
        lens=_distortion(info),
        imu=imu,
        pose=pose_matrix(camera.position, camera.orientation).ravel().tolist(),
        orb=orb,
    )
    return Settings(
        mode=mode,
        text=text,
        width=info.width,
        height=info.height,
        intrinsics=(info.fx, info.fy, info.cx, info.cy),
    )


def unknown_lens(mode: Mode, info: CameraInfo) -> str:
    """Return why ORB-SLAM3 cannot compute with a lens, in a sentence; empty if it can.

    With depth it takes key points for those of a pinhole unless they have plumb_bob's distortion
    (``Frame::UndistortKeyPoints`` and ``Frame::UnprojectStereo``).
    """
    if info.distortion_model == "rational_polynomial" and any(info.distortion):
        return "expected plumb_bob or equidistant images, found rational_polynomial ones"
    if info.distortion_model == "equidistant" and "rgbd" in mode:
        return f"mode {mode!r}: expected plumb_bob images beside the depth, found equidistant ones"
    return ""


def _distortion(info: CameraInfo) -> dict[str, float]:
    """Return a lens's coefficients by ORB-SLAM3's names."""
    if info.distortion_model == "equidistant":
        return dict(zip(("k1", "k2", "k3", "k4"), info.distortion, strict=True))
    k1, k2, p1, p2, k3 = info.distortion[:5]
    if any(info.distortion):
        k1 = k1 or 1e-12  # at 0, ORB-SLAM3 takes it that there is no distortion at all
    return {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}


def _check_mounting(mode: Mode, camera: CameraAnnouncement, imu: ImuAnnouncement | None) -> None:
    if imu is None:
        raise ValueError(f"mode {mode!r}: expected an IMU beside {camera.source}, found none")
    if imu.frame_id != camera.parent_frame_id:
        raise ValueError(
            f"mode {mode!r}: expected an IMU in {camera.parent_frame_id}, on which "
            f"{camera.source} is mounted, found {imu.source} in {imu.frame_id}"
        )


def _real(value: float) -> str:
    """Return a number that OpenCV's YAML reader takes for a real one: with a point."""
    text = f"{value:.9g}"
    mantissa, e, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{e}{exponent}"
