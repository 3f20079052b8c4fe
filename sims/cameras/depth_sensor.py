"""Depth as sensors measure it: by triangulation, with what they cannot see left out.

K. Khoshelham, S. O. Elberink, "Accuracy and Resolution of Kinect Depth Data", Sensors 2012 (noise
of disparity, eq. 9); A. Handa et al., "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction
and SLAM", ICRA 2014 (noise of disparity before it is rounded); A. Grunnet-Jepsen et al.,
"Best-Known-Methods for Tuning Intel RealSense D400 Depth Cameras", 2018 (invalid band, range).
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from events.camera_info import srgb_light
from sims.cameras.noise import gaussian, grey_of

Depths = npt.NDArray[np.float32]
Holes = npt.NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]

_WINDOW = (7, 7)
"""The pixels in which a stereo camera looks for texture."""

_FARTHEST = 1e6
"""Metres; stands for ``inf`` where its inverse has to be more than zero."""


class DepthSensor(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a depth sensor whose second eye, or projector, is right of the camera.

    A pixel without a measurement is ``inf``: out of range; not seen by the second eye (the shadow
    left of what is near); on a surface that is seen too much aslant, or at an edge; and, as the
    model says, too dark or without texture.

    Attributes:
        model: ``structured_light``: a projector; dark surfaces return too little of its light.
            ``stereo``: a second camera; surfaces without texture cannot be matched, nor can the
            band at the left which is out of its view.
        baseline: Distance to the second eye or projector, metres.
        focal: Focal length of the sensor's own images, pixels, by which disparities are counted; 0
            for that of this camera.
        disparity_step: Disparities are whole multiples of it, pixels; 0: of nothing.
        disparity_noise: Standard deviation of disparities before that, pixels.
        min_depth: Metres; what is nearer is not measured.
        max_depth: Metres; what is farther is not measured.
        max_slant: Greatest angle between the ray and the surface's normal, degrees; in 3×3 pixels,
            so that edges of objects are lost, too. 90: any.
        min_brightness: ``structured_light``: least light of a surface seen head-on, as a share
            of white's, in linear light; aslant more by the angle's cosine. The camera's ``light``
            makes no difference to it. 0: any.
        min_contrast: ``stereo``: least standard deviation of 7×7 pixels, grey levels. 0: any.
    """

    model: Literal["structured_light", "stereo"] = "structured_light"
    baseline: Positive = 0.075
    focal: NonNegative = 0.0
    disparity_step: NonNegative = 0.125
    disparity_noise: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.07
    min_depth: NonNegative = 0.4
    max_depth: Positive = 10.0
    max_slant: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 80.0
    min_brightness: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.005
    min_contrast: NonNegative = 1.0

    def __post_init__(self) -> None:
        if 0.0 < self.disparity_step < 1e-3:
            raise ValueError(
                f"disparity_step: expected 0 or at least 0.001 px, found {self.disparity_step:g}"
            )
        if self.min_depth >= self.max_depth:
            raise ValueError(
                f"min_depth, max_depth: expected a range, found {self.min_depth:g} m to "
                f"{self.max_depth:g} m"
            )

    @property
    def needs_colours(self) -> bool:
        """Whether what is measured depends on how bright things are."""
        limit = self.min_contrast if self.model == "stereo" else self.min_brightness
        return limit > 0.0

    def reach(self, focal: float) -> float:
        """Return the depth of disparity 1 of a camera of a focal length (pixels), metres."""
        return (self.focal or focal) * self.baseline


class DepthMeter:
    """Measures the depth of one camera's exposures.

    Args:
        sensor: Settings.
        info: The camera, without distortion.
        light: Factor on the lights of the scene in the images: the projector's is the same.
    """

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
        """Return what the sensor measures of true depth.

        Args:
            depth: Metres along the optical axis, shape (height, width); ``inf`` for none.
            colour: What the camera sees, shape (height, width, 3), if `needs_colours`.
            random: For the noise.

        Returns:
            Metres, float32; within `min_depth` and `max_depth`, or ``inf``.
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
        """Return which pixels the second eye does not see: something nearer is in its way.

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
        """Return which pixels are aslant, at an edge, dark or without texture.

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
