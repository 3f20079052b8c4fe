"""Tools of the odometries: node, grey images, flow, surfaces, poses, relocalization.

Images are of the announced size and without distortion; flow goes from one to another, and back.
Poses come from pixels and depths of landmarks by robust Gauss-Newton with Huber's weights;
residuals are two pixels and the inverse depth, in units of noise (R. Mur-Artal and J. D. Tardós,
"ORB-SLAM2", IEEE T-RO 2017, section III-A). Relocalization is by ORB descriptors of known points:
E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraInfo, DepthImage, Image
from events.geometry import inverse
from nodes.estimators.estimator import C, Estimator
from nodes.estimators.rig import TrackingResult, sample_rows
from runtime import Bundle

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]


class Tracker(Protocol):
    """Tracker of an odometry."""

    def track(self, stamp: int, *data: Any) -> TrackingResult | None:
        """Return the pose of the next frame; `None` before there is a map.

        Args:
            stamp: Of the exposure on the clock of the IMU (ns).
            data: Of each field of the frame: an image, shape (h, w, 3) red, green, blue, or (h, w)
                grey; depth, metres along the optical axis, shape (h, w), ``inf`` where nothing was
                measured; samples of the IMU since the frame before, as of `sample_rows`.

        Raises:
            ValueError: The size is not that of the camera.
        """


class OdometryNode(Estimator[C]):
    """Base of nodes around a tracker, in a process of its own."""

    frames: Bundle[Any]
    tracks: Callable[..., TrackingResult | None] = staticmethod(Tracker.track)
    """Method of the tracker that takes a frame; its arguments are those of `Tracker.track`."""

    @abstractmethod
    def tracker(self) -> tuple[Any, ...]:
        """Return what makes the tracker, and its arguments."""

    async def on_ready(self) -> None:
        """Start the tracker."""
        self._tracker = await self.start_tracker(*self.tracker())

    async def run(self) -> None:
        """Track each frame; those arriving meanwhile are skipped, samples of the IMU are not."""
        async for frame in self.frames:
            image = frame[0]
            data = [
                part.data if isinstance(part, Image | DepthImage) else sample_rows(part)
                for part in frame
            ]
            result = await self._tracker.call(self.tracks, self.exposed_at(image), *data)
            if result is not None:  # there is a map
                self.publish(image, result)


def refuse_distortion(info: CameraInfo) -> None:
    """Raise `ValueError` if a camera's images are distorted."""
    if not info.is_pinhole:
        raise ValueError(
            f"camera: expected images without distortion, found {info.distortion_model} "
            f"with {info.distortion}"
        )


def grey_image(info: CameraInfo, image: npt.NDArray[np.uint8]) -> Grey:
    """Return an image, (h, w, 3) or (h, w), as grey; a `ValueError` if not of the camera's size."""
    _check_size(info, "image", image, {(), (3,)})
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def grey_and_depth(
    info: CameraInfo, image: npt.NDArray[np.uint8], depth: Depth
) -> tuple[Grey, Depth]:
    """Return grey image and depth; a `ValueError` if one is not of the camera's size."""
    _check_size(info, "depth", depth, {()})
    return grey_image(info, image), depth


def inside(pixels: Floats, shape: tuple[int, ...], rim: int) -> npt.NDArray[np.bool_]:
    """Return a mask, shape (n,), of pixels (n, 2) at least `rim` pixels from the edge."""
    x, y = pixels.T
    return np.asarray((x >= rim) & (x < shape[1] - rim) & (y >= rim) & (y < shape[0] - rim))


def _check_size(
    info: CameraInfo, name: str, array: npt.NDArray[Any], channels: set[tuple[int, ...]]
) -> None:
    if array.shape[:2] != (info.height, info.width) or array.shape[2:] not in channels:
        raise ValueError(
            f"{name}: expected {info.width}×{info.height} pixels, as the camera announced, "
            f"found shape {array.shape}"
        )


FLOW_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
"""When the iterations of optical flow end: after 20, or at a step of 0.01 pixels."""
_ROUND_TRIP = 0.5  # largest error of a corner followed there and back, pixels


