"""Error-state Kalman filter of a body with an IMU, and a camera with a map.

The state is orientation, position and velocity of the IMU, the biases of gyroscope and
accelerometer, and the direction of gravity, on the sphere, as in W. Xu, Y. Cai, D. He, J. Lin and
F. Zhang, "FAST-LIO2", IEEE T-RO 2022: the world is the first camera, which need not be level, and a
flight may begin in motion. Poses of the key frames in which landmarks were first seen are
considered, not estimated: uncertainty grows with the length of the trajectory, and shrinks when the
camera comes back to an old key frame (P. Geneva, J. Maley and G. Huang, "An efficient Schmidt-EKF
for 3D visual-inertial SLAM", CVPR 2019).
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events.covariance import cross_matrix
from events.geometry import inverse
from nodes.estimators.inertial_odometry.preintegration import (
    Floats,
    ImuModel,
    Preintegrated,
)
from nodes.estimators.pose import huber
from nodes.estimators.rig import crosses

THETA, P, V, BG, BA = (slice(at, at + 3) for at in range(0, 15, 3))  # slices of the error state
G = slice(15, 17)  # slice of gravity's direction: small rotations about the two level axes
POSE = slice(0, 6)
_FRAME = 7  # states considered of a key frame: pose, and mean error of its inverse depths, 1/m
_SIZE = 17
GRAVITY = 9.81
_SPEED = 3.0  # standard deviation of the unknown velocity at the start, m/s
_TILT = 0.35  # standard deviation of gravity's first direction, rad: that of 3.5 m/s²
_NO_TILT = 1.5  # the same without samples
_UNSTATED = np.array([0.01, 0.1])  # standard deviations of unannounced biases: rad/s, m/s²
_STEPS = 2
_HUBER = 2.0
_FLOOR = 1e-3  # pose error accepted as no surprise: metres, radians
_IMPLAUSIBLE = 60.0  # largest squared Mahalanobis distance (6 degrees of freedom) of a pose
_AHEAD = 0.8  # least share of a sighting's landmarks ahead of the camera in each step
_BESIDE = 2  # images remembered beside the key frames, numbered -1 and -2
_ORIGIN = 2e-4  # standard deviation of the first pose, m, rad: the camera is the world
_VAGUE = 0.1  # standard deviation of a key frame's pose without landmarks: metres, radians
Measurement = Callable[["State"], tuple[Floats, Floats] | None]
"""Returns Λ and Aᵀr about a state, by its pose and by those of key frames; `None`: impossible."""


class State(msgspec.Struct, frozen=True, eq=False):
    """Estimated state."""

    rotation: Floats  # from the IMU to the world, shape (3, 3)
    position: Floats  # of the IMU in the world, metres, shape (3,)
    velocity: Floats  # in the world, m/s, shape (3,)
    bias: Floats  # of gyroscope (rad/s) and accelerometer (m/s²), shape (6,)
    level: Floats  # from a level frame, whose third axis is down, to the world, shape (3, 3)

    @property
    def gravity(self) -> Floats:
        """Gravity in the world, m/s², shape (3,)."""
        return np.asarray(GRAVITY * self.level[:, 2])

    def moved(self, error: Floats) -> State:
        """Return the state changed by an error, shape (17,)."""
        return State(
            self.rotation @ Rotation.from_rotvec(error[THETA]).as_matrix(),
            self.position + error[P],
            self.velocity + error[V],
            self.bias + error[BG.start : BA.stop],
            self.level @ Rotation.from_rotvec([*error[G], 0.0]).as_matrix(),
        )


class Sighting(msgspec.Struct, frozen=True, eq=False):
    """Landmarks seen in a single image."""

    places: Floats  # metres in the world, shape (n, 3)
    # Number of the key frame that each was first seen in, shape (n,).
    keyframes: npt.NDArray[np.int64]
    measured: Floats  # x/z, y/z and 1/z in the camera, shape (n, 3)
    scale: Floats  # one by their standard deviations; 0 where nothing was measured, shape (n, 3)


class InertialFilter:
    """Estimator of an IMU's state.

    Args:
        camera: The optical camera in the IMU's frame, shape (4, 4).
        capacity: Number of remembered key frames.
        common: Shares of variance common to all landmarks in one image, of sightings and of places:
            many landmarks add up to its inverse at most.
    """

    def __init__(
        self, imu: ImuModel, camera: Floats, capacity: int, common: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._imu, self.camera, self._common = imu, camera, common
        self._capacity = capacity
        in_camera = inverse(camera)
        zeros = np.zeros(3)
        self.state = State(in_camera[:3, :3], in_camera[:3, 3], zeros, np.zeros(6), _level(zeros))
        self.covariance = np.zeros((_SIZE, _SIZE))  # of the state's error, shape (17, 17)
        self.forget()

    def start(self, force: Floats, pose: Floats | None = None) -> None:
        """Start at an image, with gravity against the specific force, if not zero.

        Args:
            force: Mean specific force, m/s², shape (3,).
            pose: The camera in the world, shape (4, 4); if `None`, the camera is the world.
        """
        body = inverse(self.camera) if pose is None else pose @ inverse(self.camera)
        bias = np.where(self._imu.turn_on > 0, self._imu.turn_on, _UNSTATED)
        tilt = _TILT if np.linalg.norm(force) > 0 else _NO_TILT
        deviations = np.repeat([_ORIGIN, _ORIGIN, _SPEED, *bias, tilt], 3)[:_SIZE]
        self.covariance = np.diag(np.square(deviations))
        self._cross_covariance[:] = 0.0
        self.state = State(
            body[:3, :3], body[:3, 3], np.zeros(3), np.zeros(6), _level(-body[:3, :3] @ force)
        )

    def forget(self) -> None:
        """Remove all key frames, for a new map."""
        capacity = _FRAME * (self._capacity + _BESIDE)
        self._frames: dict[int, tuple[Floats, Floats]] = {}
        self._cross_covariance = np.zeros((_SIZE, capacity))
        self._frame_covariance = np.zeros((capacity, capacity))

    def remember(self, number: int, placed: Sighting | None = None, deviation: float = 0.0) -> None:
        """Store the present pose as a key frame's.

        Args:
            number: That of the newest one; or below zero, for an image beside them.
            placed: Its new landmarks, with the lasting noise of their places.
            deviation: Standard deviation of an error common to their inverse depths, 1/m.
        """
        at = int(self._slots(np.array([number]))[0])
        self._frames.pop(number - self._capacity, None)
        self._frames[number] = self.state.rotation, self.state.position
        pose, depth = slice(at, at + 6), at + 6
        self._frame_covariance[pose] = self._cross_covariance[POSE]
        self._frame_covariance[:, pose] = self._cross_covariance[POSE].T
        self._frame_covariance[pose, pose] = self.covariance[POSE, POSE]
        self._frame_covariance[depth], self._frame_covariance[:, depth] = 0.0, 0.0
        if placed is not None and len(placed.places):
            group, numbers = np.zeros(len(placed.places), np.intp), np.array([number])
            equations = self._by_landmarks(self.state, placed, group, numbers)
            information = np.zeros((6, 6)) if equations is None else equations[0][POSE, POSE]
            shared = 1.0 + self._common[1] * (len(placed.places) - 1)
            self._frame_covariance[pose, pose] += np.linalg.inv(
                information / shared + np.eye(6) / _VAGUE**2
            )
            self._frame_covariance[depth, depth] = (
                shared / (placed.scale[:, 2] ** 2).sum() + deviation**2
            )
        self._cross_covariance[:, pose] = self.covariance[:, POSE]
        self._cross_covariance[:, depth] = 0.0

    def propagate(self, motion: Preintegrated) -> None:
        """Propagate the state by an IMU motion, with the present biases."""
        state, t = self.state, motion.seconds
        turn = np.kron(np.eye(3), state.rotation)
        turn[:3, :3] = np.eye(3)
        change = np.eye(_SIZE)
        change[THETA, THETA] = motion.rotation.T
        change[V, THETA] = -state.rotation @ cross_matrix(motion.velocity)
        change[P, THETA] = -state.rotation @ cross_matrix(motion.position)
        fall = GRAVITY * np.stack([-state.level[:, 1], state.level[:, 0]], axis=1)
        change[P, V], change[V, G], change[P, G] = np.eye(3) * t, fall * t, fall * (t * t / 2)
        order = np.r_[THETA, V, P]
        change[order[:, None], np.arange(BG.start, BA.stop)] = turn @ motion.by_bias
        self.covariance = change @ self.covariance @ change.T
        self.covariance[np.ix_(order, order)] += turn @ motion.covariance @ turn.T
        walk = np.repeat(self._imu.walk**2 * t, 3)
        self.covariance[np.arange(9, 15), np.arange(9, 15)] += walk
        self._cross_covariance = change @ self._cross_covariance
        self.state = State(
            state.rotation @ motion.rotation,
            state.position
            + state.velocity * t
            + state.gravity * (t * t / 2)
            + state.rotation @ motion.position,
            state.velocity + state.gravity * t + state.rotation @ motion.velocity,
            state.bias,
            state.level,
        )

    def update(self, sighting: Sighting) -> bool:
        """Update by the landmarks of an image; return False, changing nothing, if contradictory."""
        numbers, group = np.unique(sighting.keyframes, return_inverse=True)
        return self._correct(
            numbers, lambda state: self._by_landmarks(state, sighting, group, numbers)
        )

    def misfit(self, sighting: Sighting) -> float:
        """Return by how much half of the landmarks miss their pixels, in standard deviations."""
        *_, image = self._image(self.state, sighting)
        return float(np.median(np.hypot(*((sighting.measured - image) * sighting.scale)[:, :2].T)))

    def update_pose(self, camera: Floats, number: int, information: Floats, first: bool) -> bool:
        """Update by an image's pose from a key frame; return False if contradictory.

        Half of such a pose's error is the key frame's, which is the same in all images.

        Args:
            camera: The camera in the world if the key frame is where it was remembered, (4, 4).
            information: Inverse covariance of a small motion of the camera's frame, as of `moved`
                in `nodes.estimators.odometry`, shape (6, 6).
            first: Whether this is the first pose by that key frame.
        """
        body = camera @ inverse(self.camera)
        rotation, position = self._frames[number]
        relative = rotation.T @ body[:3, :3], rotation.T @ (body[:3, 3] - position)
        by = np.zeros((6, 6 + _FRAME))
        by[:, :6] = np.eye(6)
        by[:3, 6:9], by[3:, 6:9] = -relative[0].T, rotation @ cross_matrix(relative[1])
        by[3:, 9:12] = -np.eye(3)
        mounted = self.camera[:3, :3].T
        small = np.zeros((6, 6))
        small[:3, :3], small[:3, 3:] = mounted @ cross_matrix(self.camera[:3, 3]), -camera[:3, :3].T
        small[3:, :3] = -mounted
        body_information = small.T @ information @ small
        if first:
            slots = self._slots(np.array([number]))[POSE]
            lasting = np.linalg.inv(body_information + np.eye(6) / _VAGUE**2)
            self._frame_covariance[np.ix_(slots, slots)] += lasting
        weighted = by.T @ body_information

        def measure(state: State) -> tuple[Floats, Floats]:
            turn = Rotation.from_matrix(state.rotation.T @ body[:3, :3]).as_rotvec()
            return weighted @ by, weighted @ np.concatenate([turn, body[:3, 3] - state.position])

        return self._correct(np.array([number]), measure)

    def _correct(self, numbers: npt.NDArray[np.int64], measure: Measurement) -> bool:
        """Update by a measurement relative to key frames, unless contradictory.

        Iterated Kalman update: with the measurements' information Λ and the covariance M of the
        poses concerned, gain and covariance need (I + ΛM)⁻¹ only. Steps are gated on the
        innovation, of covariance ΛMΛ + Λ, with the correlations of state and key frames.
        """
        slots = self._slots(numbers)
        # Covariances of the poses concerned with themselves, and of the state with these.
        across = self._cross_covariance[:, slots]
        concerned = np.block(
            [
                [self.covariance[POSE, POSE], across[POSE]],
                [across[POSE].T, self._frame_covariance[np.ix_(slots, slots)]],
            ]
        )
        state_with = np.hstack([self.covariance[:, POSE], across])
        state, error = self.state, np.zeros(_SIZE)
        for _ in range(_STEPS):
            measured = measure(state)
            if measured is None:
                return False
            information, vector = measured
            vector = vector + information[:, POSE] @ error[POSE]
            by_pose = information[POSE]
            spread = by_pose @ concerned @ by_pose.T + by_pose[:, POSE]
            spread += _FLOOR**2 * by_pose[:, POSE] @ by_pose[:, POSE]
            distance = vector[POSE] @ np.linalg.pinv(spread, 1e-12, hermitian=True) @ vector[POSE]
            if not distance < _IMPLAUSIBLE:
                return False
            right_side = np.column_stack([vector, information])
            solved = np.linalg.solve(np.eye(len(vector)) + information @ concerned, right_side)
            error = state_with @ solved[:, 0]
            state = self.state.moved(error)
        self.state = state
        gain = state_with @ ((solved[:, 1:] + solved[:, 1:].T) / 2)
        with_frames = np.vstack([self._cross_covariance[POSE], self._frame_covariance[slots]])
        self.covariance = self.covariance - gain @ state_with.T
        self._cross_covariance = self._cross_covariance - gain @ with_frames
        return True

    def _slots(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the rows of key frames in the covariance, shape (7 n,)."""
        place = np.where(numbers < 0, self._capacity - 1 - numbers, numbers % self._capacity)
        return np.asarray((_FRAME * place[:, None] + np.arange(_FRAME)).ravel())

    def _by_landmarks(
        self,
        state: State,
        sighting: Sighting,
        group: npt.NDArray[np.intp],
        numbers: npt.NDArray[np.int64],
    ) -> tuple[Floats, Floats] | None:
        in_body, ahead, image = self._image(state, sighting)
        if ahead.mean() < _AHEAD:
            return None
        inverse = image[:, 2]
        residual = (sighting.measured - image) * sighting.scale
        size = np.abs(residual)
        size[:, :2] = np.hypot(residual[:, 0], residual[:, 1])[:, None]
        weight = np.sqrt(huber(size, _HUBER)) * ahead[:, None]
        by_point = np.zeros((len(image), 3, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = inverse
        by_point[:, :, 2] = -image * inverse[:, None]
        by_body = (by_point * (weight * sighting.scale)[:, :, None]) @ self.camera[:3, :3].T
        by_world = by_body @ state.rotation.T
        frames = [self._frames[number] for number in numbers.tolist()]
        rotations = np.array([rotation for rotation, _ in frames])[group]
        positions = np.array([position for _, position in frames])[group]
        arms = np.einsum("nji,nj->ni", rotations, sighting.places - positions)
        by_pose = np.dstack([by_body @ crosses(in_body), -by_world])
        matrix = np.zeros((len(image), 3, len(numbers), _FRAME))
        rows, by_arm = np.arange(len(image)), by_world @ rotations
        matrix[rows, :, group, :3] = -by_arm @ crosses(arms)
        matrix[rows, :, group, 3:6] = by_world
        # A landmark moves along its first ray by its distance, times its depth there.
        ray = arms - self.camera[:3, 3]
        derivative = -ray * (ray @ self.camera[:3, 2:3])
        matrix[rows, :, group, 6] = np.einsum("nij,nj->ni", by_arm, derivative)
        flat = np.concatenate([by_pose, matrix.reshape(len(image), 3, -1)], axis=2)
        flat = flat.reshape(3 * len(image), -1)
        share = 1.0 / (1.0 + self._common[0] * (len(image) - 1))
        return share * (flat.T @ flat), share * (flat.T @ (weight * residual).ravel())

    def _image(
        self, state: State, sighting: Sighting
    ) -> tuple[Floats, npt.NDArray[np.bool_], Floats]:
        """Return landmarks in the IMU's frame, a mask of those ahead, expected values."""
        in_body = (sighting.places - state.position) @ state.rotation
        x, y, z = ((in_body - self.camera[:3, 3]) @ self.camera[:3, :3]).T
        ahead = z > 0.05
        inverse = 1.0 / np.where(ahead, z, 1.0)
        return in_body, ahead, np.stack([x * inverse, y * inverse, inverse], axis=1)


def _level(down: Floats) -> Floats:
    """Return axes with a given third axis, (0, 1, 0) for a zero vector; shape (3, 3)."""
    length = float(np.linalg.norm(down))
    down = down / length if length > 0 else np.array([0.0, 1.0, 0.0])
    across = np.cross(down, np.eye(3)[np.abs(down).argmin()])
    across /= np.linalg.norm(across)
    return np.column_stack([across, np.cross(down, across), down])
