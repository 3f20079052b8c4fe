"""Cameras: settings, announcements and mounting in a model, also without a vehicle.

A camera without a vehicle is a body whose pose nothing changes but the user.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

import events
from events.base import Quaternion, Vector3
from events.camera_info import response_light
from events.frames import (
    OPTICAL_TO_FRD,
    flip_yz,
    flip_yz_rotation,
    from_rpy,
    multiply,
    normalize,
    rotate,
)
from runtime.changeable import Changeable
from runtime.paths import NameOrPath
from runtime.units import Latency
from sims.calibration import chosen
from sims.cameras.calibration import USUAL, Calibration, CalibrationError
from sims.cameras.calibration import check as check_calibration
from sims.cameras.optics import AutoExposure, Intrinsics, Lens, intrinsics, noise_at, read_response
from sims.mounting import Matrix, apply_matrix
from sims.presets import CAMERAS, DEPTH_SENSORS

ImageKind = Literal["rgb", "grey", "depth", "segmentation"]
Pixels = Annotated[int, msgspec.Meta(ge=1, le=8192)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]
_SIZES = dict.fromkeys(("width", "height", "fov"), "intrinsics")


class DepthSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a depth sensor whose second eye, or projector, is right of the camera.

    A pixel without a measurement is ``inf``: out of range; not seen by the second eye (the shadow
    left of what is near); on a surface that is seen too much aslant, or at an edge; and, as the
    model says, too dark or without texture.

    Attributes:
        preset: Real sensor with its figures as defaults; keys beside it override them.
        model: ``structured_light``: a projector, too little for dark surfaces. ``stereo``: a second
            camera, blind to surfaces without texture and to the band at the left.
        baseline: Distance to the second eye or projector, metres.
        focal: Focal length by which disparities are counted, pixels; 0 for that of this camera.
        disparity_step: Disparities are whole multiples of it, pixels; 0: of nothing.
        disparity_noise: Standard deviation of disparities before that, pixels.
        min_depth: Metres; what is nearer is not measured.
        max_depth: Metres; what is farther is not measured.
        max_slant: Greatest angle of ray and normal in 3×3 pixels, edges included, degrees; 90: any.
        min_brightness: ``structured_light``: least light of a surface seen head-on, aslant more by
            the angle's cosine, share of white in linear light, whatever the ``light``; 0: any.
        min_contrast: ``stereo``: least standard deviation of 7×7 pixels, grey levels. 0: any.
    """

    preset: Annotated[str | None, msgspec.Meta(extra={"presets": DEPTH_SENSORS})] = None
    model: Literal["structured_light", "stereo"] = "structured_light"
    baseline: Positive = 0.075
    focal: NonNegative = 0.0
    disparity_step: NonNegative = 0.125
    disparity_noise: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.07
    min_depth: NonNegative = 0.4
    max_depth: Positive = 10.0
    max_slant: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 80.0
    min_brightness: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.005
    min_contrast: NonNegative = 1.0

    def __post_init__(self) -> None:
        if 0.0 < self.disparity_step < 1e-3:
            raise ValueError(
                f"disparity_step: expected 0 or at least 0.001 px, found {self.disparity_step:g}"
            )
        if self.min_depth >= self.max_depth:
            raise ValueError(
                f"min_depth, max_depth: expected a range, found {self.min_depth:g} m to "
                f"{self.max_depth:g} m"
            )

    @property
    def needs_colours(self) -> bool:
        """Whether measured depth depends on the brightness of surfaces."""
        limit = self.min_contrast if self.model == "stereo" else self.min_brightness
        return limit > 0.0

    def reach(self, focal: float) -> float:
        """Return the depth of disparity 1 of a camera of a focal length (pixels), metres."""
        return (self.focal or focal) * self.baseline


