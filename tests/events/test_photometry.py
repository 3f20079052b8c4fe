"""Response curves and vignettes mean what announcements say."""

from __future__ import annotations

import numpy as np
import pytest

from events import CameraInfo
from events.camera_info import response_light, srgb_light, vignette_map


def test_srgb_has_its_known_values() -> None:
    """IEC 61966-2-1: black, the end of the straight part, middle grey, white."""
    light = srgb_light()[[0, 10, 188, 255]]
    np.testing.assert_allclose(light, [0.0, 10 / 255 / 12.92, 0.5029, 1.0], atol=1e-4)


def test_a_response_has_any_scale_and_none_is_srgb() -> None:
    np.testing.assert_array_equal(response_light(()), srgb_light())
    curve = tuple(3.0 + 7.0 * k for k in range(256))
    np.testing.assert_allclose(response_light(curve), np.arange(256) / 255.0, atol=1e-12)


@pytest.mark.parametrize("wrong", [(0.0,) * 256, tuple(map(float, range(255)))])
def test_a_response_that_is_none_is_refused(wrong: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="256 numbers, each above the one before"):
        response_light(wrong)


def test_a_vignette_is_one_at_the_principal_point_and_as_asked_in_the_corner() -> None:
    info = CameraInfo(width=41, height=31, fx=30, fy=30, cx=20, cy=15)
    vignette = vignette_map(info, (-0.5, 0.1))
    assert vignette.shape == (31, 41)
    assert vignette[15, 20] == 1.0
    r2 = (20**2 + 15**2) / ((41**2 + 31**2) / 4)
    assert vignette[0, 0] == pytest.approx(1 - 0.5 * r2 + 0.1 * r2**2)
    assert vignette_map(info, ()).min() == 1.0
