"""Poses: tuples and matrices are the same transforms."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from events import Quaternion, Vector3
from events.covariance import cross_matrix, moved_covariance
from events.frames import from_rpy, rotate
from events.geometry import inverse, pose_matrix, pose_tuples, relative

numbers = st.floats(-1e3, 1e3)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.floats(-3.1, 3.1)
orientations = st.builds(from_rpy, angles, st.floats(-1.5, 1.5), angles)


@given(vectors, orientations, vectors)
def test_a_matrix_takes_points_where_the_quaternion_does(
    position: Vector3, orientation: Quaternion, point: Vector3
) -> None:
    expected = np.add(rotate(orientation, point), position)
    moved = pose_matrix(position, orientation) @ [*point, 1.0]
    np.testing.assert_allclose(moved[:3], expected, atol=1e-8)


@given(vectors, orientations)
def test_tuples_come_back_from_the_matrix(position: Vector3, orientation: Quaternion) -> None:
    matrix = pose_matrix(position, orientation)
    place, turn = pose_tuples(matrix)
    assert place == position
    assert turn[0] >= 0.0
    np.testing.assert_allclose(pose_matrix(place, turn), matrix, atol=1e-12)
    np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(4), atol=1e-9)


@given(vectors, orientations, vectors, orientations)
def test_a_relative_pose_is_what_leads_from_its_base_to_the_pose(
    base: Vector3, turned: Quaternion, place: Vector3, rotation: Quaternion
) -> None:
    offset = pose_matrix(*relative((base, turned), (place, rotation)))
    expected = pose_matrix(place, rotation)
    np.testing.assert_allclose(pose_matrix(base, turned) @ offset, expected, atol=1e-8)


@given(orientations, vectors, vectors, vectors)
def test_an_error_is_at_another_point_what_the_rotation_makes_of_it(
    orientation: Quaternion, lever: Vector3, shift: Vector3, rotation: Vector3
) -> None:
    turn = pose_matrix((0.0, 0.0, 0.0), orientation)[:3, :3]
    at_point = np.concatenate([shift, rotation])
    elsewhere = np.concatenate([turn @ (shift + np.cross(rotation, lever)), turn @ rotation])
    expected = np.outer(elsewhere, elsewhere)
    before, after = np.array(lever), turn @ lever
    for moves in (-turn @ cross_matrix(before), -cross_matrix(after) @ turn):
        moved = moved_covariance(np.outer(at_point, at_point), turn, moves)
        np.testing.assert_allclose(moved, expected, atol=1e-9 * (1.0 + np.abs(expected).max()))
