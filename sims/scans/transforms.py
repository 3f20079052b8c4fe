"""Transforms of points as 4 × 4 matrices, with the same bits on every machine.

NumPy's matrix products, inverses and ``einsum`` are those of a library that sums in another order,
or fuses a product with a sum, from one processor to the next; here each product and each sum is
rounded by itself. Sines and cosines, which also differ in their last bits, are rounded to 1e-12.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import Floats

Normals = npt.NDArray[np.float32]


def compose(outer: Floats, inner: Floats) -> Floats:
    """Return the transform that applies `inner`, then `outer`."""
    product: Floats = (outer[:, :, None] * inner[None, :, :]).sum(axis=1)
    return product


def translation(vector: npt.ArrayLike) -> Floats:
    """Return the transform that adds a vector."""
    matrix = np.eye(4)
    matrix[:3, 3] = vector
    return matrix


def scaling(factors: npt.ArrayLike) -> Floats:
    """Return the transform that multiplies x, y and z, shape (3,)."""
    matrix = np.eye(4)
    matrix[[0, 1, 2], [0, 1, 2]] = factors
    return matrix


def rotation(axis: Floats, angle: float) -> Floats:
    """Return the turn by an angle, rad, around an axis of any length; none around zero."""
    x, y, z = map(float, unit(axis))
    sin, cos = round(math.sin(angle), 12), round(math.cos(angle), 12)
    rest = 1 - cos
    matrix = np.eye(4)
    if x or y or z:
        matrix[:3, :3] = [
            [cos + rest * x * x, rest * x * y - sin * z, rest * x * z + sin * y],
            [rest * x * y + sin * z, cos + rest * y * y, rest * y * z - sin * x],
            [rest * x * z - sin * y, rest * y * z + sin * x, cos + rest * z * z],
        ]
    return matrix


def quaternion(x: float, y: float, z: float, w: float) -> Floats:
    """Return the rotation of a quaternion of any length; none of zero."""
    length = math.sqrt(x * x + y * y + z * z + w * w)
    matrix = np.eye(4)
    if length > 0:
        x, y, z, w = x / length, y / length, z / length, w / length
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    return matrix


def unit(vector: Floats) -> Floats:
    """Return a vector of length 1 of shape (3,), or zero of zero."""
    x, y, z = map(float, vector)
    length = math.sqrt(x * x + y * y + z * z)
    return vector / length if length > 0 else vector


def moved(points: npt.NDArray[np.floating], matrix: Floats) -> Floats:
    """Return transformed points, float64 of shape (n, 3)."""
    x, y, z = points.astype(np.float64).T
    return np.stack([a * x + b * y + c * z + d for a, b, c, d in matrix[:3].tolist()], axis=1)


def determinant(matrix: Floats) -> float:
    """Return how a transform changes volumes: below 0 if it mirrors, 0 if it flattens."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def seen(corners: npt.NDArray[np.int32], matrix: Floats) -> npt.NDArray[np.int32]:
    """Return corners that are counter-clockwise from outside after a transform, as before."""
    return np.ascontiguousarray(corners[:, ::-1]) if determinant(matrix) < 0 else corners


def turned(normals: npt.NDArray[np.floating], matrix: Floats) -> Normals | None:
    """Return transformed normals of length 1, or None if one has no direction."""
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()
    sign = -1.0 if determinant(matrix) < 0 else 1.0
    x, y, z = normals[:, :3].astype(np.float64).T * sign
    # By the matrix of cofactors: the inverse, transposed, but for its length.
    x, y, z = (
        (e * i - f * h) * x + (f * g - d * i) * y + (d * h - e * g) * z,
        (c * h - b * i) * x + (a * i - c * g) * y + (b * g - a * h) * z,
        (b * f - c * e) * x + (c * d - a * f) * y + (a * e - b * d) * z,
    )
    length = np.sqrt(x * x + y * y + z * z)
    if not np.isfinite(length).all() or (length == 0).any():
        return None
    return np.stack([x / length, y / length, z / length], axis=1).astype(np.float32)
