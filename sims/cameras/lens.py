"""Intrinsics and lens of a camera, and lookup of its image's pixels in drawn pinhole images.

A rasteriser draws pinhole images, here called faces. A lens's image is looked up in one of them,
or, beyond 120°, in the faces of a cube.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import COEFFICIENTS

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