class Stereo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a stereo rig: two cameras with a common trigger.

    Attributes:
        baseline: Distance of the right camera from the left one along the image's rows, metres.
        offset: Time by which the right camera is exposed later; its stamps say so. It is delivered
            with the left one, so its latency is shorter by this.
    """

    baseline: Annotated[float, msgspec.Meta(gt=0.0)]
    offset: Latency = Latency(0)


class CameraSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a camera: an ideal pinhole by default, with errors as its settings say.

    Attributes:
        name: Name of the camera, unique on its body.
        preset: Real sensor with its figures as defaults; keys beside it override them.
        images: Kinds of image that it gives.
        width: Width of its images, pixels.
        height: Height of its images, pixels.
        fov: **Horizontal** field of view, degrees, with what the lens does to it.
        intrinsics: fx, fy, cx, cy, pixels, in place of `fov`; pixel centres are whole numbers.
        lens: Distortion; none by default. Depth stays planar along the optical axis, and is ``inf``
            90° or more off it. Pixels on which no ray falls are black.
        undistorted: Whether the images are sent a second time without distortion, as those of a
            pinhole camera of the same intrinsics, with source ``<camera>/undistorted``.
        rate: Exposures per second, at equal intervals.
        position: Position on the body, metres forward, right, down (FRD).
        orientation: Roll, pitch, yaw of the camera in the body's frame, degrees, applied yaw first
            (Z-Y-X). Positive pitch is upwards: -90 looks straight down.
        T_BS: In place of both, the transform from the **optical** frame (x right, y down, z
            forward) to the body: four rows of four numbers, or ``{ rows, cols, data }`` as in a
            sensor.yaml of EuRoC's, whose body is its IMU, though. Of a rig, the left camera's.
        light: Factor on all lights of the scene, but the sky and surfaces that shine.
        exposure: Seconds that the shutter is open, half of them before the stamp: motion blurs the
            image. Depth, segmentation and pose are those of the stamp.
        readout: Time from the first row's exposure to the last one's (rolling shutter); the stamp
            is that of the middle row. Depth and segmentation are read out alike.
        gain: Factor on the light of an image, and so on its shot noise, as of an amplifier.
        reference_exposure: Exposure time at which an image of gain 1 is as bright as drawn; shorter
            ones darken in linear light. 0: exposure times make no difference to the brightness.
        auto_exposure: Exposure time and gain chosen by the light of the last delivered image, from
            `reference_exposure` on; in the place of `exposure` and `gain`.
        vignette: Coefficients of the share of light ``1 + a1 r² + a2 r⁴ + …`` at r half diagonals
            from the principal point; cos⁴ to 45° in the corner: about ``[-2, 2.54, -1.86, 0.57]``.
        full_well: Electrons that fill a pixel at gain 1 (white), typically 5000 to 50000: each
            pixel has the noise of their number (shot noise). 0: none.
        response: Curve from light to grey levels, sRGB as drawn: ``srgb``, ``linear``, ``gamma``
            (of 2.2), or a file of 256 levels' light, as ``pcalib.txt`` of TUM's monoVO data set.
        blur: Standard deviation, in pixels, of the Gaussian that a point becomes out of focus.
        noise: Standard deviation of additive Gaussian noise, grey levels (0 to 255).
        depth_noise: k in sigma = k z²: standard deviation (metres) of the noise at depth z.
        depth_sensor: Measures depth by triangulation with its errors, in the place of
            `depth_noise`.
        latency: Time from exposure to delivery.
        jitter: Greatest random delay in addition; the order of images is kept.
        loss: Share of exposures that are not delivered, chosen at random.
        time_offset: Delay of all stamps of an exposure on the clock of the IMU and the ground
            truth.
        time_jitter: Greatest random error of the stamps besides, either way.
        calibration_error: Errors of what is announced: intrinsics, mounting, time offset; ``true``
            for those of a good calibration. The images, depth and camera poses are what they are.
        stereo: Makes two cameras: ``<name>_left`` and, a baseline to the right, ``<name>_right``.
        render_time: Least real time to draw a frame, to test a run on a machine too slow for it.
    """

    name: Annotated[str, msgspec.Meta(min_length=1, pattern="^[A-Za-z0-9_]+$")]
    preset: Annotated[str | None, msgspec.Meta(extra={"presets": CAMERAS, "needed": _SIZES})] = None
    images: tuple[ImageKind, ...] = ("rgb", "depth")
    width: Pixels = 512
    height: Pixels = 512
    fov: Annotated[float, msgspec.Meta(ge=1.0, le=360.0)] = 90.0
    intrinsics: Intrinsics | None = None
    lens: Lens | None = None
    undistorted: bool = False
    rate: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)] = 30.0
    position: Vector3 = (0.15, 0.0, 0.0)
    orientation: Vector3 = (0.0, 0.0, 0.0)
    T_BS: Matrix | None = None
    light: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    exposure: Latency = Latency(0)  # immutable
    readout: Latency = Latency(0)
    gain: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    reference_exposure: Latency = Latency(0)
    auto_exposure: AutoExposure | None = None
    vignette: tuple[float, ...] = ()
    full_well: NonNegative = 0.0
    response: NameOrPath = "srgb"
    blur: NonNegative = 0.0
    noise: NonNegative = 0.0
    depth_noise: NonNegative = 0.0
    depth_sensor: DepthSensor | None = None
    latency: Latency = Latency(0.04)
    jitter: Changeable[Latency] = Latency(0)
    loss: Changeable[Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]] = 0.0
    time_offset: Latency = Latency(0)
    time_jitter: Latency = Latency(0)
    calibration_error: CalibrationError | bool = False
    stereo: Stereo | None = None
    render_time: Latency = Latency(0)

    def __post_init__(self) -> None:
        apply_matrix(self, OPTICAL_TO_FRD)
        if not self.images or len(set(self.images)) != len(self.images):
            kinds = ", ".join(self.images) or "none"
            raise ValueError(f"images: expected one or more kinds, each once, found {kinds}")
        if camera_info(self).is_pinhole and self.undistorted:
            raise ValueError("undistorted: expected a lens that distorts, found none")
        fixed = self.exposure or self.gain != 1.0
        if self.auto_exposure and (fixed or not self.reference_exposure):
            raise ValueError(
                "auto_exposure: expected a reference_exposure, and neither exposure nor gain, "
                f"found {self.reference_exposure:g} s, {self.exposure:g} s and {self.gain:g}"
            )
        if self.reference_exposure and not self.longest_exposure:
            raise ValueError(
                "reference_exposure: expected an exposure (or auto_exposure) beside it, found none"
            )
        if self.depth_sensor and self.depth_noise:
            raise ValueError(
                "depth_sensor: expected its own disparity_noise alone, found depth_noise beside it"
            )
        if self.depth_sensor and not camera_info(self).is_pinhole:
            raise ValueError(
                "depth_sensor: expected a camera without distortion, as such a sensor rectifies "
                f"its images, found {camera_info(self).distortion_model}"
            )
        if (error := self.wrong) is not None:
            check_calibration(error, len(camera_info(self).distortion), 2 if self.stereo else 1)
            if self.undistorted and error.of_lens:
                raise ValueError(
                    "undistorted: expected exact intrinsics, by which the simulator undistorts, "
                    "found a calibration_error beside it"
                )
        if self.undistorted and self.vignette:
            raise ValueError(
                "undistorted: expected no vignette, whose shape would change, found one beside it"
            )
        shares = np.polynomial.Polynomial((1.0, *self.vignette))(np.linspace(0.0, 1.0, 101))
        if not (shares.min() >= 0.0 and shares.max() <= 1.0):
            raise ValueError(
                "vignette: expected shares of light from 0 to 1 all over the image, found "
                f"{shares.min():.3g} to {shares.max():.3g}"
            )

    @property
    def wrong(self) -> CalibrationError | None:
        """Errors of the announced calibration; `None` if it is exact."""
        return chosen(self.calibration_error, USUAL)

    @property
    def longest_exposure(self) -> float:
        """Longest exposure time, seconds."""
        return self.auto_exposure.max_exposure if self.auto_exposure else self.exposure

    @property
    def half(self) -> float:
        """Seconds from the first row's opening to the stamp, and to the last's closing."""
        return 0.5 * (self.readout + self.longest_exposure)

    @property
    def offset(self) -> float:
        """Delay of the right camera of a stereo rig, seconds; 0 without a rig."""
        return float(self.stereo.offset) if self.stereo else 0.0


