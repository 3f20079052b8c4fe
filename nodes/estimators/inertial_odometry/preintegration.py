"""IMU preintegration, and its use for rolling shutter correction.

Source: C. Forster, L. Carlone, F. Dellaert and D. Scaramuzza, "On-manifold preintegration for
real-time visual-inertial odometry", IEEE T-RO 2017, equations 33 to 48; rotation, velocity and
position here stand in this order. Rates are those in the middle of two samples. Row v of h rows is
exposed at ``readout · (v / (h - 1) - 1/2)`` after the middle one (see `events.CameraAnnouncement`).
A point p of the camera at the middle row is at ``p - t (v + ω × p)`` in the camera at t: so far the
image is shifted back, where depth is known.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import CameraInfo, ImuAnnouncement
from events.covariance import cross_matrix
from events.geometry import pose_matrix
from nodes.estimators.images import Depth
from nodes.estimators.pose import rays

Floats = npt.NDArray[np.float64]

# Share of a vibration that counts as white noise: what shakes goes nowhere, unlike noise.
_SHAKEN = 0.3
_TURNED = 0.03  # vibration of the angular velocity by that of the acceleration, rad/s per m/s²
_GAP = 3.0  # sampling intervals; the motion in a longer gap between samples is unknown
_UNKNOWN = np.array([1.0, 5.0])  # standard deviations then: of rates (rad/s), acceleration


class Preintegrated(msgspec.Struct, frozen=True, eq=False):
    """Preintegrated IMU motion, without gravity and initial velocity."""

    seconds: float
    rotation: Floats  # the frame at the end in that at the start, shape (3, 3)
    velocity: Floats  # change of velocity in the frame at the start, m/s, shape (3,)
    position: Floats  # change of position in the frame at the start, metres, shape (3,)
    # Derivatives of the three (of the rotation: of a small one at its end) by the biases of
    # gyroscope and accelerometer, shape (9, 6).
    by_bias: Floats
    covariance: Floats  # of the three, shape (9, 9)


class ImuModel:
    """IMU parameters for the filter, from an announcement."""

    def __init__(self, imu: ImuAnnouncement) -> None:
        # The IMU in the frame of its parent, shape (4, 4).
        self.pose = pose_matrix(imu.position, imu.orientation)
        self.interval = 1.0 / imu.rate  # seconds between two samples
        shaken = _SHAKEN * imu.vibration * np.sqrt(self.interval)
        accelerometer = np.hypot(imu.accelerometer_noise_density, shaken)
        gyroscope = np.hypot(imu.gyroscope_noise_density, _TURNED * shaken)
        # Samples of a moving body are also samples of what happens between them.
        # Densities of the noise of gyroscope and accelerometer, shape (2,).
        self.noise = 2.0 * np.array([gyroscope, accelerometer]) + (1e-5, 1e-4)
        # Densities of the random walks of their biases, shape (2,).
        self.walk = np.array([imu.gyroscope_random_walk, imu.accelerometer_random_walk]) + 1e-6
        # Standard deviations of their biases at the start, shape (2,).
        self.turn_on = np.array([imu.gyroscope_turn_on_bias, imu.accelerometer_turn_on_bias])
        self._averaged = imu.averaged
        self._undo = [
            np.linalg.inv(np.reshape(matrix, (3, 3)))
            for matrix in (imu.gyroscope_matrix, imu.accelerometer_matrix)
        ]

    def corrected(self, samples: Floats) -> Floats:
        """Return samples (s, rad/s, m/s²; (n, 7)) without announced scale and misalignment."""
        turn, force = (
            s @ u.T for s, u in zip((samples[:, 1:4], samples[:, 4:]), self._undo, strict=True)
        )
        return np.hstack([samples[:, :1], turn, force])

    def at(self, samples: Floats, times: Floats) -> Floats:
        """Return samples (m, 7) at times (s, (m,)), interpolated or held, of `corrected` ones."""
        if self._averaged:
            rows = np.searchsorted(samples[:, 0], times).clip(max=len(samples) - 1)
            return np.column_stack([times, samples[rows, 1:]])
        columns = (np.interp(times, samples[:, 0], column) for column in samples[:, 1:].T)
        return np.column_stack([times, *columns])

    def preintegrate(
        self,
        samples: Floats,  # as of `corrected`, strictly rising in time, shape (n, 7), n > 1
        bias: Floats,  # of gyroscope and accelerometer, shape (6,)
    ) -> Preintegrated:
        """Return the motion from the first sample to the last."""
        steps = np.diff(samples[:, 0])
        means = samples[1:] if self._averaged else (samples[1:] + samples[:-1]) / 2
        rates = means[:, 1:] - bias
        turns = Rotation.from_rotvec(rates[:, :3] * steps[:, None]).as_matrix()
        halves = Rotation.from_rotvec(rates[:, :3] * (steps[:, None] / 2)).as_matrix()
        rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
        by_bias, covariance = np.zeros((9, 6)), np.zeros((9, 9))
        for dt, turn, half, force in zip(steps, turns, halves, rates[:, 3:], strict=True):
            middle = rotation @ half
            felt = middle @ force
            # Propagation of an error at the start of the step, and of an error of its rates.
            change = np.eye(9)
            change[:3, :3] = turn.T
            change[3:6, :3] = -rotation @ cross_matrix(half @ force) * dt
            change[6:, :3] = change[3:6, :3] * (dt / 2)
            change[6:, 3:6] = dt * np.eye(3)
            by_rates = np.zeros((9, 6))
            by_rates[:3, :3] = half.T * dt
            by_rates[3:6, :3] = -middle @ cross_matrix(force) * (dt * dt / 2)
            by_rates[3:6, 3:] = middle * dt
            by_rates[6:] = by_rates[3:6] * (dt / 2)
            by_bias = change @ by_bias - by_rates
            variance = self.noise**2 / dt
            if dt > _GAP * self.interval:
                variance = variance + _UNKNOWN**2
            covariance = (
                change @ covariance @ change.T + (by_rates * np.repeat(variance, 3)) @ by_rates.T
            )
            position = position + velocity * dt + felt * (dt * dt / 2)
            velocity = velocity + felt * dt
            rotation = rotation @ turn
        seconds = float(samples[-1, 0] - samples[0, 0])
        return Preintegrated(seconds, rotation, velocity, position, by_bias, covariance)


_STEP = 8  # spacing of the computed shifts, pixels


class Rows:
    """The shifts of an image's rows."""

    def __init__(
        self,
        info: CameraInfo,  # intrinsics, without distortion
        readout: float,  # seconds from the first row's exposure to the last row's
        turn: Floats,  # angular velocity of the camera in its own axes, rad/s, shape (3,)
        velocity: Floats,  # of the camera in its own axes, m/s, shape (3,)
    ) -> None:
        self._info, self._readout, self._turn, self._velocity = info, readout, turn, velocity
        columns, rows = (
            (np.arange(-(-size // _STEP)) + 0.5) * _STEP - 0.5 for size in (info.width, info.height)
        )
        self._pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        self._grid = len(rows), len(columns)
        self._at = np.rint(self._pixels).astype(int).clip(max=(info.width - 1, info.height - 1))

    def image(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return an image as taken by a global shutter, valid for distant things."""
        return self._moved(image, np.zeros(len(self._pixels)))[0]

    def image_and_depth(
        self, image: npt.NDArray[np.uint8], depth: Depth
    ) -> tuple[npt.NDArray[np.uint8], Depth]:
        """Return image and depth (metres, shape (h, w)) as taken by a global shutter."""
        sampled = depth[self._at[:, 1], self._at[:, 0]].astype(np.float64)
        valid = sampled > 0.1
        inverse = np.where(valid, 1.0 / np.where(valid, sampled, 1.0), 0.0)
        moved, (columns, rows), nearer = self._moved(image, inverse)
        shifted = cv2.remap(
            depth, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        return moved, np.asarray(shifted / nearer, np.float32)

    def _moved(
        self, image: npt.NDArray[np.uint8], inverse: Floats
    ) -> tuple[npt.NDArray[np.uint8], tuple[Depth, Depth], Depth]:
        info, middle = self._info, (self._info.height - 1) / 2
        straight = rays(self._pixels, info.matrix())
        motion = self._velocity * inverse[:, None] + np.cross(self._turn, straight)
        source, ahead = self._pixels, np.ones(len(inverse))
        for _ in range(2):  # a shifted pixel is in another row, so of another time
            time = self._readout * (source[:, 1:] - middle) / max(info.height - 1, 1)
            x, y, ahead = (straight - time * motion).T
            source = np.stack([info.fx * x / ahead + info.cx, info.fy * y / ahead + info.cy], 1)
        size = self._grid[1] * _STEP, self._grid[0] * _STEP
        shifts = np.column_stack([source - self._pixels, ahead]).astype(np.float32)
        large = cv2.resize(shifts.reshape(*self._grid, 3), size, interpolation=cv2.INTER_LINEAR)
        large = large[: info.height, : info.width]
        columns = large[..., 0] + np.arange(info.width, dtype=np.float32)
        rows = large[..., 1] + np.arange(info.height, dtype=np.float32)[:, None]
        maps = np.asarray(columns, np.float32), np.asarray(rows, np.float32)
        moved = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.uint8), maps, np.asarray(large[..., 2], np.float32)