def follow_both_ways(
    image: Grey,
    other: Grey,
    pixels: Floats,  # column and row, shape (n, 2), n > 0
    guess: Floats,  # their approximate pixels in the other image, shape (n, 2)
    window: int,  # side of the compared neighbourhood, pixels
    levels: int,  # halvings of the images
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Follow corners from a guess, and back; return pixels (n, 2), and a mask of good ones (n,)."""
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    options: Any = {
        "winSize": (window, window),
        "maxLevel": levels,
        "criteria": FLOW_CRITERIA,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    there, arrived, _ = cv2.calcOpticalFlowPyrLK(
        image, other, start, guess.astype(np.float32).reshape(-1, 1, 2), **options
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, start.copy(), **options)
    miss = np.abs(back - start).reshape(-1, 2).max(axis=1)
    points = there.reshape(-1, 2).astype(np.float64)
    good = (arrived.ravel() == 1) & (returned.ravel() == 1) & (miss < _ROUND_TRIP)
    return points, good & inside(points, image.shape, 3)


REACH = 6  # radius of continuous surface required around a corner by optical flow, pixels
NEAREST = 0.05  # least depth, metres; smaller values are ignored, as of dirt on the lens
_FARTHEST = 0.02  # 1/m: beyond 50 m depth says nothing about a motion of metres
_HOLE = -200.0  # placeholder for no depth, 1/m: so low, a smoothed neighbour stays below zero
_TORN = 0.02  # largest deviation of a neighbourhood from a plane, relative to inverse depth
_NOISY = 2.0  # the same, in standard deviations of a reading
_GRID = np.array([(x, y) for y in range(-REACH, REACH + 1, 3) for x in range(-REACH, REACH + 1, 3)])
_SPREAD = float((_GRID[:, 0] ** 2).sum())


class Surfaces(msgspec.Struct, frozen=True, eq=False):
    """The planes around some pixels."""

    inverse: Floats  # inverse depth at each, 1/m, shape (n,)
    slope: Floats  # its change by column and by row, 1/m, shape (n, 2)
    continuous: npt.NDArray[np.bool_]  # mask, shape (n,): elsewhere depth is torn or missing

    def take(self, rows: npt.NDArray[np.bool_]) -> Surfaces:
        """Return some of them."""
        return Surfaces(self.inverse[rows], self.slope[rows], self.continuous[rows])


def inverse_depth(depth: Depth) -> Depth:
    """Return inverse depth in 1/m, the mean of 3×3 pixels; below zero by holes, shape (h, w)."""
    with np.errstate(divide="ignore"):
        inverse = np.reciprocal(depth)
    unknown = ~((depth > NEAREST) & (depth < np.inf))
    if unknown.any():
        inverse[unknown] = _HOLE
    return np.asarray(cv2.blur(inverse, (3, 3)))


def surfaces_at(
    inverse: Depth,  # as of `inverse_depth`, shape (h, w)
    pixels: Floats,  # column and row, shape (n, 2)
    noise: float,  # standard deviation of one pixel's inverse depth, 1/m
) -> Surfaces:
    """Fit a plane to inverse depth around each pixel."""
    height, width = inverse.shape
    centre = np.rint(pixels).astype(int)
    columns = np.clip(centre[:, 0, None] + _GRID[:, 0], 0, width - 1)
    rows = np.clip(centre[:, 1, None] + _GRID[:, 1], 0, height - 1)
    around = inverse[rows, columns].astype(np.float64)
    mean = around.mean(axis=1)
    slope = around @ _GRID / _SPREAD
    bend = np.abs(around - mean[:, None] - slope @ _GRID.T).max(axis=1)
    continuous = (around.min(axis=1) > 0) & (bend < np.maximum(_TORN * mean, _NOISY * noise))
    value = mean + ((pixels - centre) * slope).sum(axis=1)
    continuous &= value > _FARTHEST
    return Surfaces(np.where(continuous, value, 0.0), slope, continuous)


_HUBER = 2.0  # Huber threshold of a residual, standard deviations
_STEPS = 8
_SMALL = 1e-7
_DAMPING = 1e-9  # damping of each motion, relative to its own information


def solve_pose(
    landmarks: Floats,  # metres in the world, shape (n, 3), n > 3 (or less with `information`)
    pixels: Floats,  # theirs: column and row, shape (n, 2)
    start: Floats,  # initial pose, world to camera, shape (4, 4)
    matrix: Floats,  # K, shape (3, 3)
    pixel_noise: float,  # standard deviation of a coordinate, pixels
    read: Surfaces | None = None,  # their inverse depth, where measured
    depth_noise: float = 1.0,  # standard deviation of inverse depth, 1/m
    information: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Return the pose with the least sum of robust squared residuals.

    Args:
        information: Inverse covariance of the initial pose, if known: of a small motion of the
            camera's frame, translation, then rotation, shape (6, 6).

    Returns:
        World to camera, shape (4, 4), and the landmarks' reprojection errors in standard
        deviations, shape (n,).
    """
    fx, fy, cx, cy = intrinsics(matrix)
    pose, count = start.copy(), len(pixels)
    # In rows of contiguous memory: coordinates, and derivatives of each by the six motions.
    landmarks = np.ascontiguousarray(landmarks.T)
    target, scale = np.zeros((3, count)), np.zeros((3, count))
    target[0], target[1] = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    scale[0], scale[1] = fx / pixel_noise, fy / pixel_noise
    if read is not None:
        target[2], scale[2] = read.inverse, read.continuous / depth_noise
    jacobian = np.zeros((6, 3, count))
    image, errors = np.empty((3, count)), np.empty((2, count))
    for _ in range(_STEPS):
        p = pose[:3, :3] @ landmarks + pose[:3, 3:]
        ahead = p[2] > 0.01
        image[2] = 1.0 / np.where(ahead, p[2], 1.0)
        image[:2] = p[:2] * image[2]
        residuals = scale * (image - target)
        # By a small motion of the camera's frame: translation, then rotation (left perturbation).
        (x, y, inverse), by = image, jacobian
        by[0, 0] = by[1, 1] = inverse
        np.multiply(image, -inverse, out=by[2])
        by[4, 1] = x * y
        by[3, 0] = -by[4, 1]
        by[3, 1], by[4, 0] = -1.0 - y * y, 1.0 + x * x
        by[3, 2], by[4, 2] = -y * inverse, x * inverse
        by[5, 0], by[5, 1] = -y, x
        by *= scale
        np.hypot(residuals[0], residuals[1], out=errors[0])
        np.abs(residuals[2], out=errors[1])
        weights = huber(errors, _HUBER) * ahead
        weighted = (by * weights[[0, 0, 1]]).reshape(6, -1)
        normal = weighted @ by.reshape(6, -1).T
        # In units of its own, as what landmarks in one column leave open is lost in rounding else.
        normal += np.diag(_DAMPING * np.diag(normal) + _DAMPING)
        gradient = weighted @ residuals.reshape(-1)
        if information is not None:
            normal += information
            gradient += information @ motion_between(start, pose)
        step = -np.linalg.solve(normal, gradient)
        pose = moved(pose, step)
        if np.abs(step).max() < _SMALL:
            break
    errors[0, ~ahead] = np.inf
    return pose, errors[0]


def moved(pose: Floats, step: Floats) -> Floats:
    """Return a pose, world to camera, after a small motion of the camera's frame, shape (6,)."""
    turn = cv2.Rodrigues(step[3:])[0]
    return transform(turn @ pose[:3, :3], turn @ pose[:3, 3] + step[:3])


def motion_between(before: Floats, after: Floats) -> Floats:
    """Return the small motion from a pose to another, as taken by `moved`, shape (6,)."""
    between = after @ inverse(before)
    return np.concatenate([between[:3, 3], cv2.Rodrigues(between[:3, :3])[0].ravel()])


def huber(errors: Floats, threshold: float) -> Floats:
    """Return Huber's weights of errors, both of one shape."""
    return np.asarray(threshold / np.maximum(errors, threshold))


def intrinsics(matrix: Floats) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of K, shape (3, 3)."""
    return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]


def rays(pixels: Floats, matrix: Floats) -> Floats:
    """Return directions in the optical frame with z = 1, shape (n, 3), of pixels, shape (n, 2)."""
    fx, fy, cx, cy = intrinsics(matrix)
    return np.stack(
        [(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1
    )


def transform(rotation: npt.NDArray[Any], translation: npt.NDArray[Any]) -> Floats:
    """Return the transform, shape (4, 4), of a rotation, shape (3, 3), and a translation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    return pose


Descriptors = npt.NDArray[np.uint8]

_MAX_ERROR = 3.0  # largest error of a point in the found pose, pixels
_MIN_INLIERS = 15  # least number of agreeing points; a pose from fewer may be chance
_RADIUS = 15  # radius of the patch for a corner's orientation, pixels, as in ORB


class DescribedPoints(msgspec.Struct, frozen=True, eq=False):
    """World points with their descriptors."""

    points: Floats  # metres (or the map's unit) in the world, shape (n, 3)
    descriptors: Descriptors  # uint8, shape (n, 32)


def detect_and_describe(image: Grey, count: int) -> tuple[Floats, Descriptors]:
    """Return up to `count` points of an image (column, row), shape (n, 2), and descriptors."""
    no_mask: Any = None
    descriptors: Any  # there are none in a blank image
    keys, descriptors = cv2.ORB.create(count).detectAndCompute(image, no_mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([key.pt for key in keys], np.float64), descriptors


def describe(image: Grey, pixels: Floats, points: Floats) -> DescribedPoints:
    """Return points (n, 3) with descriptors at pixels (n, 2); without those near to the edge."""
    # For given points ORB does not compute the orientation, as it does for those that it detects.
    keys = [
        cv2.KeyPoint(float(x), float(y), 31.0, float(angle), class_id=row)
        for row, ((x, y), angle) in enumerate(
            zip(pixels, _orientations(image, pixels), strict=True)
        )
    ]
    descriptors: Any  # there are none if all are near to the edge
    kept, descriptors = cv2.ORB.create().compute(image, keys)
    if descriptors is None:
        return DescribedPoints(np.empty((0, 3)), np.empty((0, 32), np.uint8))
    return DescribedPoints(points[[key.class_id for key in kept]], descriptors)


def relocalize(
    pixels: Floats,  # points of the image, as of `detect_and_describe`, shape (n, 2)
    descriptors: Descriptors,  # theirs, shape (n, 32)
    known: DescribedPoints,
    matrix: Floats,  # K, shape (3, 3)
    method: int = cv2.SOLVEPNP_ITERATIVE,  # OpenCV's solver of a pose from points
) -> Floats | None:
    """Return an image's pose by known points, world to camera; `None` if not found."""
    if min(len(pixels), len(known.points)) < _MIN_INLIERS:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(known.descriptors, descriptors)
    if len(matches) < _MIN_INLIERS:
        return None
    cv2.setRNGSeed(1)
    inliers: Any  # there are none if nothing was found
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        known.points[[match.queryIdx for match in matches]],
        pixels[[match.trainIdx for match in matches]],
        matrix,
        None,
        iterationsCount=300,
        reprojectionError=_MAX_ERROR,
        flags=method,
    )
    if not solved or inliers is None or len(inliers) < _MIN_INLIERS:
        return None
    return transform(cv2.Rodrigues(rotation)[0], translation)


def _orientations(image: Grey, pixels: Floats) -> Floats:
    """Return corners' directions to their intensity centroids ("ORB", section 3.2), degrees."""
    side = np.arange(-_RADIUS, _RADIUS + 1)
    dx, dy = (axis.ravel() for axis in np.meshgrid(side, side))
    disc = dx**2 + dy**2 <= _RADIUS**2
    dx, dy = dx[disc], dy[disc]
    columns, rows = np.rint(pixels).astype(np.int64).T
    x = np.clip(columns[:, None] + dx, 0, image.shape[1] - 1)
    y = np.clip(rows[:, None] + dy, 0, image.shape[0] - 1)
    weights = image[y, x].astype(np.float64)
    return np.asarray(np.degrees(np.arctan2(weights @ dy, weights @ dx)) % 360.0)
