"""Covariance of a pose, moved by a lever."""

from __future__ import annotations

import numpy as np

from events.geometry import Floats


def cross_matrix(vector: Floats) -> Floats:
    """Return the matrix of a cross product with a vector from the left, shape (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def moved_covariance(covariance: Floats, turn: Floats, shift: Floats) -> Floats:
    """Return the covariance of a pose's error at another point, along other axes, shape (6, 6).

    Args:
        covariance: Of a shift of a point and a rotation about it (m², m rad, rad²), shape (6, 6).
        turn: Rotation from its axes to the others, shape (3, 3).
        shift: How a rotation moves the other point (m/rad), shape (3, 3): by the lever to there
            ``-cross_matrix(lever) @ turn``, or along the old axes ``-turn @ cross_matrix(lever)``.
    """
    moved = np.zeros((6, 6))
    moved[:3, :3] = moved[3:, 3:] = turn
    moved[:3, 3:] = shift
    result: Floats = moved @ covariance @ moved.T
    return result
