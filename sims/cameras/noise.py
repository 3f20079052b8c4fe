"""Noise of images, drawn so that it depends on seed, camera and stamp, and on nothing else.

Normal numbers come from a table of the normal distribution's quantiles, at a place that 16 random
bits name: no two pixels or images share any, and it takes a sixth of the time of drawing them.
"""

from __future__ import annotations

import functools
import zlib
from typing import TypeVar

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

N = TypeVar("N", np.float32, np.int16)

_TABLES_OF_16_BITS = int(cv2.__version__.partition(".")[0]) >= 5

_FARTHEST = np.float32(1e9)
"""Metres; stands for ``inf`` where its square has to be a number."""


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
    noise = noise_steps(image.shape, sigma, 255, random)
    return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def noise_steps(
    shape: tuple[int, ...], sigma: float, limit: int, random: np.random.Generator
) -> npt.NDArray[np.int16]:
    """Return Gaussian noise in whole numbers, none beyond a limit (at most 32767) either way."""
    return _look_up(_steps(sigma, limit), _draw(shape, random))


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
    noise = gaussian(depth.shape, coefficient, random)
    near = np.minimum(depth, _FARTHEST)
    noise *= near
    noise *= near
    noise += depth
    return np.maximum(noise, np.float32(0.0), out=noise)


def gaussian(
    shape: tuple[int, ...], sigma: float, random: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Return Gaussian noise of mean 0."""
    return _look_up(_quantiles() * np.float32(sigma), _draw(shape, random))


def grey_of(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the luma (BT.601) of a colour image, shape (height, width)."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _draw(shape: tuple[int, ...], random: np.random.Generator) -> npt.NDArray[np.uint16]:
    """Return whole numbers, each of 16 random bits."""
    count = int(np.prod(shape))
    raw = random.bit_generator.random_raw(-(-count // 4))
    return np.asarray(raw).view(np.uint16)[:count].reshape(shape)


def _look_up(table: npt.NDArray[N], places: npt.NDArray[np.uint16]) -> npt.NDArray[N]:
    """Return the table's entries at some places, shape as theirs."""
    if _TABLES_OF_16_BITS:  # the same in half the time
        return np.asarray(cv2.LUT(places, table.reshape(1, -1)))
    return np.take(table, places)


@functools.cache
def _quantiles() -> npt.NDArray[np.float32]:
    """Return 65536 numbers as likely as each other, of mean 0 and standard deviation 1."""
    values = ndtri((np.arange(65536) + 0.5) / 65536)
    return np.asarray(values / values.std(), dtype=np.float32)


@functools.lru_cache(maxsize=16)
def _steps(sigma: float, limit: int) -> npt.NDArray[np.int16]:
    """Return the same, times sigma, in whole numbers up to a limit."""
    levels = np.clip(np.rint(sigma * _quantiles()), -limit, limit)
    return np.asarray(levels, dtype=np.int16)
