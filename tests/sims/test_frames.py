"""Frames: conversions undo themselves, and quaternions do what matrices do."""

from __future__ import annotations

from math import cos, isclose, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import Quaternion, Vector3
from sims import frames

numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.floats(-3.1, 3.1)
rotations = st.builds(frames.from_euler, angles, st.floats(-1.5, 1.5), angles)


def matrix_of(rotation: Quaternion) -> np.ndarray:
    w, x, y, z = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(vectors, rotations)
def test_a_half_turn_undoes_itself(vector: Vector3, rotation: Quaternion) -> None:
    assert frames.half_turn_vector(frames.half_turn_vector(vector)) == vector
    assert frames.half_turn_quaternion(frames.half_turn_quaternion(rotation)) == rotation


@given(vectors, rotations)
def test_rotating_and_changing_frames_commute(vector: Vector3, rotation: Quaternion) -> None:
    """Body to world in FLU/NWU, then to NED, is FRD first and then body to world."""
    one = frames.half_turn_vector(frames.rotate(rotation, vector))
    other = frames.rotate(frames.half_turn_quaternion(rotation), frames.half_turn_vector(vector))
    assert one == pytest.approx(other, abs=1e-9)


@given(rotations, vectors)
def test_rotate_is_the_matrix_product(rotation: Quaternion, vector: Vector3) -> None:
    assert frames.rotate(rotation, vector) == pytest.approx(matrix_of(rotation) @ vector, abs=1e-9)
    assert frames.rotate_inverse(rotation, vector) == pytest.approx(
        matrix_of(rotation).T @ vector, abs=1e-9
    )


@given(rotations, rotations)
def test_multiply_is_the_product_of_matrices(a: Quaternion, b: Quaternion) -> None:
    np.testing.assert_allclose(
        matrix_of(frames.multiply(a, b)), matrix_of(a) @ matrix_of(b), atol=1e-9
    )
    assert frames.multiply(a, frames.conjugate(a)) == pytest.approx(frames.IDENTITY, abs=1e-9)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_are_three_turns_in_the_order_yaw_pitch_roll(
    yaw: float, pitch: float, roll: float
) -> None:
    rz = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    ry = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    rx = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    rotation = frames.from_euler(yaw, pitch, roll)
    np.testing.assert_allclose(matrix_of(rotation), rz @ ry @ rx, atol=1e-9)
    assert isclose(frames.yaw_of(rotation), yaw, abs_tol=1e-6)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(c * c for c in q) > 1e-3))
def test_from_matrix_finds_every_rotation_again(components: Quaternion) -> None:
    """For whichever component is the largest, and with w ≥ 0."""
    rotation = frames.normalize(components)
    found = frames.from_matrix(matrix_of(rotation).tolist())
    assert found[0] >= 0.0
    assert abs(sum(a * b for a, b in zip(found, rotation, strict=True))) == pytest.approx(1.0)


@pytest.mark.parametrize(("axis", "expected"), [(1, (0, 1, 0, 0)), (2, (0, 0, 1, 0))])
def test_from_matrix_of_half_turns(axis: int, expected: Quaternion) -> None:
    """Where w is zero, and a careless formula divides by it."""
    diagonal = [-1.0, -1.0, -1.0]
    diagonal[axis - 1] = 1.0
    assert frames.from_matrix(np.diag(diagonal).tolist()) == pytest.approx(expected)


def test_signs_of_ned_and_frd() -> None:
    """A positive yaw from north looks east, a positive pitch up, a positive roll right-down."""
    ahead, right = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    assert frames.rotate(frames.from_euler(pi / 2, 0, 0), ahead) == pytest.approx((0, 1, 0))
    assert frames.rotate(frames.from_euler(0, 0.1, 0), ahead)[2] < 0.0
    assert frames.rotate(frames.from_euler(0, 0, 0.1), right)[2] > 0.0


def test_zero_is_no_rotation() -> None:
    with pytest.raises(ValueError, match="longer than zero"):
        frames.normalize((0.0, 0.0, 0.0, 0.0))
