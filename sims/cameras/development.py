"""Image formation: effects of lens and image sensor on the drawn images of an exposure.

The grey levels that MuJoCo draws are taken to be sRGB's (IEC 61966-2-1), and their white to be the
light that fills a pixel at the reference exposure. Light beyond it was cut off in drawing, so a
short exposure darkens the image, but brings no overexposed surface back. Depth is measured as
sensors do, by triangulation, with what they cannot see left out: K. Khoshelham, S. O. Elberink,
"Accuracy and Resolution of Kinect Depth Data", Sensors 2012 (noise of disparity, eq. 9); A. Handa
et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM", ICRA 2014 (noise of
disparity before it is rounded); A. Grunnet-Jepsen et al., "Best-Known-Methods for Tuning Intel
RealSense D400 Depth Cameras", 2018 (invalid band, range).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import response_light, srgb_light, vignette_map
from sims.cameras.response import (
    defocused,
    gaussian,
    grey_of,
    mean,
    noise_steps,
    noisy_depth,
    noisy_image,
    read_response,
)
from sims.cameras.spec import CameraSpec, DepthSensor, camera_info

Depths = npt.NDArray[np.float32]
Holes = npt.NDArray[np.bool_]

_WINDOW = (7, 7)  # window of a stereo camera's texture check, pixels
_FARTHEST = 1e6  # metres; stands for ``inf`` where its inverse has to be more than zero


class DepthMeter:
    """Depth measurement; `light` is a factor on the scene's lights, not on the projector's."""

    def __init__(self, sensor: DepthSensor, info: CameraInfo, light: float = 1.0) -> None:
        self._sensor = sensor
        self._info = info
        self._reach = sensor.reach(info.fx)
        self._columns = np.arange(info.width, dtype=np.float32)
        self._u = ((self._columns - info.cx) / info.fx).astype(np.float32)
        rows = np.arange(info.height, dtype=np.float32)[:, None]
        self._v = ((rows - info.cy) / info.fy).astype(np.float32)
        self._ray = 1.0 + self._u**2 + self._v**2  # length of the ray at depth 1, squared
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
            disparity += gaussian(depth.shape, sensor.disparity_noise, random)
        if sensor.disparity_step:
            disparity *= 1.0 / sensor.disparity_step
            np.rint(disparity, out=disparity)
            disparity *= sensor.disparity_step
        # A disparity that noise has brought to zero or below is that of the horizon.
        np.maximum(disparity, 1e-9, out=disparity)
        found = np.divide(np.float32(self._reach), disparity, out=disparity)
        hole |= (found < sensor.min_depth) | (found > sensor.max_depth)
        return np.where(hole, np.float32(np.inf), found)

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
        """Return a mask of the pixels aslant, at an edge, dark or without texture.

        Inverse depth of a plane is affine in the pixel: its gradient gives the normal n, and the
        cosine of the angle to the ray r is ``inverse / (|n| |r|)``.
        """
        sensor, info = self._sensor, self._info
        border = cv2.BORDER_REPLICATE
        across = np.asarray(cv2.Sobel(inverse, -1, 1, 0, scale=info.fx / 8, borderType=border))
        down = np.asarray(cv2.Sobel(inverse, -1, 0, 1, scale=info.fy / 8, borderType=border))
        normal = across * self._u
        normal += down * self._v
        normal -= inverse
        for part in (across, down, normal):
            np.square(part, out=part)
        normal += across
        normal += down
        normal *= self._ray
        cosine = np.divide(np.square(inverse, out=across), normal, out=across)  # squared
        hole: Holes = cosine < math.cos(math.radians(sensor.max_slant)) ** 2
        if colour is None or not sensor.needs_colours:
            return hole
        grey = grey_of(colour)
        if sensor.model == "stereo":
            mean = np.asarray(cv2.boxFilter(grey, cv2.CV_32F, _WINDOW))
            square = np.asarray(cv2.sqrBoxFilter(grey, cv2.CV_32F, _WINDOW))
            square -= np.square(mean, out=mean)
            hole |= square < sensor.min_contrast**2
        else:
            light = np.asarray(cv2.LUT(grey, self._light))
            hole |= np.multiply(light, cosine, out=light) < sensor.min_brightness**2
        return hole


Image = npt.NDArray[np.uint8]
Codes = npt.NDArray[np.uint16]

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

    def __init__(self, spec: CameraSpec) -> None:
        self._spec = spec
        response = read_response(spec.response)
        self._light = response_light(response)
        self._srgb = not response
        sensor = spec.depth_sensor
        self._depth_meter = DepthMeter(sensor, camera_info(spec), spec.light) if sensor else None
        self._vignette: Codes | None = None
        if any(spec.vignette):
            shares = np.sqrt(vignette_map(camera_info(spec), spec.vignette))
            self._vignette = np.rint(shares * _LINEAR).astype(np.uint16)
        # With automatic exposure the same few exposure times and gains come again and again.
        self._table = functools.lru_cache(maxsize=8)(self._make_table)
        self._levels = functools.lru_cache(maxsize=8)(self._make_levels)

    def develop(
        self,
        images: Sequence[Image],
        random: np.random.Generator,
        exposure: float = 0.0,
        gain: float = 1.0,
    ) -> Image:
        """Return an exposure's image, of drawings (h, w, 3) or (h, w) at even moments."""
        reference = self._spec.reference_exposure
        factor = gain * (exposure / reference if reference else 1.0)
        through_root = self._vignette is not None or self._spec.full_well > 0.0
        light = self._collected(images)
        if light is images[0] and self._srgb and factor == 1.0 and not through_root:
            levels: Any = images[0]
        else:
            seen = cv2.LUT(light, self._table(light.itemsize, factor, through_root))
            levels = self._read_out(seen, gain, random) if through_root else seen
        return noisy_image(np.asarray(levels, np.uint8), self._spec.noise, random)

    def measure(
        self, depth: Depths, images: Sequence[Image], random: np.random.Generator
    ) -> Depths:
        """Return measured depth of the true one, metres, shape (h, w); ``inf`` for nothing."""
        if self._depth_meter is None:
            return noisy_depth(depth, self._spec.depth_noise, random)
        middle = images[len(images) // 2] if images else None
        return self._depth_meter.measure(depth, middle, random)

    def meter(self, image: Image) -> float:
        """Return an exposure meter's reading of a developed image: mean light, 0 to 1."""
        codes = np.rint(self._light * _LINEAR).astype(np.uint16)
        seen = codes[image[::_METERED, ::_METERED]]  # whole numbers: any order of adding will do
        return int(seen.sum(dtype=np.int64)) / (seen.size * _LINEAR)

    def _collected(self, images: Sequence[Image]) -> Image | Codes:
        """Return the collected light: grey levels as drawn, or codes of linear light."""
        if len(images) == 1 and self._spec.blur <= 0.0:
            return images[0]
        codes = np.rint(srgb_light() * _LINEAR).astype(np.uint16)[None]
        light = mean([np.asarray(cv2.LUT(image, codes), np.uint16) for image in images])
        return defocused(light, self._spec.blur)

    def _make_table(self, itemsize: int, factor: float, root: bool) -> Image | Codes:
        light = factor * (srgb_light() if itemsize == 1 else np.arange(65536) / _LINEAR)
        if root:
            return np.minimum(np.rint(np.sqrt(light) * _ROOT), 65535).astype(np.uint16)[None]
        return self._grey_levels(light)

    def _read_out(self, root: Any, gain: float, random: np.random.Generator) -> Image:
        """Return the grey levels of light whose root is given.

        The root of a Poisson-distributed number n has the standard deviation 1/2, whatever n is
        (F. J. Anscombe, "The transformation of Poisson, binomial and negative-binomial data",
        Biometrika 1948); its square exceeds the mean by 1/4.
        """
        if self._vignette is not None:
            shares = cv2.merge([self._vignette] * (root.size // self._vignette.size))
            cv2.multiply(root, shares, dst=root, scale=1.0 / _LINEAR)
        electrons = self._spec.full_well / gain
        sigma = 0.5 / math.sqrt(electrons) if electrons else 0.0
        if sigma:
            steps = noise_steps(root.shape, sigma * _ROOT, 32767, random)
            cv2.add(root, steps, dst=root, dtype=cv2.CV_16U)
        return np.asarray(cv2.LUT(root, self._levels(sigma)), np.uint8)

    def _make_levels(self, sigma: float) -> Image:
        root = np.arange(65536) / _ROOT
        return self._grey_levels(np.maximum(root * root - sigma * sigma, 0.0))

    def _grey_levels(self, light: npt.NDArray[np.float64]) -> Image:
        levels = np.rint(np.interp(light, self._light, np.arange(256.0)))
        return np.asarray(levels, np.uint8)[None]
