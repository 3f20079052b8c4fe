"""From a camera's settings to its intrinsics: field of view or focal length, and the lens."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from events import CameraInfo
from events.camera_info import COEFFICIENTS

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels; whole coordinates are those of pixel centres."""

_OTHERS_CALL_IT = {
    "radtan": "plumb_bob",
    "radtan4": "plumb_bob",
    "radtan5": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "kb4": "equidistant",
    "kannala_brandt": "equidistant",
    "fisheye": "equidistant",
    "equi": "equidistant",
}


class Lens(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A lens that distorts.

    Attributes:
        model: ``plumb_bob`` (others say radtan), ``rational_polynomial``, or ``equidistant``
            (Kannala-Brandt's fisheye, KB4), with the formulae of OpenCV.
        coefficients: Of plumb_bob k1, k2, p1, p2 and, if not 0, k3; of rational_polynomial k1, k2,
            p1, p2, k3, k4, k5, k6; of equidistant k1, k2, k3, k4.
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
    """Return the intrinsics that a camera's settings describe.

    Args:
        width: Pixels.
        height: Pixels.
        fov: Horizontal field of view, degrees, with what the lens does to it; of no effect beside
            `given`. Pixels are square then, and the principal point is the centre.
        given: The intrinsics, if they are given.
        lens: The lens; None distorts nothing.

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