def eyes(spec: CameraSpec) -> tuple[CameraSpec, ...]:
    """Return the cameras of an entry: itself, or the left and right of a stereo rig."""
    if spec.stereo is None:
        return (spec,)
    errors = [
        spec.calibration_error if spec.wrong is None else spec.wrong.of_eye(k) for k in (0, 1)
    ]
    left = msgspec.structs.replace(
        spec, name=f"{spec.name}_left", stereo=None, calibration_error=errors[0]
    )
    place, turn = optical_in_body(spec)
    x, y, z = rotate(turn, (spec.stereo.baseline, 0.0, 0.0))
    there = (place[0] + x, place[1] + y, place[2] + z)
    return left, msgspec.structs.replace(
        left, name=f"{spec.name}_right", position=there, calibration_error=errors[1]
    )


def check_cameras(specs: Iterable[CameraSpec]) -> None:
    """Check a body's cameras as far as possible without a world.

    Raises:
        ValueError: Two have one name, a shutter would still be open at the next exposure or at the
            time of delivery, or the order of stamps could be lost.
    """
    names: set[str] = set()
    for spec in specs:
        where, period = f"cameras: {spec.name}", 1.0 / spec.rate
        for eye in eyes(spec):
            if eye.name in names:
                raise ValueError(
                    f"{where}: expected a name of its own, found two cameras called {eye.name}"
                )
            names.add(eye.name)
        complete = spec.half + spec.offset
        for setting, value, most, what in (
            ("exposure", spec.longest_exposure, period, "between two exposures"),
            ("readout", spec.readout, period, "between two exposures"),
            ("stereo.offset", spec.offset, period, "between two exposures"),
            ("time_jitter", spec.time_jitter, period / 2.0, "of half the time between two stamps"),
        ):
            if value > most:
                raise ValueError(
                    f"{where}: {setting}: expected at most the {1e3 * most:.4g} ms {what}, "
                    f"found {1e3 * value:.4g} ms"
                )
        if spec.latency < complete:
            raise ValueError(
                f"{where}: latency: expected at least the {1e3 * complete:.4g} ms until its last "
                f"row has been exposed, found {1e3 * spec.latency:.4g} ms"
            )
        if spec.undistorted and spec.readout:
            raise ValueError(
                f"{where}: undistorted: expected a global shutter, since rows without distortion "
                f"are not those that are read out, found a readout of {1e3 * spec.readout:.4g} ms"
            )


