"""Kannala-Brandt lens that is nearest to another, for programs that know no radial-tangential one.

J. Kannala and S. S. Brandt, "A generic camera model and calibration method for conventional,
wide-angle, and fish-eye lenses", IEEE T-PAMI 2006, with four coefficients, as OpenCV's fisheye
model and Basalt's ``kb4``.
"""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
from scipy.optimize import least_squares

from events import CameraInfo
from nodes.data.dataset.recording import Rig

_COLUMNS, _ROWS = 41, 31  # of the pixels at which both are compared


@cache
def nearest_kannala_brandt(info: CameraInfo) -> tuple[CameraInfo, float, float]:
    """Return the nearest equidistant lens, and its distance (px): root mean square and greatest.

    Focal lengths and centre are fitted, too. Distances are between the pixels of the rays that the
    image shows, at a grid over the whole image.
    """
    x, y = np.linspace(0, info.width - 1, _COLUMNS), np.linspace(0, info.height - 1, _ROWS)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = info.unproject(pixels)
    pixels, rays = pixels[np.isfinite(rays).all(axis=1)], rays[np.isfinite(rays).all(axis=1)]
    radius = np.hypot(rays[:, 0], rays[:, 1])
    angle = np.arctan2(radius, rays[:, 2])
    towards = rays[:, :2] / np.maximum(radius, 1e-12)[:, None]
    powers = angle[:, None] ** np.array([3, 5, 7, 9])

    def distances(values: np.ndarray) -> np.ndarray:
        bent = (angle + powers @ values[4:])[:, None] * towards
        return np.ravel(values[:2] * bent + values[2:4] - pixels)

    start = np.array([info.fx, info.fy, info.cx, info.cy, 0.3, 0.1, 0.0, 0.0])
    scale = np.maximum(abs(start), 0.01)
    fit = least_squares(distances, start, x_scale=scale, ftol=1e-15, xtol=1e-15, gtol=1e-15)
    fx, fy, cx, cy, *k = fit.x.tolist()
    off = np.hypot(*fit.fun.reshape(-1, 2).T)
    lens = {"distortion_model": "equidistant", "distortion": tuple(k)}
    nearest = msgspec.structs.replace(info, fx=fx, fy=fy, cx=cx, cy=cy, **lens)
    return nearest, float(np.sqrt((off**2).mean())), float(off.max())


def with_kannala_brandt(rig: Rig) -> tuple[Rig, list[str]]:
    """Return a rig whose distorting lenses are all equidistant, and a sentence for each fitted."""
    cameras, sentences = [], []
    for camera in rig.cameras:
        if not camera.info.is_pinhole and camera.info.distortion_model != "equidistant":
            info, mean, most = nearest_kannala_brandt(camera.info)
            camera = msgspec.structs.replace(camera, info=info)
            sentences.append(
                f"{camera.source}: its lens is written as the nearest kb4, {mean:.2g} px off on "
                f"average (root mean square), {most:.2g} at most"
            )
        cameras.append(camera)
    return msgspec.structs.replace(rig, cameras=tuple(cameras)), sentences
