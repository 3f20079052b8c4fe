"""Image formation: effects of lens and image sensor on the drawn images of an exposure.

The grey levels that MuJoCo draws are taken to be sRGB's (IEC 61966-2-1), and their white to be the
light that fills a pixel at the reference exposure. Light beyond it was cut off in drawing, so a
short exposure darkens the image, but brings no overexposed surface back. Depth is measured as
sensors do, by triangulation, with what they cannot see left out: K. Khoshelham, S. O. Elberink,
"Accuracy and Resolution of Kinect Depth Data", Sensors 2012 (noise of disparity, eq. 9); A. Handa
et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014 (noise of
disparity before it is rounded); A. Grunnet-Jepsen et al., "Best-Known-Methods for Tuning Intel
RealSense D400 Depth Cameras", 2018 (invalid band, range).

Noise depends on seed, camera and stamp, and on nothing else. Normal numbers come from a table of
the normal distribution's quantiles, at a place that 16 random bits name. The bits are counter-based
(Philox4x32-7: J. K. Salmon et al., "Parallel Random Numbers: As Easy as 1, 2, 3", SC 2011): those
of a pixel are computed from the exposure's key and the pixel's place. The same bytes come out on
every machine, whatever its instructions are.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import response_light, srgb_light, vignette_map
from sims.cameras.optics import defocused, grey_of, read_response
from sims.cameras.spec import CameraSpec, DepthSensor, camera_info
from sims.compiled import libraries

Image = npt.NDArray[np.uint8]
Codes = npt.NDArray[np.uint16]
Depths = npt.NDArray[np.float32]
Holes = npt.NDArray[np.bool_]
Table = npt.NDArray[np.int32]
Key = npt.NDArray[np.uint32]

_LOW = 0xFFFF_FFFF


class Stages(NamedTuple):
    """Tables of the stages from light to grey levels, in their order; None: none."""

    table: Table | None = None  # from levels or codes of light to roots or levels
    shares: Codes | None = None  # share of the root of light at each sample, of 65535
    shot: Table | None = None  # 65536 equally likely steps of noise of the roots
    levels: Table | None = None  # from roots to levels
    steps: Table | None = None  # 65536 equally likely steps of noise of the levels


class Passes:
    """Passes over the samples of images: in C++, or in numpy where nothing was compiled.

    Args:
        instructions: One of `libraries`, or ``numpy``; the quickest by default. All give the same.
    """

    def __init__(self, instructions: str = "") -> None:
        self._library = libraries().get(instructions or next(iter(libraries()), ""))

    def mean(self, images: Sequence[Image], codes: Table) -> Codes:
        """Return the rounded mean of images (at most 127) through a table of 256 codes."""
        images, count = [np.ascontiguousarray(image) for image in images], len(images)
        if self._library is None:
            total = sum(codes[image] for image in images)
            return np.asarray((2 * total + count) // (2 * count), np.uint16)
        averaged = np.empty(images[0].shape, np.uint16)
        addresses = np.array([image.ctypes.data for image in images], np.uintp)
        self._library.develop_mean(
            ctypes.c_int64(averaged.size), count, *map(_at, (addresses, codes, averaged))
        )
        return averaged

    def develop(self, image: Image | Codes, stages: Stages, key: Key) -> Image:
        """Return the grey levels of an image of levels or codes, any shape, after all stages."""
        if self._library is None:
            return _developed(image, stages, key)
        light: npt.NDArray[Any] = np.ascontiguousarray(image)
        developed = np.empty(light.shape, np.uint8)
        self._library.develop_image(
            _at(key), ctypes.c_int64(0), ctypes.c_int64(light.size), int(light.itemsize == 2),
            _at(light), *map(_at, stages), _at(developed),
        )  # fmt: skip
        return developed

    def add_noise(self, values: Depths, sigma: float, key: Key, square: bool = False) -> Depths:
        """Return values plus Gaussian noise, none below zero; ``inf`` stays.

        Args:
            sigma: Standard deviation, if `square`, of a value of 1: it grows with their squares.
        """
        table = _quantiles() * np.float32(sigma)
        if self._library is None:
            noise = table[random_words(key, 0, values.size)].reshape(values.shape)
            if square:
                near = np.minimum(values, np.float32(1e9))  # whose square is a number
                noise *= near
                noise *= near
            noise += values
            return np.asarray(np.maximum(noise, np.float32(0.0)), np.float32)
        values = np.ascontiguousarray(values)
        noisy = np.empty_like(values)
        self._library.develop_depth(
            _at(key), ctypes.c_int64(0), ctypes.c_int64(values.size), int(square),
            *map(_at, (values, table, noisy)),
        )  # fmt: skip
        return noisy

    def slant(self, inverse: Depths, u: Depths, v: Depths, per_u: float, per_v: float) -> Depths:
        """Return squared cosines of the angles between rays and the surfaces in 3×3 pixels.

        Inverse depth of a plane is affine in the pixel: its gradient gives the normal n, and the
        cosine of the angle to the ray r is ``inverse / (|n| |r|)``. OpenCV's gradients are no help:
        their last bits depend on the width of the instructions.

        Args:
            inverse: Inverse depth, shape (height, width).
            u: Columns at depth 1, shape (width,).
            v: Rows at depth 1, shape (height, 1).
            per_u: An eighth of the focal length, for Sobel's sums.
            per_v: The same for rows.
        """
        if self._library is None:
            around = np.pad(inverse, 1, mode="edge")
            columns = 2.0 * around[1:-1] + around[:-2] + around[2:]
            rows = 2.0 * around[:, 1:-1] + around[:, :-2] + around[:, 2:]
            across = (columns[:, 2:] - columns[:, :-2]) * np.float32(per_u)
            down = (rows[2:] - rows[:-2]) * np.float32(per_v)
            normal = (across * u + down * v - inverse) ** 2 + across**2 + down**2
            return np.asarray(inverse**2 / (normal * (1.0 + u**2 + v**2)))
        height, width = inverse.shape
        inverse = np.ascontiguousarray(inverse)
        slants = np.empty_like(inverse)
        self._library.develop_slant(
            width, height, *map(_at, (inverse, u, v)), ctypes.c_float(per_u),
            ctypes.c_float(per_v), _at(slants),
        )  # fmt: skip
        return slants


def noise_key(random: np.random.Generator) -> Key:
    """Return a key of noise, shape (4,); two of one generator have nothing in common."""
    raw: npt.NDArray[np.uint64] = np.asarray(random.bit_generator.random_raw(2))
    return raw.view(np.uint32)


def random_words(key: Key, stream: int, count: int, rounds: int = 7) -> Codes:
    """Return random numbers of 16 bits, shape (count,), as `draw` in ``develop.cpp``."""
    first, second, *stamp = key.tolist()
    groups = -(-count // 64)
    a: npt.NDArray[Any] = np.arange(8 * groups, dtype=np.uint64)
    b, c, d = (np.full_like(a, word) for word in (stream, *stamp))
    for _ in range(rounds):
        one, other = a * 0xD2511F53, c * 0xCD9E8D57
        a, b, c, d = (other >> 32) ^ b ^ first, other & _LOW, (one >> 32) ^ d ^ second, one & _LOW
        first, second = (first + 0x9E3779B9) & _LOW, (second + 0xBB67AE85) & _LOW
    words = np.stack([a, b, c, d]).astype(np.uint32).reshape(4, groups, 8)
    return np.ascontiguousarray(words.swapaxes(0, 1)).view(np.uint16).ravel()[:count]


def _developed(image: Image | Codes, stages: Stages, key: Key) -> Image:
    table, shares, shot, levels, steps = stages
    seen: npt.NDArray[Any] = image.astype(np.int64).ravel()
    if table is not None:
        seen = table[seen].astype(np.int64)
    if shares is not None:
        seen = (seen * shares + 32767) // 65535
    if shot is not None:
        seen = np.clip(seen + shot[random_words(key, 0, seen.size)], 0, 65535)
    if levels is not None:
        seen = levels[seen]
    if steps is not None:
        seen = np.clip(seen + steps[random_words(key, 1, seen.size)], 0, 255)
    return seen.astype(np.uint8).reshape(image.shape)


def _at(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)


@functools.cache
def _quantiles() -> Depths:
    """Return 65536 numbers as likely as each other, of mean 0 and standard deviation 1."""
    upper = [NormalDist().inv_cdf((number + 0.5) / 65536) for number in range(32768, 65536)]
    values = np.concatenate([-np.array(upper[::-1]), upper])
    return np.asarray(values / values.std(), dtype=np.float32)


@functools.lru_cache(maxsize=16)
def _steps(sigma: float, limit: int) -> Table | None:
    """Return 65536 equally likely whole numbers of a deviation, none beyond a limit."""
    if sigma <= 0.0:
        return None
    steps = np.clip(np.rint(sigma * _quantiles()), -limit, limit)
    return np.asarray(steps, np.int32)


_WINDOW = (7, 7)  # window of a stereo camera's texture check, pixels
_FARTHEST = 1e6  # metres; stands for ``inf`` where its inverse has to be more than zero


class DepthMeter:
    """Depth measurement; `light` is a factor on the scene's lights, not on the projector's."""

    def __init__(
        self, sensor: DepthSensor, info: CameraInfo, light: float = 1.0, instructions: str = ""
    ) -> None:
        self._passes = Passes(instructions)
        self._sensor = sensor
        self._info = info
        self._reach = sensor.reach(info.fx)
        self._columns = np.arange(info.width, dtype=np.float32)
        self._u = ((self._columns - info.cx) / info.fx).astype(np.float32)
        rows = np.arange(info.height, dtype=np.float32)[:, None]
        self._v = ((rows - info.cy) / info.fy).astype(np.float32)
        levels = np.arange(256.0)
        brightness = np.interp(levels / light, levels, srgb_light())
        self._light = np.square(brightness).astype(np.float32)[None]

    def measure(
        self, depth: Depths, colour: npt.NDArray[np.uint8] | None, random: np.random.Generator
    ) -> Depths:
        """Return the measured depth in `min_depth` to `max_depth`, metres, float32; else ``inf``.

        Args:
            depth: Metres along the optical axis, shape (height, width); ``inf`` for none.
            colour: What the camera sees, shape (height, width, 3), if `needs_colours`.
        """
        sensor = self._sensor
        inverse = np.clip(depth, 1e-6, _FARTHEST)
        np.divide(np.float32(1.0), inverse, out=inverse)
        hole = self._hidden(inverse)
        hole |= self._unmatched(inverse, colour)
        disparity = np.multiply(inverse, np.float32(self._reach), out=inverse)
        if sensor.disparity_noise:
            key = noise_key(random)
            disparity = self._passes.add_noise(disparity, sensor.disparity_noise, key)
        if sensor.disparity_step:
            disparity *= 1.0 / sensor.disparity_step
            np.rint(disparity, out=disparity)
            disparity *= sensor.disparity_step
        # A disparity that noise has brought to zero or below is that of the horizon.
        np.maximum(disparity, 1e-9, out=disparity)
        measured = np.divide(np.float32(self._reach), disparity, out=disparity)
        hole |= (measured < sensor.min_depth) | (measured > sensor.max_depth)
        return np.where(hole, np.float32(np.inf), measured)

    def _hidden(self, inverse: Depths) -> Holes:
        """Return a mask of the pixels hidden from the second eye by a nearer surface.

        A pixel's ray meets the second image in the column ``x - disparity``. On one surface that
        rises with x; where a column further right falls left of it, that one's surface is nearer.
        """
        reach = self._info.fx * self._sensor.baseline
        columns = self._columns - inverse * np.float32(reach)
        farthest = min(int(float(inverse.max()) * reach) + 2, self._info.width)
        nearer = np.asarray(cv2.erode(columns, np.ones((1, farthest), np.uint8), anchor=(0, 0)))
        hidden = np.zeros(columns.shape, np.bool_)
        # The left edge of a pixel is half a pixel before its middle.
        np.greater(columns[:, :-1], nearer[:, 1:] - np.float32(0.5), out=hidden[:, :-1])
        if self._sensor.model == "stereo":
            hidden |= columns < -0.5
        return hidden

    def _unmatched(self, inverse: Depths, colour: npt.NDArray[np.uint8] | None) -> Holes:
        """Return a mask of the pixels aslant, at an edge, dark or without texture."""
        sensor, info = self._sensor, self._info
        cosine = self._passes.slant(inverse, self._u, self._v, info.fx / 8, info.fy / 8)  # squared
        hole: Holes = cosine < math.cos(math.radians(sensor.max_slant)) ** 2
        if colour is None or not sensor.needs_colours:
            return hole
        grey = grey_of(colour)
        if sensor.model == "stereo":
            # In whole numbers, n² times the variance of n pixels.
            total = cv2.boxFilter(grey, cv2.CV_32S, _WINDOW, normalize=False)
            square = cv2.sqrBoxFilter(grey, cv2.CV_32S, _WINDOW, normalize=False)
            count = _WINDOW[0] * _WINDOW[1]
            hole |= count * square - total * total < (count * sensor.min_contrast) ** 2
        else:
            light = np.asarray(cv2.LUT(grey, self._light))
            hole |= light * cosine < sensor.min_brightness**2
        return hole


_LINEAR = 65535.0  # code of white in linear light
_ROOT = 40000.0  # code of the root of white: there is room for 2.7 times as much light
_METERED = 4  # the exposure meter looks at every fourth row and column


class Development:
    """Effects of lens, shutter and image sensor on a camera's exposures.

    In this order: mean over the moments of the exposure (motion blur), defocus, vignette, exposure
    time and gain, shot noise, response, and noise of the same size at all grey levels. All but the
    last two are in linear light. An ideal camera's image stays as it is, byte for byte.

    Raises:
        ValueError: The file of its response is missing or holds something else.
    """

    def __init__(self, spec: CameraSpec, instructions: str = "") -> None:
        self._spec = spec
        self._passes = Passes(instructions)
        response = read_response(spec.response)
        self._light = response_light(response)
        self._srgb = not response
        self._depth_meter = (
            DepthMeter(spec.depth_sensor, camera_info(spec), spec.light, instructions)
            if spec.depth_sensor
            else None
        )
        # With automatic exposure the same few exposure times and gains come again and again.
        self._stages = functools.lru_cache(maxsize=8)(self._make_stages)
        self._shares = functools.cache(self._make_shares)

    def develop(
        self,
        images: Sequence[Image],
        random: np.random.Generator,
        exposure: float = 0.0,
        gain: float = 1.0,
    ) -> Image:
        """Return an exposure's image, of drawings (h, w, 3) or (h, w) at even moments."""
        light: Image | Codes = images[0]
        if len(images) > 1 or self._spec.blur > 0.0:
            codes = np.rint(srgb_light() * _LINEAR).astype(np.int32)
            light = defocused(self._passes.mean(images, codes), self._spec.blur)
        reference = self._spec.reference_exposure
        factor = gain * (exposure / reference if reference else 1.0)
        stages = self._stages(light.dtype == np.uint16, light.ndim, factor, gain)
        if all(stage is None for stage in stages):
            return images[0]
        return self._passes.develop(light, stages, noise_key(random))

    def measure(
        self, depth: Depths, images: Sequence[Image], random: np.random.Generator
    ) -> Depths:
        """Return measured depth of the true one, metres, shape (h, w); ``inf`` for nothing."""
        if self._depth_meter is not None:
            middle = images[len(images) // 2] if images else None
            return self._depth_meter.measure(depth, middle, random)
        if self._spec.depth_noise <= 0.0:
            return depth
        key = noise_key(random)
        return self._passes.add_noise(depth, self._spec.depth_noise, key, square=True)

    def meter(self, image: Image) -> float:
        """Return an exposure meter's reading of a developed image: mean light, 0 to 1."""
        codes = np.rint(self._light * _LINEAR).astype(np.uint16)
        seen = codes[image[::_METERED, ::_METERED]]  # whole numbers: any order of adding will do
        return int(seen.sum(dtype=np.int64)) / (seen.size * _LINEAR)

    def _make_stages(self, wide: bool, ndim: int, factor: float, gain: float) -> Stages:
        """Return the stages from levels, or from codes (`wide`), at a factor on the light.

        The root of a Poisson-distributed number n has the standard deviation 1/2, whatever n is
        (F. J. Anscombe, "The transformation of Poisson, binomial and negative-binomial data",
        Biometrika 1948); its square exceeds the mean by 1/4.
        """
        spec = self._spec
        steps = _steps(spec.noise, 255)
        light = factor * (np.arange(65536) / _LINEAR if wide else srgb_light())
        if not (any(spec.vignette) or spec.full_well):
            ideal = not wide and self._srgb and factor == 1.0
            return Stages(None if ideal else self._grey_levels(light), steps=steps)
        sigma = 0.5 / math.sqrt(spec.full_well / gain) if spec.full_well else 0.0
        root = np.arange(65536) / _ROOT
        return Stages(
            np.minimum(np.rint(np.sqrt(light) * _ROOT), 65535).astype(np.int32),
            self._shares(ndim),
            _steps(sigma * _ROOT, 65535),
            self._grey_levels(np.maximum(root * root - sigma * sigma, 0.0)),
            steps,
        )

    def _make_shares(self, ndim: int) -> Codes | None:
        """Return the vignette at each sample of an image of 2 or 3 dimensions."""
        if not any(self._spec.vignette):
            return None
        roots = np.sqrt(vignette_map(camera_info(self._spec), self._spec.vignette))
        shares = np.rint(roots * _LINEAR).astype(np.uint16).ravel()
        return shares.repeat(3) if ndim == 3 else shares

    def _grey_levels(self, light: npt.NDArray[np.float64]) -> Table:
        levels = np.rint(np.interp(light, self._light, np.arange(256.0)))
        return np.asarray(levels, np.int32)
