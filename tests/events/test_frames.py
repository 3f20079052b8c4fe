"""Frames: properties of the changes from NED and FRD to ENU, NWU and FLU, and back."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import Quaternion, Vector3
from events.frames import (
    OPTICAL_TO_FLU,
    OPTICAL_TO_FRD,
    Axes,
    convert_covariance,
    convert_points,
    convert_rotation,
    convert_vector,
    flip_yz,
    flip_yz_rotation,
    normalize,
    rotate,
    rotation_to_ned,
    rotation_to_nwu,
)

AXES: list[Axes] = list(get_args(Axes))

numbers = st.floats(-1e3, 1e3)
vectors = st.tuples(numbers, numbers, numbers)
axes = st.sampled_from(AXES)
# ROS's axes in ours, a column for each: REP 103.
MATRICES = {
    "world": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "body": np.diag([1, -1, -1]),
    "optical": np.eye(3),
}


@st.composite
def rotations(draw: st.DrawFn) -> Quaternion:
    parts = draw(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01))
    return normalize(parts)


def matrix(rotation: Quaternion) -> np.ndarray:
    return np.asarray(Rotation.from_quat(rotation, scalar_first=True).as_matrix())


@given(axes, vectors)
def test_the_way_there_and_the_way_back_are_the_same(which: Axes, vector: Vector3) -> None:
    assert convert_vector(which, convert_vector(which, vector)) == vector


@given(axes, vectors)
def test_vectors_turn_as_the_axes_do(which: Axes, vector: Vector3) -> None:
    np.testing.assert_array_equal(convert_vector(which, vector), MATRICES[which].T @ vector)
    points = np.array([vector], np.float32)
    np.testing.assert_array_equal(convert_points(which, points), points @ MATRICES[which])


@pytest.mark.slow
@given(axes, axes, rotations())
def test_rotations_come_back(parent: Axes, child: Axes, rotation: Quaternion) -> None:
    there = convert_rotation(parent, child, rotation)
    again = convert_rotation(parent, child, there)
    np.testing.assert_allclose(matrix(again), matrix(rotation), atol=1e-12)


@pytest.mark.slow
@given(axes, axes, rotations(), vectors)
def test_a_turned_rotation_turns_turned_vectors(
    parent: Axes, child: Axes, rotation: Quaternion, vector: Vector3
) -> None:
    turned = rotate(convert_rotation(parent, child, rotation), convert_vector(child, vector))
    np.testing.assert_allclose(turned, convert_vector(parent, rotate(rotation, vector)), atol=1e-9)


def test_north_is_ninety_degrees_of_yaw_and_east_none() -> None:
    north, east = (1.0, 0.0, 0.0, 0.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    s = np.sqrt(0.5)
    np.testing.assert_allclose(convert_rotation("world", "body", north), (s, 0, 0, s), atol=1e-12)
    np.testing.assert_allclose(convert_rotation("world", "body", east), (1, 0, 0, 0), atol=1e-12)
    assert convert_vector("world", (1.0, 2.0, -3.0)) == (2.0, 1.0, 3.0)
    assert convert_vector("body", (1.0, 2.0, -3.0)) == (1.0, -2.0, 3.0)


def test_a_covariance_turns_both_its_blocks() -> None:
    given = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    given[0, 2] = given[2, 0] = 0.5
    turned = convert_covariance("world", given.ravel()).reshape(6, 6)
    np.testing.assert_array_equal(np.diag(turned), [2.0, 1.0, 3.0, 5.0, 4.0, 6.0])
    assert turned[1, 2] == -0.5
    np.testing.assert_array_equal(convert_covariance("world", turned.ravel()), given.ravel())


@given(vectors, rotations())
def test_flipping_undoes_itself(vector: Vector3, rotation: Quaternion) -> None:
    assert flip_yz(flip_yz(vector)) == vector
    assert flip_yz_rotation(flip_yz_rotation(rotation)) == rotation
    assert rotation_to_ned(rotation_to_nwu(rotation)) == rotation


@pytest.mark.slow
@given(vectors, rotations())
def test_rotating_and_flipping_commute(vector: Vector3, rotation: Quaternion) -> None:
    """Body to world in FLU and NWU, then to NED, is FRD first and then body to world."""
    one = flip_yz(rotate(rotation, vector))
    other = rotate(flip_yz_rotation(rotation), flip_yz(vector))
    assert one == pytest.approx(other, abs=1e-9)


@given(vectors, rotations())
def test_the_world_is_flipped_and_the_child_is_not(vector: Vector3, rotation: Quaternion) -> None:
    rotated = rotate(rotation_to_nwu(rotation), vector)
    assert rotated == pytest.approx(flip_yz(rotate(rotation, vector)), abs=1e-9)


@pytest.mark.parametrize(
    ("rotation", "down"), [(OPTICAL_TO_FRD, (0, 0, 1)), (OPTICAL_TO_FLU, (0, 0, -1))]
)
def test_a_camera_looks_ahead_and_its_y_points_down(
    rotation: Quaternion, down: tuple[int, int, int]
) -> None:
    assert rotate(rotation, (0.0, 0.0, 1.0)) == pytest.approx((1, 0, 0))
    assert rotate(rotation, (0.0, 1.0, 0.0)) == pytest.approx(down)
