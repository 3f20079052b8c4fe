"""Axes: properties of the ways from NED and FRD to ENU and FLU, and back."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import Quaternion, Vector3
from nodes.ros_messages.frames import (
    Axes,
    relative,
    rotate,
    turn_covariance,
    turn_points,
    turn_rotation,
    turn_vector,
    unit,
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
    return unit(parts)


def matrix(rotation: Quaternion) -> np.ndarray:
    return np.asarray(Rotation.from_quat(rotation, scalar_first=True).as_matrix())


@given(axes, vectors)
def test_the_way_there_and_the_way_back_are_the_same(which: Axes, vector: Vector3) -> None:
    assert turn_vector(which, turn_vector(which, vector)) == vector


@given(axes, vectors)
def test_vectors_turn_as_the_axes_do(which: Axes, vector: Vector3) -> None:
    np.testing.assert_array_equal(turn_vector(which, vector), MATRICES[which].T @ vector)
    points = np.array([vector], np.float32)
    np.testing.assert_array_equal(turn_points(which, points), points @ MATRICES[which])


@given(axes, axes, rotations())
def test_rotations_come_back(parent: Axes, child: Axes, rotation: Quaternion) -> None:
    there = turn_rotation(parent, child, rotation)
    again = turn_rotation(parent, child, there)
    np.testing.assert_allclose(matrix(again), matrix(rotation), atol=1e-12)


@given(axes, axes, rotations(), vectors)
def test_a_turned_rotation_turns_turned_vectors(
    parent: Axes, child: Axes, rotation: Quaternion, vector: Vector3
) -> None:
    turned = rotate(turn_rotation(parent, child, rotation), turn_vector(child, vector))
    np.testing.assert_allclose(turned, turn_vector(parent, rotate(rotation, vector)), atol=1e-9)


def test_north_is_ninety_degrees_of_yaw_and_east_none() -> None:
    north, east = (1.0, 0.0, 0.0, 0.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    s = np.sqrt(0.5)
    np.testing.assert_allclose(turn_rotation("world", "body", north), (s, 0, 0, s), atol=1e-12)
    np.testing.assert_allclose(turn_rotation("world", "body", east), (1, 0, 0, 0), atol=1e-12)
    assert turn_vector("world", (1.0, 2.0, -3.0)) == (2.0, 1.0, 3.0)
    assert turn_vector("body", (1.0, 2.0, -3.0)) == (1.0, -2.0, 3.0)


def test_a_covariance_turns_both_its_blocks() -> None:
    given = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    given[0, 2] = given[2, 0] = 0.5
    turned = turn_covariance("world", given.ravel()).reshape(6, 6)
    np.testing.assert_array_equal(np.diag(turned), [2.0, 1.0, 3.0, 5.0, 4.0, 6.0])
    assert turned[1, 2] == -0.5
    np.testing.assert_array_equal(turn_covariance("world", turned.ravel()), given.ravel())


@given(vectors, rotations(), vectors, rotations())
def test_a_relative_pose_is_found_again_from_its_base(
    base: Vector3, turned: Quaternion, place: Vector3, rotation: Quaternion
) -> None:
    position, _ = relative((base, turned), (place, rotation))
    np.testing.assert_allclose(np.add(rotate(turned, position), base), place, atol=1e-8)


def test_a_quaternion_that_stands_for_nothing_is_refused() -> None:
    assert unit((2.0, 0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)
    for wrong in ((0.0, 0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0, 1.0), (1e9, 0.0, 0.0, 0.0)):
        with pytest.raises(ValueError, match="length one"):
            unit(wrong)