@functools.lru_cache(maxsize=64)
def _info(
    width: int, height: int, fov: float, given: Intrinsics | None, lens: Lens | None
) -> events.CameraInfo:
    return intrinsics(width, height, fov, given, lens)


def camera_info(spec: CameraSpec) -> events.CameraInfo:
    """Return the camera's intrinsics; `ValueError` if the lens is narrower than `fov`."""
    return _info(spec.width, spec.height, spec.fov, spec.intrinsics, spec.lens)


def is_plain(spec: CameraSpec) -> bool:
    """Return whether a camera is an ideal pinhole, described by its field of view alone."""
    return spec.intrinsics is None and camera_info(spec).is_pinhole


def optical_in_body(spec: CameraSpec) -> tuple[Vector3, Quaternion]:
    """Return the optical frame's pose on the body: metres in FRD, rotation optical to body."""
    roll, pitch, yaw = (math.radians(angle) for angle in spec.orientation)
    return spec.position, multiply(from_rpy(roll, pitch, yaw), OPTICAL_TO_FRD)


def optical_frame(spec: CameraSpec, prefix: str) -> str:
    """Return the name of the camera's optical frame."""
    return f"{prefix}{spec.name}_optical"


def calibration(spec: CameraSpec) -> Calibration:
    """Return a camera's true calibration."""
    return Calibration(camera_info(spec), *optical_in_body(spec), float(spec.time_offset))


