"""Optics and exposure of a camera: lens, response curve, defocus, and motion blur.

A rasteriser draws pinhole images, here called faces. A lens's image is looked up in one of them,
or, beyond 120°, in the faces of a cube.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import COEFFICIENTS, response_light
from runtime.units import Latency

Floats = npt.NDArray[np.float64]
Maps = npt.NDArray[np.float32]

ONE_FACE = math.radians(61.0)
"""Largest angle off the axis for a single face, radians; beyond, too many pixels."""

FINER = 1.3

MARGIN = 3

LARGEST = 8192  # pixels of a face's side, at most


class Face(NamedTuple):
    """Pinhole drawing for a camera's image."""

    turn: Floats  # its axes (right, down, ahead) in the optical frame, shape (3, 3), a row each
    left: float  # coordinate x/z of the left edge of the first column, in the face's axes
    top: float  # coordinate y/z of the upper edge of the first row
    pitch: tuple[float, float]  # width and height of a pixel, in these coordinates
    width: int
    height: int
    # Column of the face for each pixel of the image, shape (h, w); None if they are equal.
    columns: Maps | None = None
    rows: Maps | None = None
    mask: npt.NDArray[np.bool_] | None = None  # pixels on this face, shape (h, w)
    # Planar depth in the optical frame for a planar depth of 1 in the face, shape (h, w); ``inf``
    # where it would not be positive. None if it is 1.
    steepness: Maps | None = None


_CUBE = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)  # axes of a cube's faces: ahead, right, left, below, above, behind; shape (6, 3, 3)


def faces(info: CameraInfo) -> tuple[Face, ...]:
    """Return the faces to draw for a camera; empty if no ray falls on its image."""
    if info.is_pinhole:
        pitch = 1.0 / info.fx, 1.0 / info.fy
        left, top = (-0.5 - info.cx) * pitch[0], (-0.5 - info.cy) * pitch[1]
        return (Face(_CUBE[0], left, top, pitch, info.width, info.height),)
    rays = pixel_rays(info)
    seen = np.isfinite(rays[..., 2])
    if not seen.any():
        return ()
    if np.arccos(np.clip(rays[seen][:, 2].min(), -1.0, 1.0)) <= ONE_FACE:
        return (_face(info, rays, seen, _CUBE[0]),)
    ahead = np.where(seen, np.argmax(rays @ _CUBE[:, 2].T, axis=-1), -1)
    return tuple(
        _face(info, rays, ahead == number, _CUBE[number])
        for number in range(len(_CUBE))
        if (ahead == number).any()
    )


def undistorted(info: CameraInfo) -> tuple[CameraInfo, Maps, Maps]:
    """Return an equal pinhole camera, and columns and rows in the lens's image, (h, w)."""
    pinhole = CameraInfo(
        width=info.width, height=info.height, fx=info.fx, fy=info.fy, cx=info.cx, cy=info.cy
    )
    places = info.project(pixel_rays(pinhole)).reshape(info.height, info.width, 2)
    return pinhole, _map(places[..., 0]), _map(places[..., 1])


def _map(places: Floats) -> Maps:
    """Return places as `cv2.remap` takes them: far outside where there is none."""
    return np.nan_to_num(places, nan=-100.0).astype(np.float32)


def pixel_rays(info: CameraInfo) -> Floats:
    """Return the ray of each pixel's centre, of length 1, shape (h, w, 3); NaN where none is."""
    rows, columns = np.mgrid[0 : info.height, 0 : info.width]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    return info.unproject(pixels).reshape(info.height, info.width, 3)


