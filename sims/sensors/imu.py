"""An IMU: noise, bias, scale, range, steps and vibration on the true motion of its place."""

from __future__ import annotations

import math
from math import sqrt
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import ImuAnnouncement, Quaternion, Vector3
from events.frames import cross, inverse, multiply, rotate, rotate_inverse, slerp
from runtime.units import Duration
from sims.calibration import check_lists, chosen
from sims.presets import IMUS
from sims.sensors.bandwidth import LowPass
from sims.sensors.calibration import IMU_SIZES, USUAL_IMU, ImuCalibrationError
from sims.sensors.sensor import GaussMarkov, Mount, Mounted, NonNegative, Place, check_drift
from sims.sensors.vibration import Vibration, VibrationModel

_BLOCK = 512  # samples per draw: a numpy call costs as much as a few hundred random numbers

Floats = npt.NDArray[np.float64]


class ImuParameters(Mount, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors of an IMU, named as in `events.ImuAnnouncement`; by default the noise of a usual MEMS.

    Attributes:
        preset: Real sensor with its figures as defaults; keys beside it override them.
        rate: Samples, and ground truths, per second; 0: the vehicle's `imu_rate`.
        gyroscope_noise_density: White noise, rad/s/√Hz (AirSim: ``AngularRandomWalk``, in °/√h).
        gyroscope_random_walk: Random walk of its bias, rad/s²/√Hz (AirSim: ``GyroBiasStability`` /
            √``GyroBiasStabilityTau``).
        accelerometer_noise_density: White noise, m/s²/√Hz (AirSim: ``VelocityRandomWalk``, in
            mg/√Hz).
        accelerometer_random_walk: Random walk of its bias, m/s³/√Hz (AirSim: ``AccelBiasStability``
            / √``AccelBiasStabilityTau``).
        ideal: No errors at all, whatever the other settings say of them.
        gyroscope_turn_on_bias: Standard deviation of the bias at the start, rad/s.
        accelerometer_turn_on_bias: Standard deviation of the bias at the start, m/s².
        gyroscope_bias_instability: Standard deviation of a part of the bias that comes and goes, a
            first-order Gauss-Markov process, rad/s (IEEE Std 952-1997, annex B).
        accelerometer_bias_instability: The same of the accelerometer, m/s².
        bias_instability_time: Time constant of both.
        gyroscope_scale_error: Standard deviation of each axis' relative error of scale.
        accelerometer_scale_error: Standard deviation of each axis' relative error of scale.
        gyroscope_misalignment: Standard deviation of the axes' small angles, rad.
        accelerometer_misalignment: Standard deviation of the axes' small angles, rad.
        gyroscope_matrix: Scale and misalignment in place of drawn ones: 9 numbers, row by row.
        accelerometer_matrix: Scale and misalignment in place of drawn ones: 9 numbers, row by row.
        g_sensitivity: Angular velocity that an acceleration feigns, rad/s per m/s².
        gyroscope_range: Greatest angular velocity that it shows, rad/s; 0 is no limit.
        accelerometer_range: Greatest acceleration that it shows, m/s²; 0 is no limit.
        gyroscope_resolution: Step of the angular velocity, rad/s; 0 is none.
        accelerometer_resolution: Step of the acceleration, m/s²; 0 is none.
        gyroscope_bandwidth: Hz, above which motion is weakened, below half of the rate; all of it
            comes later by 0.225/bandwidth. 0: everything is felt at once.
        accelerometer_bandwidth: The same of the accelerometer.
        vibration: Vibration by the rotors; none at rest.
        sampling: ``instant``: a sample is the motion at its stamp. ``mean``: it is the mean since
            the sample before, as of IMUs that give delta angles and delta velocities.
        calibration_error: Errors of what is announced: mounting, scale, misalignment; ``true`` for
            those of a good calibration. The samples are what they are.
    """

    preset: Annotated[str | None, msgspec.Meta(extra={"presets": IMUS})] = None
    rate: Annotated[float, msgspec.Meta(ge=0.0, le=1000.0)] = 0.0
    gyroscope_noise_density: NonNegative = 1.7e-4
    gyroscope_random_walk: NonNegative = 2e-5
    accelerometer_noise_density: NonNegative = 2e-3
    accelerometer_random_walk: NonNegative = 3e-3
    ideal: bool = False
    gyroscope_turn_on_bias: NonNegative = 0.0
    accelerometer_turn_on_bias: NonNegative = 0.0
    gyroscope_bias_instability: NonNegative = 0.0
    accelerometer_bias_instability: NonNegative = 0.0
    bias_instability_time: Duration = Duration(100.0)  # immutable
    gyroscope_scale_error: NonNegative = 0.0
    accelerometer_scale_error: NonNegative = 0.0
    gyroscope_misalignment: NonNegative = 0.0
    accelerometer_misalignment: NonNegative = 0.0
    gyroscope_matrix: tuple[float, ...] = ()
    accelerometer_matrix: tuple[float, ...] = ()
    g_sensitivity: NonNegative = 0.0
    gyroscope_range: NonNegative = 0.0
    accelerometer_range: NonNegative = 0.0
    gyroscope_resolution: NonNegative = 0.0
    accelerometer_resolution: NonNegative = 0.0
    gyroscope_bandwidth: NonNegative = 0.0
    accelerometer_bandwidth: NonNegative = 0.0
    vibration: Vibration = Vibration()
    sampling: Literal["instant", "mean"] = "instant"
    calibration_error: ImuCalibrationError | bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("gyroscope_matrix", "accelerometer_matrix"):
            if len(getattr(self, field)) not in (0, 9):
                count = len(getattr(self, field))
                raise ValueError(f"{field}: expected 9 numbers, row by row, found {count}")
        if self.gyroscope_bias_instability or self.accelerometer_bias_instability:
            check_drift(1.0, self.bias_instability_time, "bias_instability_time")
        if self.wrong is not None:
            check_lists(self.wrong, IMU_SIZES)

    @property
    def wrong(self) -> ImuCalibrationError | None:
        """Errors of the announced calibration; `None` if it is exact, as an ideal IMU's is."""
        return None if self.ideal else chosen(self.calibration_error, USUAL_IMU)

    @property
    def framed(self) -> bool:
        """Whether the IMU has a frame of its own: its announced pose is not the body's."""
        return self.mounted or (self.wrong is not None and self.wrong.of_mounting)

    @property
    def mounted(self) -> bool:
        """Whether the IMU's pose differs from the body's origin and axes."""
        return any(self.position) or any(self.orientation)


class ImuNoise:
    """Noise for true samples taken at a fixed rate.

    Truth + bias + white noise with the bias a random walk, sampled at intervals dt: standard
    deviation density/√dt for the noise and random_walk·√dt for each step of the bias (J. Crassidis,
    *Sigma-point Kalman filtering for integrated GPS and inertial navigation*, 2006; Kalibr's "IMU
    noise model").
    """

    def __init__(
        self,
        parameters: ImuParameters,
        rate: float,
        generator: np.random.Generator,
        bias: Floats | None = None,  # bias at the start: rad/s, then m/s², shape (6,)
        slow: np.random.Generator | None = None,  # of the bias instability; none without
    ) -> None:
        p = parameters
        parts = p.gyroscope_bias_instability, p.accelerometer_bias_instability
        self._instability = np.repeat(parts, 3)
        self._process = GaussMarkov(1.0, float(p.bias_instability_time), 1.0 / rate, 6)
        self._slow = slow
        densities = p.gyroscope_noise_density, p.accelerometer_noise_density
        walks = p.gyroscope_random_walk, p.accelerometer_random_walk
        root = sqrt(1.0 / rate)
        self._white = np.repeat([density / root for density in densities], 3)
        self._step = np.repeat([walk * root for walk in walks], 3)
        self._generator = generator
        self._bias = np.zeros(6) if bias is None else bias
        self._errors: list[list[float]] = []
        self._next = 0

    def add(self, angular_velocity: Vector3, specific_force: Vector3) -> tuple[Vector3, Vector3]:
        """Return the next sample of true angular velocity (rad/s) and specific force (m/s²)."""
        if self._next == len(self._errors):
            self._draw()
        ex, ey, ez, fx, fy, fz = self._errors[self._next]
        self._next += 1
        wx, wy, wz = angular_velocity
        ax, ay, az = specific_force
        return (wx + ex, wy + ey, wz + ez), (ax + fx, ay + fy, az + fz)

    def _draw(self) -> None:
        numbers = self._generator.standard_normal((_BLOCK, 12))
        bias = self._bias + np.cumsum(numbers[:, 6:] * self._step, axis=0)
        self._bias = bias[-1]
        errors = numbers[:, :6] * self._white + bias
        if self._slow is not None:
            for row in errors:
                row += self._instability * self._process.step(self._slow)
        self._errors = errors.tolist()
        self._next = 0


class ImuModel(Mounted[ImuParameters]):
    """Model of an IMU with all its errors: measurements from true motion.

    Args:
        noise: Source of the random numbers of its noise.
        constants: Source of what is drawn once: bias at the start, scale, misalignment, phases.
    """

    announced = ImuAnnouncement

    def __init__(
        self,
        parameters: ImuParameters,
        rate: float,
        noise: np.random.Generator,
        constants: np.random.Generator,
        place: Place,
    ) -> None:
        if parameters.ideal:
            silent: dict[str, Any] = dict.fromkeys(NOISES, 0.0)
            kept = {name: getattr(parameters, name) for name in _NO_ERRORS}
            parameters = ImuParameters(**silent, **kept)
        super().__init__(parameters, place)
        p = parameters
        self._rate = rate
        drawn = constants.standard_normal((2, 10))
        self.matrices = [
            _matrix(given, scale, angle, numbers[1:])
            for given, scale, angle, numbers in zip(
                (p.gyroscope_matrix, p.accelerometer_matrix),
                (p.gyroscope_scale_error, p.accelerometer_scale_error),
                (p.gyroscope_misalignment, p.accelerometer_misalignment),
                drawn,
                strict=True,
            )
        ]
        turn_on = np.repeat([p.gyroscope_turn_on_bias, p.accelerometer_turn_on_bias], 3)
        bias = turn_on * constants.standard_normal(6)
        self._vibration = VibrationModel(
            p.vibration, rate, p.sampling == "mean", inverse(p.rotation), constants
        )
        unstable = p.gyroscope_bias_instability or p.accelerometer_bias_instability
        slow = np.random.default_rng(constants.integers(2**63)) if unstable else None
        self._noise = ImuNoise(p, rate, noise, bias, slow)
        self._limits = [
            (p.gyroscope_range, p.gyroscope_resolution),
            (p.accelerometer_range, p.accelerometer_resolution),
        ]
        self._filters = [
            LowPass(bandwidth, rate) if bandwidth else None
            for bandwidth in (p.gyroscope_bandwidth, p.accelerometer_bandwidth)
        ]
        self._linear = not p.g_sensitivity and all(np.array_equal(m, _EYE) for m in self.matrices)

    def measure(
        self, angular_velocity: Vector3, specific_force: Vector3, thrusts: Any
    ) -> tuple[Vector3, Vector3]:
        """Return the next sample, of true rad/s, m/s² in its frame, and rotors' thrusts, 0 to 1."""
        rates, force = angular_velocity, specific_force
        if self._vibration:
            rates, force = self._vibration.add(rates, force, thrusts)
        slow_rates, slow_force = self._filters
        rates = slow_rates(rates) if slow_rates else rates
        force = slow_force(force) if slow_force else force
        if not self._linear:
            gyroscope, accelerometer = self.matrices
            # Not by matrix products, whose last bits are the processor's.
            turned = (gyroscope * rates).sum(axis=1) + self.spec.g_sensitivity * np.asarray(force)
            rates, force = _vector(turned), _vector((accelerometer * force).sum(axis=1))
        rates, force = self._noise.add(rates, force)
        return _limited(rates, *self._limits[0]), _limited(force, *self._limits[1])

    def also_announced(self) -> dict[str, Any]:
        """Return rate, vibration, drawn scale, and the body's frame if the IMU has none."""
        p = self.spec
        gyroscope, accelerometer = (tuple(matrix.ravel().tolist()) for matrix in self.matrices)
        return {
            "rate": self._rate,
            "gyroscope_matrix": gyroscope,
            "accelerometer_matrix": accelerometer,
            "vibration": p.vibration.announced(self._rate),
            "averaged": p.sampling == "mean",
            "frame_id": self.source if p.framed else self.place.parent_frame_id,
        }


class Motion(msgspec.Struct, frozen=True, gc=False):
    """How an IMU's place moves at an instant."""

    orientation: Quaternion  # rotation from the IMU's frame to NED
    velocity: Vector3  # metres per second NED


def motion_at(
    parameters: ImuParameters, orientation: Quaternion, velocity: Vector3, rates: Vector3
) -> Motion:
    """Return the motion of an IMU's place on a body.

    Args:
        orientation: Rotation from the body to NED.
        velocity: Of the body's origin, metres per second NED.
        rates: Angular velocity of the body, rad/s in its frame.
    """
    lever = rotate(orientation, cross(rates, parameters.position))
    x, y, z = (a + b for a, b in zip(velocity, lever, strict=True))
    return Motion(multiply(orientation, parameters.rotation), (x, y, z))


def mean_between(
    before: Motion, after: Motion, seconds: float, gravity: float
) -> tuple[Vector3, Vector3]:
    """Return mean angular velocity and specific force between two instants, in the IMU's frame.

    Constant angular velocity, and constant force in the frame halfway: integrated they give back
    the motion.
    """
    turn = multiply(inverse(before.orientation), after.orientation)
    w, *axis = turn if turn[0] >= 0.0 else tuple(-x for x in turn)
    sine = math.hypot(*axis)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    wx, wy, wz = (factor * x / seconds for x in axis)
    ax, ay, az = ((b - a) / seconds for a, b in zip(before.velocity, after.velocity, strict=True))
    halfway = slerp(before.orientation, after.orientation, 0.5)
    return (wx, wy, wz), rotate_inverse(halfway, (ax, ay, az - gravity))


NOISES = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)  # settings of the noise, all 0 of an ideal IMU

_EYE = np.eye(3)
_NO_ERRORS = ("sampling", "position", "orientation")  # settings kept for an ideal IMU


def _matrix(given: tuple[float, ...], scale: float, angle: float, numbers: Floats) -> Floats:
    """Return scale and misalignment: as given, or of 9 normal numbers."""
    if given:
        return np.array(given).reshape(3, 3)
    drawn = numbers.reshape(3, 3) * (angle * (1.0 - _EYE) + scale * _EYE)
    return np.asarray(_EYE + drawn)


def _limited(vector: Vector3, limit: float, step: float) -> Vector3:
    """Return a vector in whole steps, cut off at a limit; 0 is no limit or no step."""
    if step:
        x, y, z = (round(value / step) * step for value in vector)
        vector = (x, y, z)
    if limit:
        x, y, z = (min(max(value, -limit), limit) for value in vector)
        vector = (x, y, z)
    return vector


def _vector(array: Any) -> Vector3:
    x, y, z = array.tolist()
    return (x, y, z)
