"""Bundles that estimators read: images of one exposure, and what belongs to them."""

from __future__ import annotations

from typing import NamedTuple

from events import DepthImage, Image, Imu


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
