"""Bundles that estimators read: images of one exposure, and what belongs to them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from events import DepthImage, Image, Imu


class MonocularFrame(NamedTuple):
    """An image."""

    image: Image


class MonocularInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    image: Image
    imu: tuple[Imu, ...]


class RgbdFrame(NamedTuple):
    """A colour (or grey) image and the depth of the same exposure."""

    image: Image
    depth: DepthImage


class RgbdInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    image: Image
    depth: DepthImage
    imu: tuple[Imu, ...]


class StereoFrame(NamedTuple):
    """The images of both cameras of a stereo rig, of one exposure."""

    left: Image
    right: Image


class StereoInertialFrame(NamedTuple):
    """The same, and the samples of the IMU since the frame before."""

    left: Image
    right: Image
    imu: tuple[Imu, ...]


def sample_rows(samples: Iterable[Imu]) -> npt.NDArray[np.float64]:
    """Return samples of an IMU: stamp (ns), rad/s and m/s² in a row, shape (n, 7)."""
    rows = [(each.stamp, *each.angular_velocity, *each.linear_acceleration) for each in samples]
    return np.array(rows, np.float64).reshape(-1, 7)
