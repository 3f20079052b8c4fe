"""Camera models against OpenCV's, and back again."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraInfo

SIZE: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "fx": 380.0,
    "fy": 375.0,
    "cx": 318.3,
    "cy": 241.7,
}
PINHOLE = CameraInfo(**SIZE)
RADTAN = CameraInfo(**SIZE, distortion=(-0.28, 0.07, 2e-4, -1e-4, 0.0))
RATIONAL = CameraInfo(
    **SIZE,
    distortion_model="rational_polynomial",
    distortion=(0.4, -0.1, 1e-4, 2e-4, 0.02, 0.7, -0.05, 0.01),
)
KB4 = CameraInfo(
    **(SIZE | {"fx": 250.0, "fy": 250.0}),
    distortion_model="equidistant",
    distortion=(-0.01, 0.012, -0.008, 0.001),
)
ALL = [PINHOLE, RADTAN, RATIONAL, KB4]
IDS = ["pinhole", "radtan", "rational", "kb4"]


def grid(info: CameraInfo) -> np.ndarray:
    """Return points all over the image, at several depths."""
    columns, rows = np.meshgrid(np.linspace(40, 600, 15), np.linspace(40, 440, 11))
    rays = info.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    return rays * np.linspace(0.5, 9.0, len(rays))[:, None]


@pytest.mark.parametrize("info", ALL, ids=IDS)
def test_projects_as_opencv_does(info: CameraInfo) -> None:
    points = grid(info)
    assert np.isfinite(points).all()
    coefficients = np.array(info.distortion)
    zero = np.zeros(3)
    if info.distortion_model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(
            points[None], zero, zero, info.matrix(), coefficients
        )
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, info.matrix(), coefficients)
    np.testing.assert_allclose(info.project(points), expected.reshape(-1, 2), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("info", ALL, ids=IDS)
@given(column=st.floats(0, 639), row=st.floats(0, 479))
def test_unprojects_to_what_projects_there(info: CameraInfo, column: float, row: float) -> None:
    ray = info.unproject([[column, row]])
    assert math.isclose(float(np.linalg.norm(ray)), 1.0, abs_tol=1e-9)
    np.testing.assert_allclose(info.project(ray * 3.0), [[column, row]], atol=1e-4)


def test_what_a_lens_cannot_see_has_no_pixel() -> None:
    behind = [[0.1, 0.2, -1.0]]
    assert np.isnan(PINHOLE.project(behind)).all()
    assert np.isfinite(KB4.project([[1.0, 0.2, -0.1]])).all()  # 96 degrees off the axis
    bent = CameraInfo(**SIZE, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    assert bent.widest_angle() == pytest.approx(math.atan(math.sqrt(1 / 0.9)), abs=2e-3)
    assert np.isnan(bent.project([[2.0, 0.0, 1.0]])).all()
    assert np.isnan(bent.unproject([[318.3 + 380.0, 241.7]])).all()


@pytest.mark.parametrize(
    ("model", "distortion", "message"),
    [
        ("plumb_bob", (0.0,) * 4, "expected 5 coefficients of plumb_bob, found 4"),
        ("fov", (0.9,), "expected one of plumb_bob, rational_polynomial, equidistant"),
    ],
)
def test_a_wrong_model_is_refused(model: str, distortion: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraInfo(**SIZE, distortion_model=model, distortion=distortion)  # type: ignore[arg-type]
