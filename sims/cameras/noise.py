"""Noise of pictures, drawn so that it depends on seed, camera and stamp, and on nothing else."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
import numpy.typing as npt


def generator(seed: int, camera: str, stamp_ns: int) -> np.random.Generator:
    """Return the generator of one exposure's noise: the same in whatever process asks for it."""
    words = (seed, zlib.crc32(camera.encode()), stamp_ns)
    return np.random.default_rng([word & 0xFFFF_FFFF_FFFF_FFFF for word in words])


def noisy_image(
    image: npt.NDArray[np.uint8], sigma: float, random: np.random.Generator
) -> npt.NDArray[np.uint8]:
    """Return the image plus Gaussian noise of `sigma` grey levels, clipped to 0..255."""
    if sigma <= 0.0:
        return image
    noise = random.standard_normal(image.shape, dtype=np.float32)
    noise *= np.float32(sigma)
    noise += image
    np.rint(noise, out=noise)
    return np.clip(noise, 0.0, 255.0, out=noise).astype(np.uint8)


def noisy_depth(
    depth: npt.NDArray[np.float32], coefficient: float, random: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Return depth (metres) plus Gaussian noise with sigma = coefficient · depth².

    The error of a triangulating sensor grows so (Khoshelham and Elberink, "Accuracy and
    Resolution of Kinect Depth Data", Sensors 2012, eq. 9). What was not hit stays ``inf``, and
    nothing comes closer than zero.
    """
    if coefficient <= 0.0:
        return depth
    noise = random.standard_normal(depth.shape, dtype=np.float32)
    hit = np.isfinite(depth)
    near = np.where(hit, depth, np.float32(0.0))
    noise *= np.float32(coefficient) * near * near
    noise += near
    return np.where(hit, np.maximum(noise, np.float32(0.0)), depth)


def grey_of(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the luma (BT.601) of a colour picture, shape (height, width)."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
