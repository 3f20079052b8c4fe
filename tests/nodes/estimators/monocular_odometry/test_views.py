"""Geometry of two views: against values by hand, and against itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events.geometry import inverse
from nodes.estimators.monocular_odometry.views import (
    centre,
    hypotheses,
    parallax,
    reprojection_errors,
    triangulate,
)
from nodes.estimators.odometry.pose import rays
from tests.nodes.estimators.monocular_odometry.world import MATRIX, Floats, pose

K = np.array([[100.0, 0.0, 50.0], [0.0, 200.0, 40.0], [0.0, 0.0, 1.0]])
RIGHT = inverse(pose(x=1.0))
"""A camera a metre to the right of the first, world to camera."""
metres = st.floats(-1, 1)
degrees = st.floats(-20, 20)


def project(view: Floats, points: Floats) -> Floats:
    seen = points @ view[:3, :3].T + view[:3, 3]
    return np.asarray((seen @ MATRIX.T)[:, :2] / seen[:, 2:])


def test_rays_by_hand() -> None:
    found = rays(np.array([[50.0, 40.0], [150.0, 0.0]]), K)
    np.testing.assert_allclose(found, [[0.0, 0.0, 1.0], [1.0, -0.2, 1.0]])


def test_a_centre_is_where_the_camera_is() -> None:
    np.testing.assert_allclose(centre(inverse(pose(1, 2, 3, yaw=40, pitch=-20))), (1, 2, 3))


def test_triangulation_by_hand() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]]), np.array([[-0.5, 0.0, 1.0]])
    np.testing.assert_allclose(
        triangulate(np.eye(4), RIGHT, straight, slant), [[0, 0, 2]], atol=1e-12
    )


def test_rays_that_pass_each_other_meet_in_the_middle() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]]), np.array([[-0.5, 0.0, 1.0]])
    below = inverse(pose(x=1.0, y=0.2))
    np.testing.assert_allclose(
        triangulate(np.eye(4), below, straight, slant), [[0, 0.1, 2]], atol=1e-12
    )


def test_parallel_rays_meet_nowhere() -> None:
    straight = np.array([[0.0, 0.0, 1.0]])
    assert not np.isfinite(triangulate(np.eye(4), RIGHT, straight, straight)).any()


def test_parallax_by_hand() -> None:
    straight, slant = np.array([[0.0, 0.0, 1.0]] * 2), np.array([[-1.0, 0.0, 1.0], [0, 0, 3.0]])
    np.testing.assert_allclose(parallax(np.eye(4), RIGHT, straight, slant), [45, 0])
    turned = inverse(pose(yaw=30))  # turning alone shows nothing from another side
    same = straight[:1] @ turned[:3, :3].T
    np.testing.assert_allclose(parallax(np.eye(4), turned, straight[:1], same), [0], atol=1e-9)


def test_reprojection_errors_by_hand() -> None:
    points = np.array([[0.0, 0.0, 2.0], [1.0, 1.0, 2.0], [0.0, 0.0, -2.0], [np.nan, 0.0, 2.0]])
    pixels = np.array([[50.0, 40.0], [103.0, 136.0], [50.0, 40.0], [50.0, 40.0]])
    errors = reprojection_errors(np.eye(4), points, pixels, K)
    np.testing.assert_allclose(errors, [0, 5, np.inf, np.inf])


@given(st.tuples(metres, metres, metres, degrees, degrees), st.lists(metres, min_size=3))
def test_what_two_cameras_see_is_triangulated_where_it_is(
    motion: tuple[float, ...], numbers: list[float]
) -> None:
    points = np.resize(numbers, (len(numbers) // 3, 3)) + np.array([0.0, 0.0, 6.0])
    first, second = inverse(pose(-1.5, pitch=5)), inverse(pose(*motion))
    pixels = project(first, points), project(second, points)
    a, b = (rays(each, MATRIX) for each in pixels)
    np.testing.assert_allclose(triangulate(first, second, a, b), points, atol=1e-6)
    for view, each in zip((first, second), pixels, strict=True):
        assert reprojection_errors(view, points, each, MATRIX).max() < 1e-8
    to = points - centre(first), points - centre(second)
    cosine = np.sum(to[0] * to[1], axis=1) / np.prod(np.linalg.norm(to, axis=2), axis=0)
    expected = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    np.testing.assert_allclose(parallax(first, second, a, b), expected, atol=1e-4)


@pytest.mark.parametrize("relief", [0.0, 1.0], ids=["plane", "relief"])
def test_the_true_motion_is_among_the_hypotheses(relief: float) -> None:
    random = np.random.default_rng(2)
    points = random.uniform((-1.2, -0.9, 2.0), (1.2, 0.9, 2.0 + relief), (80, 3))
    second = inverse(pose(0.3, -0.1, 0.1, yaw=3, pitch=-2))
    first, last = project(np.eye(4), points), project(second, points)
    last[:4] += 30.0  # followed wrongly
    length = np.linalg.norm(second[:3, 3])
    misses = []
    for found in hypotheses(first, last, MATRIX):
        assert np.linalg.norm(found[:3, 3]) == pytest.approx(1.0)
        assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
        again = found.copy()
        again[:3, 3] *= length
        misses.append(np.abs(again - second).max())
    assert min(misses) < 2e-3
