"""Rotations: quaternions do what matrices do, and what scipy does."""

from __future__ import annotations

from math import cos, isclose, pi, sin

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from events import Quaternion, Vector3
from events import frames as rotations

numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.floats(-3.1, 3.1)
orientations = st.builds(rotations.from_rpy, angles, st.floats(-1.5, 1.5), angles)


def matrix_of(rotation: Quaternion) -> np.ndarray:
    w, x, y, z = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(orientations, vectors)
def test_rotate_is_the_matrix_product(rotation: Quaternion, vector: Vector3) -> None:
    assert rotations.rotate(rotation, vector) == pytest.approx(
        matrix_of(rotation) @ vector, abs=1e-9
    )
    assert rotations.rotate_inverse(rotation, vector) == pytest.approx(
        matrix_of(rotation).T @ vector, abs=1e-9
    )


@given(orientations, orientations)
def test_multiply_is_the_product_of_matrices(a: Quaternion, b: Quaternion) -> None:
    np.testing.assert_allclose(
        matrix_of(rotations.multiply(a, b)), matrix_of(a) @ matrix_of(b), atol=1e-9
    )
    assert rotations.multiply(a, rotations.inverse(a)) == pytest.approx(
        rotations.IDENTITY, abs=1e-9
    )


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_are_three_turns_in_the_order_yaw_pitch_roll(
    yaw: float, pitch: float, roll: float
) -> None:
    rz = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    ry = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    rx = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    rotation = rotations.from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(matrix_of(rotation), rz @ ry @ rx, atol=1e-9)
    assert isclose(rotations.yaw_of(rotation), yaw, abs_tol=1e-6)


def test_signs_of_ned_and_frd() -> None:
    """A positive yaw from north looks east, a positive pitch up, a positive roll right-down."""
    ahead, right = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    assert rotations.rotate(rotations.from_rpy(0, 0, pi / 2), ahead) == pytest.approx((0, 1, 0))
    assert rotations.rotate(rotations.from_rpy(0, 0.1, 0), ahead)[2] < 0.0
    assert rotations.rotate(rotations.from_rpy(0.1, 0, 0), right)[2] > 0.0


@given(angles)
def test_a_level_body_has_a_yaw_only(yaw: float) -> None:
    assert rotations.from_yaw(yaw) == pytest.approx(rotations.from_rpy(0.0, 0.0, yaw), abs=1e-15)


@given(orientations, orientations)
def test_the_angle_between_two_is_scipys(a: Quaternion, b: Quaternion) -> None:
    p, q = Rotation.from_quat([a, b], scalar_first=True)
    expected = (p.inv() * q).magnitude()
    assert rotations.angle_between(a, b) == pytest.approx(expected, abs=1e-9)
    w, x, y, z = b
    assert rotations.angle_between(a, (-w, -x, -y, -z)) == pytest.approx(expected, abs=1e-9)


def test_a_tiny_angle_is_not_lost() -> None:
    tiny = 1e-9
    turned = (cos(tiny / 2), sin(tiny / 2), 0.0, 0.0)
    assert rotations.angle_between(rotations.IDENTITY, turned) == pytest.approx(tiny, rel=1e-6)


@given(orientations, orientations, st.floats(0.0, 1.0), st.booleans())
@example(rotations.IDENTITY, rotations.from_yaw(1e-6), 0.0, False)
def test_slerp_is_scipys_on_the_shorter_arc(
    a: Quaternion, b: Quaternion, share: float, other_sign: bool
) -> None:
    assume(rotations.angle_between(a, b) < 3.1)  # at half a turn both arcs are as short
    expected = Slerp([0.0, 1.0], Rotation.from_quat([a, b], scalar_first=True))(share)
    w, x, y, z = b
    turned = rotations.slerp(a, (-w, -x, -y, -z) if other_sign else b, share)
    assert sum(c * c for c in turned) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(matrix_of(turned), expected.as_matrix(), atol=1e-9)


@given(orientations, st.floats(0.0, 1.0))
def test_slerp_between_neighbours_divides_by_nothing(a: Quaternion, share: float) -> None:
    assert rotations.slerp(a, a, share) == pytest.approx(a, abs=1e-15)


@pytest.mark.parametrize(
    "wrong",
    [
        (0.0, 0.0, 0.0, 0.0),
        (1e-4, 0.0, 0.0, 0.0),
        (float("nan"), 0.0, 0.0, 1.0),
        (1e9, 0.0, 0.0, 0.0),
    ],
)
def test_what_is_no_rotation_is_refused(wrong: Quaternion) -> None:
    assert rotations.normalize((2.0, 0.0, 0.0, 0.0)) == (1.0, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="length one"):
        rotations.normalize(wrong)
