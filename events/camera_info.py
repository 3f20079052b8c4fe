"""Cameras: intrinsics, distortion, response curve and vignette, from points to pixels and back.

Plain numpy: simulators draw with what estimators compute with. Light is a share of what makes a
pixel white (255) in the middle of the image.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""ROS names; plumb_bob is also called radtan, equidistant is the Kannala-Brandt fisheye."""

COEFFICIENTS: dict[str, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of coefficients of each model."""

_HALF_TURN = {"plumb_bob": math.pi / 2, "rational_polynomial": math.pi / 2, "equidistant": math.pi}
_STEPS = 2048  # number of sampled angles along a model's curve, from 0 to the widest


class CameraInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Intrinsics in OpenCV's convention: pixel *centres* have whole coordinates.

    A point (x, y, z) in the optical frame has the normalised coordinates (x/z, y/z), which the lens
    distorts to (u, v), and falls on column ``fx·u + cx``, row ``fy·v + cy``, all in pixels. An
    ideal camera has the principal point ``(width - 1) / 2``, ``(height - 1) / 2``.

    Attributes:
        distortion_model: ``plumb_bob``, ``rational_polynomial`` or ``equidistant``, with the
            formulae of OpenCV ("Camera Calibration and 3D Reconstruction", "Fisheye camera model").
        distortion: Its coefficients: plumb_bob (k1, k2, p1, p2, k3), rational_polynomial (k1, k2,
            p1, p2, k3, k4, k5, k6), equidistant (k1, k2, k3, k4). An ideal camera is plumb_bob with
            zeros.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: DistortionModel = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        expected = COEFFICIENTS.get(self.distortion_model)
        if expected is None:
            raise ValueError(
                f"CameraInfo.distortion_model: expected one of {', '.join(COEFFICIENTS)}, "
                f"found {self.distortion_model!r:.80}"
            )
        if len(self.distortion) != expected:
            raise ValueError(
                f"CameraInfo.distortion: expected {expected} coefficients of "
                f"{self.distortion_model}, found {len(self.distortion)}"
            )

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov: float) -> CameraInfo:
        """Make an ideal camera with square pixels from its horizontal field of view (radians)."""
        focal = width / (2.0 * np.tan(horizontal_fov / 2.0))
        return cls(
            width=width,
            height=height,
            fx=float(focal),
            fy=float(focal),
            cx=(width - 1) / 2,
            cy=(height - 1) / 2,
        )

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens distorts nothing."""
        return self.distortion_model != "equidistant" and not any(self.distortion)

    def matrix(self) -> Floats:
        """Return the camera matrix K, shape (3, 3), as in OpenCV."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: npt.ArrayLike) -> Floats:
        """Return the pixels, shape (n, 2), of points in the optical frame (any unit), shape (n, 3).

        A pixel may be outside the image; it is NaN where the lens sees nothing: behind a plumb_bob
        camera, and beyond the angle up to which a model is monotonic.
        """
        xyz = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        beside = np.hypot(xyz[:, 0], xyz[:, 1])
        angle = np.arctan2(beside, xyz[:, 2])
        seen = angle < self.widest_angle()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            if self.distortion_model == "equidistant":
                # Where the axis meets the image every direction is as good.
                share = np.where(beside > 0.0, _fisheye(self.distortion)(angle) / beside, 0.0)
                uv = xyz[:, :2] * share[:, None]
            else:
                uv = _brown(self.distortion, xyz[:, :2] / xyz[:, 2:])
        pixels = uv * (self.fx, self.fy) + (self.cx, self.cy)
        pixels[~seen] = np.nan
        return np.asarray(pixels)

    def unproject(self, pixels: npt.ArrayLike) -> Floats:
        """Return the unit rays, shape (n, 3), of pixels, shape (n, 2); the inverse of `project`.

        A ray is NaN where no direction within the monotonic range falls on the pixel.
        """
        uv = (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - (self.cx, self.cy)) / (
            self.fx,
            self.fy,
        )
        widest = self.widest_angle()
        radius = np.hypot(uv[:, 0], uv[:, 1])
        # The angle by the radial part alone, from a table; then Newton's method for the rest.
        angles = np.linspace(0.0, widest * (1.0 - 1e-9), _STEPS)
        angle = np.interp(radius, self._radii(angles), angles, right=np.nan)
        if self.distortion_model == "equidistant":
            curve = _fisheye(self.distortion)
            slope = curve.deriv()
            for _ in range(4):
                angle = angle - (curve(angle) - radius) / slope(angle)
            share = np.where(radius > 0.0, np.sin(angle) / np.maximum(radius, 1e-300), 0.0)
            rays = np.column_stack([uv * share[:, None], np.cos(angle)])
        else:
            share = np.where(radius > 0.0, np.tan(angle) / np.maximum(radius, 1e-300), 0.0)
            start = np.where(np.isfinite(share)[:, None], uv * share[:, None], uv)
            xy = _undistort(self.distortion, uv, start)
            rays = np.column_stack([xy, np.ones(len(xy))])
            with np.errstate(invalid="ignore"):  # where Newton's method went to infinity
                rays /= np.linalg.norm(rays, axis=1)[:, None]
        off = np.linalg.norm(
            self.project(rays) - (uv * (self.fx, self.fy) + (self.cx, self.cy)), axis=1
        )
        rays[~(off < 1e-3)] = np.nan
        return np.asarray(rays)

    def widest_angle(self) -> float:
        """Return the angle off the axis (radians) where the distorted radius stops rising.

        π/2 for a pinhole; beyond a smaller one a pixel would show two directions.
        """
        most = _HALF_TURN[self.distortion_model]
        if self.is_pinhole:
            return most
        angles = np.linspace(0.0, most, _STEPS, endpoint=False)
        radii = self._radii(angles)
        with np.errstate(invalid="ignore"):
            falling = np.flatnonzero(~(np.diff(radii) > 0.0))
        return float(angles[falling[0]]) if len(falling) else most

    def _radii(self, angles: Floats) -> Floats:
        """Return the distorted radius at angles off the axis, without the tangential part."""
        if self.distortion_model == "equidistant":
            return _fisheye(self.distortion)(angles)
        radius = np.tan(angles)
        return radius * _radial(self.distortion, radius * radius)


def _fisheye(k: tuple[float, ...]) -> np.polynomial.Polynomial:
    """Return θ(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) as a function."""
    return np.polynomial.Polynomial([0, 1, 0, k[0], 0, k[1], 0, k[2], 0, k[3]])


def _radial(d: tuple[float, ...], r2: Floats) -> Floats:
    k1, k2, _, _, k3, k4, k5, k6 = (*d, 0.0, 0.0, 0.0)[:8]
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.asarray(above / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))))


def _brown(d: tuple[float, ...], xy: Floats) -> Floats:
    """Return normalised coordinates, shape (n, 2), as the lens distorts them."""
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    p1, p2 = d[2], d[3]
    radial = _radial(d, r2)
    return np.column_stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


def _undistort(d: tuple[float, ...], uv: Floats, xy: Floats) -> Floats:
    """Invert `_brown` at `uv` by Newton's method with numeric slopes, starting at `xy`."""
    step = 1e-6
    right, down = np.array([step, 0.0]), np.array([0.0, step])
    # Where nothing falls on a pixel it runs away, which `unproject` finds.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(12):
            off = _brown(d, xy) - uv
            along_x = (_brown(d, xy + right) - _brown(d, xy - right)) / (2 * step)
            along_y = (_brown(d, xy + down) - _brown(d, xy - down)) / (2 * step)
            determinant = along_x[:, 0] * along_y[:, 1] - along_x[:, 1] * along_y[:, 0]
            dx = (off[:, 0] * along_y[:, 1] - off[:, 1] * along_y[:, 0]) / determinant
            dy = (along_x[:, 0] * off[:, 1] - along_x[:, 1] * off[:, 0]) / determinant
            xy = xy - np.column_stack([dx, dy])
    return xy


def srgb_light() -> Floats:
    """Return the light of each of the 256 grey levels of sRGB (IEC 61966-2-1), shape (256,)."""
    levels = np.arange(256) / 255.0
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def response_light(response: tuple[float, ...]) -> Floats:
    """Return the light of each of the 256 grey levels, shape (256,), from 0 to 1.

    Raises:
        ValueError: There are not 256, or they do not rise.
    """
    if not response:
        return srgb_light()
    light = np.array(response, dtype=np.float64)
    if light.shape != (256,) or not (np.diff(light) > 0.0).all():
        raise ValueError(
            f"response: expected 256 numbers, each above the one before, found {light.size}"
            + (" that do not rise" if light.size == 256 else "")
        )
    return np.asarray((light - light[0]) / (light[-1] - light[0]))


def vignette_map(info: CameraInfo, vignette: tuple[float, ...]) -> Floats:
    """Return the share of light reaching each pixel, shape (height, width), by its coefficients."""
    half = np.hypot(info.width, info.height) / 2.0
    across = (np.arange(info.width) - info.cx) / half
    down = (np.arange(info.height) - info.cy) / half
    share = np.polynomial.Polynomial((1.0, *vignette))(across**2 + down[:, None] ** 2)
    return np.asarray(share)
