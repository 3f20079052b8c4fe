"""Defocus and shutter as functions of images."""

from __future__ import annotations

import numpy as np
import pytest

from sims.cameras.response import MOST, defocused, mean, moments


@pytest.mark.parametrize("sigma", [0.7, 1.5, 4.0])
def test_a_point_out_of_focus_is_a_gaussian(sigma: float) -> None:
    """Of the spread that is asked for, about where the point was."""
    point = np.zeros((61, 61), np.uint16)
    point[28:33, 28:33] = 65535  # five pixels wide, so that rounding doesn't eat the flanks
    found = defocused(point, sigma).astype(np.float64)
    weight = found.sum(0) / found.sum()
    place = np.arange(61)
    assert weight @ place == pytest.approx(30.0, abs=1e-6)
    variance = weight @ (place - 30.0) ** 2
    assert variance == pytest.approx(sigma**2 + (5**2 - 1) / 12, rel=0.05)


def test_no_blur_costs_nothing() -> None:
    image = np.zeros((4, 4), np.uint16)
    assert defocused(image, 0.0) is image


@pytest.mark.parametrize(
    ("shift", "count"), [(0.0, 1), (1.0, 1), (1.1, 3), (3.0, 3), (3.1, 5), (9.0, 9), (1e9, MOST)]
)
def test_moments_are_a_pixel_apart_at_most(shift: float, count: int) -> None:
    """As many as the motion needs, odd in number, up to a limit; centred on the exposure."""
    found = moments(0.02, shift)
    assert len(found) == count
    assert found[count // 2] == 0.0
    np.testing.assert_allclose(found, -np.array(found[::-1]), atol=1e-15)
    np.testing.assert_allclose(np.diff(found), 0.02 / count, rtol=1e-9)
    assert found[-1] + 0.02 / count / 2 == pytest.approx(0.01)


def test_the_mean_is_rounded_and_does_not_overflow() -> None:
    values = np.array([[65535, 65535, 0], [65535, 65534, 0], [65535, 65534, 2]], np.uint16)
    found = mean([row[None] for row in values])
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, [[65535, 65534, 1]])
    assert mean([np.full((1, 1), 65535, np.uint16)] * 9)[0, 0] == 65535