def announcement(
    spec: CameraSpec,
    *,
    source: str,
    prefix: str,
    parent_frame_id: str,
    stamp: int = 0,
    known: Calibration | None = None,
) -> events.CameraAnnouncement:
    """Return the announcement of a camera: its images, and its pose on the body.

    Args:
        known: What is announced as its calibration; the true one if not given.
    """
    known = known or calibration(spec)
    response = read_response(spec.response)
    electrons = spec.full_well / spec.gain
    return events.CameraAnnouncement(
        stamp=stamp,
        source=source,
        images=spec.images,
        info=known.info,
        rate=spec.rate,
        latency=float(spec.latency),
        exposure=float(spec.longest_exposure),
        readout=float(spec.readout),
        time_offset=known.time_offset,
        time_jitter=float(spec.time_jitter),
        noise=noise_at(response_light(response), 128, spec.noise, electrons),
        full_well=spec.full_well,
        reference_exposure=float(spec.reference_exposure),
        response=response,
        vignette=spec.vignette,
        **_depth_noise(spec, known.info.fx),
        frame_id=optical_frame(spec, prefix),
        parent_frame_id=parent_frame_id,
        position=known.position,
        orientation=known.orientation,
    )


def _depth_noise(spec: CameraSpec, focal: float) -> dict[str, Any]:
    sensor = spec.depth_sensor
    if sensor is None:
        return {"depth_noise": spec.depth_noise}
    reach = sensor.reach(focal)
    return {
        "depth_noise": sensor.disparity_noise / reach,
        "depth_step": sensor.disparity_step / reach,
        "min_depth": sensor.min_depth,
        "max_depth": sensor.max_depth,
    }


def vertical_fov(spec: CameraSpec) -> float:
    """Return MuJoCo's vertical field of view, degrees; no effect on a view with its own frames."""
    if not is_plain(spec):
        return 90.0
    half = math.tan(math.radians(spec.fov) / 2.0) * spec.height / spec.width
    return math.degrees(2.0 * math.atan(half))


def add_camera(world: mujoco.MjSpec, body_name: str, spec: CameraSpec, prefix: str) -> None:
    """Mount a camera, or a stereo rig, on a body (FLU); `ValueError` for a wrong or taken name."""
    body = world.body(body_name)
    for eye in eyes(spec):
        name = f"{prefix}{eye.name}"
        if body is None:
            known = ", ".join(other.name for other in world.bodies)
            raise ValueError(
                f"camera {name}: expected a body of the world ({known}), got {body_name}"
            )
        if world.camera(name) is not None:
            raise ValueError(f"camera {name}: expected a name of its own, but the world has one so")
        position, orientation = optical_in_body(eye)
        # MuJoCo's camera looks along -z with y up: the half turn about x on both sides of the
        # rotation takes optical-in-FRD to camera-in-FLU.
        body.add_camera(
            name=name,
            pos=flip_yz(position),
            quat=flip_yz_rotation(orientation),
            fovy=vertical_fov(eye),
        )


def add_free_camera(world: mujoco.MjSpec, name: str, specs: tuple[CameraSpec, ...]) -> str:
    """Add a body with cameras, without collisions; return their prefix; `ValueError` if taken."""
    if world.body(name) is not None:
        raise ValueError(f"free camera {name}: expected a name of its own, but the world has one")
    add_free_body(world, name, name)
    prefix = f"{name}/"
    for spec in specs:
        add_camera(world, name, spec, prefix)
    return prefix


def add_free_body(world: mujoco.MjSpec, name: str, joint: str) -> None:
    """Add a body without shape, whose free joint has its pose in the state of the world."""
    # A free joint, because the renderer takes qpos; a mass, because a free joint needs one.
    body = world.worldbody.add_body(
        name=name, gravcomp=1.0, explicitinertial=True, mass=0.1, inertia=[1e-4, 1e-4, 1e-4]
    )
    body.add_freejoint(name=joint)


def pose_to_qpos(position: Vector3, orientation: Quaternion) -> npt.NDArray[np.float64]:
    """Return a body's (FRD, any length of quaternion but 0) pose as a free joint's, shape (7,)."""
    turn = flip_yz_rotation(normalize(orientation))
    return np.array([*flip_yz(position), *turn])


def qvel_between(
    before: npt.NDArray[np.float64], after: npt.NDArray[np.float64], seconds: float
) -> npt.NDArray[np.float64]:
    """Return a free camera's velocity, shape (6,), from its qpos at two times."""
    turn = np.empty(3)
    mujoco.mju_subQuat(turn, after[3:], before[3:])
    return np.concatenate([after[:3] - before[:3], turn]) / seconds