def _face(info: CameraInfo, rays: Floats, mask: npt.NDArray[np.bool_], turn: Floats) -> Face:
    """Return the face with axes `turn` for the masked pixels' rays, shape (h, w, 3)."""
    places = np.full((*mask.shape, 2), np.nan)
    turned = rays[mask] @ turn.T
    places[mask] = turned[:, :2] / turned[:, 2:]
    steps = np.concatenate(
        [np.linalg.norm(np.diff(places, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    )
    steps = steps[np.isfinite(steps)]
    finest = float(steps.min()) if len(steps) else 1.0 / max(info.fx, info.fy)
    left, top = places[mask].min(axis=0)
    right, bottom = places[mask].max(axis=0)
    longest = max(right - left, bottom - top)
    pitch = max(finest / FINER, longest / (LARGEST - 2 * MARGIN - 1))
    left, top = left - (MARGIN + 0.5) * pitch, top - (MARGIN + 0.5) * pitch
    ahead = mask & (rays[..., 2] > 0.0)
    steepness = np.full(mask.shape, np.inf)
    steepness[ahead] = rays[ahead][:, 2] / (rays[ahead] @ turn[2])
    return Face(
        turn=turn,
        left=float(left),
        top=float(top),
        pitch=(pitch, pitch),
        width=math.ceil((right - left) / pitch) + MARGIN + 1,
        height=math.ceil((bottom - top) / pitch) + MARGIN + 1,
        columns=_map((places[..., 0] - left) / pitch - 0.5),
        rows=_map((places[..., 1] - top) / pitch - 0.5),
        mask=mask,
        steepness=None if turn[2, 2] == 1.0 else steepness.astype(np.float32),
    )


Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels; whole coordinates are those of pixel centres."""

_OTHERS_CALL_IT = {
    **dict.fromkeys(("radtan", "radtan4", "radtan5", "brown_conrady"), "plumb_bob"),
    **dict.fromkeys(("kb4", "kannala_brandt", "fisheye", "equi"), "equidistant"),
}


class Lens(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a lens with distortion.

    Attributes:
        model: ``plumb_bob`` (others say radtan), ``rational_polynomial``, or ``equidistant``
            (Kannala-Brandt's fisheye, KB4), with the formulae of OpenCV.
        coefficients: plumb_bob: k1, k2, p1, p2 and, if not 0, k3; rational_polynomial: k1, k2, p1,
            p2, k3 to k6; equidistant: k1 to k4.
    """

    model: Annotated[str, msgspec.Meta(extra_json_schema={"enum": list(COEFFICIENTS)})]
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            other = _OTHERS_CALL_IT.get(self.model.casefold())
            raise ValueError(
                f"model: expected {', '.join(COEFFICIENTS)}, found {self.model!r:.40}"
                + (f' (did you mean "{other}"?)' if other else "")
            )
        count = len(self.coefficients)
        allowed = {COEFFICIENTS[self.model]} | ({4} if self.model == "plumb_bob" else set())
        if count not in allowed or not all(map(math.isfinite, self.coefficients)):
            expected = " or ".join(str(number) for number in sorted(allowed))
            raise ValueError(
                f"coefficients: expected {expected} numbers for {self.model}, "
                f"found {list(self.coefficients)}"
            )


def intrinsics(
    width: int, height: int, fov: float, given: Intrinsics | None, lens: Lens | None
) -> CameraInfo:
    """Return the intrinsics for a camera's settings.

    Args:
        fov: Horizontal field of view, degrees, through the lens, for square pixels and a principal
            point in the centre; of no effect beside `given`.

    Raises:
        ValueError: The lens does not reach that far, or sees nothing.
    """
    if lens is None and given is None:
        if fov > 170.0:
            raise ValueError(
                "fov: expected at most 170 degrees without an equidistant lens, "
                f"found {fov:g} degrees"
            )
        return CameraInfo.from_fov(width, height, math.radians(fov))
    fx, fy, cx, cy = given or (1.0, 1.0, 0.0, 0.0)
    if not (0.0 < fx < math.inf and 0.0 < fy < math.inf and math.isfinite(cx + cy)):
        raise ValueError(f"intrinsics: expected fx > 0, fy > 0, cx, cy, found {list(given or ())}")
    coefficients = tuple(lens.coefficients) if lens else (0.0,) * 5
    if lens and lens.model == "plumb_bob":
        coefficients = (*coefficients, 0.0)[:5]
    info = CameraInfo(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion_model=lens.model if lens else "plumb_bob",  # type: ignore[arg-type]
        distortion=coefficients,
    )
    if not info.widest_angle() > 0.0:
        raise ValueError(f"lens: expected one that sees, found coefficients {list(coefficients)}")
    if given is not None:
        return info
    half = math.radians(fov) / 2.0
    reach = float(info.project([[math.sin(half), 0.0, math.cos(half)]])[0, 0])
    if not reach > 0.0:
        widest = math.degrees(2.0 * info.widest_angle())
        raise ValueError(
            f"fov: expected less than the {widest:.4g} degrees up to which the image of this lens "
            f"grows outwards, found {fov:g} degrees"
        )
    focal = width / 2.0 / reach
    return msgspec.structs.replace(
        info, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2
    )


_GAMMA = 2.2


def read_response(name: str) -> tuple[float, ...]:
    """Return the light of the 256 grey levels, as in `CameraAnnouncement.response`.

    Args:
        name: ``srgb`` (an empty result), ``linear``, ``gamma`` (of 2.2), or the path of a
            ``pcalib.txt`` of TUM's monoVO data set: 256 rising numbers.

    Raises:
        ValueError: The file is missing or holds something else.
    """
    if name == "srgb":
        return ()
    if name in {"linear", "gamma"}:
        curve = np.linspace(0.0, 1.0, 256) ** (_GAMMA if name == "gamma" else 1.0)
        return tuple(curve.tolist())
    try:
        response = tuple(map(float, Path(name).read_text(encoding="utf-8").split()))
        response_light(response or (0.0,))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"response: expected srgb, linear, gamma or a file of 256 rising numbers, found "
            f"{name}: {error}"
        ) from None
    return response


def noise_at(light: npt.NDArray[np.float64], level: int, noise: float, electrons: float) -> float:
    """Return the standard deviation of an image's noise at a grey level, grey levels.

    Args:
        light: Of each grey level, shape (256,).
        noise: Common to all levels, grey levels.
        electrons: Of a white pixel, for the shot noise; 0 for none.
    """
    levels_per_light = 2.0 / (light[level + 1] - light[level - 1])
    shot = levels_per_light * np.sqrt(light[level] / electrons) if electrons else 0.0
    return float(np.hypot(noise, shot))


Image = npt.NDArray[np.uint16]  # codes of linear light, shape (height, width, 3) or (height, width)
MOST = 9  # most renderings of an exposure: each costs as much as an image without motion blur


def defocused(image: Image, sigma: float) -> Image:
    """Return the image seen through a lens whose point spread is a Gaussian of `sigma` pixels."""
    if sigma <= 0.0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint16)


def moments(exposure: float, shift: float) -> list[float]:
    """Return the moments to draw for motion blur, seconds from the middle of the exposure.

    They are the middles of an odd number of equal parts of it, about a pixel of motion apart.

    Args:
        exposure: Seconds that the shutter is open.
        shift: Pixels by which the image moves meanwhile.
    """
    count = 2 * math.ceil((min(shift, MOST) - 1.0) / 2.0) + 1 if shift > 1.0 else 1
    return [exposure * ((k + 0.5) / count - 0.5) for k in range(count)]


def generator(seed: int, camera: str, stamp_ns: int) -> np.random.Generator:
    """Return the generator of an exposure's noise, the same in every process."""
    words = (seed, zlib.crc32(camera.encode()), stamp_ns)
    return np.random.default_rng([word & 0xFFFF_FFFF_FFFF_FFFF for word in words])


def grey_of(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the luma (BT.601) of a colour image, shape (height, width)."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


_MOST = 8.0  # largest correction factor per image, either way: black gives no measure of darkness


class AutoExposure(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of automatic exposure, first by exposure time and then by gain.

    Attributes:
        target: Mean light of a well-exposed image, a share of white's in linear light; 0.18: grey.
        min_exposure: Shortest exposure time.
        max_exposure: Longest exposure time.
        exposure_step: Step of the exposure time, such as an image sensor's row time.
        max_gain: Largest factor of the amplifier.
        gain_step: Step of the gain, decibels.
        damping: Share of the error (of its logarithm) left after each image: 0 is quickest.
        tolerance: Error, as a share of the target, left uncorrected.
    """

    target: Annotated[float, msgspec.Meta(ge=0.01, le=0.9)] = 0.18
    min_exposure: Latency = Latency(20e-6)  # immutable
    max_exposure: Latency = Latency(10e-3)
    exposure_step: Latency = Latency(10e-6)
    max_gain: Annotated[float, msgspec.Meta(ge=1.0, le=1000.0)] = 8.0
    gain_step: Annotated[float, msgspec.Meta(gt=0.0, le=6.0)] = 0.5
    damping: Annotated[float, msgspec.Meta(ge=0.0, le=0.95)] = 0.5
    tolerance: Annotated[float, msgspec.Meta(ge=0.0, le=0.5)] = 0.03

    def __post_init__(self) -> None:
        if not 0.0 < self.exposure_step <= self.min_exposure <= self.max_exposure:
            raise ValueError(
                "exposure_step, min_exposure, max_exposure: expected 0 < step ≤ min ≤ max, found "
                f"{self.exposure_step:g} s, {self.min_exposure:g} s, {self.max_exposure:g} s"
            )


class ExposureControl:
    """Automatic exposure time and gain of a camera, image by image.

    What an image asks for is computed from its own exposure time and gain: late images slow the
    control, but it never goes beyond an image's request.
    """

    def __init__(self, settings: AutoExposure, exposure: float) -> None:
        self._settings = settings
        self._product = exposure
        self._seen: list[tuple[int, float, float]] = []  # delivery (ns), product, light

    def delivered(self, stamp: int, exposure: float, gain: float, light: float) -> None:
        """Note an image delivered at a stamp (ns): exposure (s), gain, mean light (0 to 1)."""
        self._seen.append((stamp, exposure * gain, light))

    def next(self, stamp: int) -> tuple[float, float]:
        """Return exposure time (s) and gain at a rising stamp (ns), by the last image before."""
        settings = self._settings
        before = [seen for seen in self._seen if seen[0] < stamp]
        if before:
            self._seen = self._seen[len(before) :]
            _, product, light = before[-1]
            ratio = settings.target / max(light, settings.target / _MOST)
            error = math.log(product * max(ratio, 1.0 / _MOST) / self._product)
            if abs(error) > settings.tolerance:
                self._product *= math.exp((1.0 - settings.damping) * error)
        steps = int(settings.max_exposure / settings.exposure_step + 1e-9)
        least = math.ceil(settings.min_exposure / settings.exposure_step - 1e-9)
        longest = steps * settings.exposure_step
        most = longest * settings.max_gain
        self._product = min(max(self._product, least * settings.exposure_step), most)
        rows = max(round(min(self._product, longest) / settings.exposure_step), least)
        decibels = 20.0 * math.log10(max(self._product / longest, 1.0))
        largest = math.floor(20.0 * math.log10(settings.max_gain) / settings.gain_step + 1e-9)
        decibels = min(round(decibels / settings.gain_step), largest) * settings.gain_step
        return rows * settings.exposure_step, 10.0 ** (decibels / 20.0)
