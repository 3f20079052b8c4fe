"""An error-state Kalman filter of a body with an IMU and a camera that sees a map.

The state is orientation, position and velocity of the IMU, the biases of gyroscope and
accelerometer, and gravity, which is part of the state as in W. Xu and F. Zhang, "FAST-LIO", IEEE
RA-L 2021: the world is the first camera, which need not be level, and a flight may begin in motion.

Landmarks are where the key frames that saw them first were, and these are known as well as the
filter knew its own pose then. Their poses are states that are considered and not estimated: so the
uncertainty grows with the length of the way and not only with time, and shrinks when the camera
comes back to an old key frame. (S. F. Schmidt's filter; P. Geneva, J. Maley and G. Huang, "An
efficient Schmidt-EKF for 3D visual-inertial SLAM", CVPR 2019.)
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events.poses import inverse
from nodes.inertial_odometry.preintegration import Floats, ImuModel, Preintegrated, cross, crosses

THETA, P, V, BG, BA, G = (slice(at, at + 3) for at in range(0, 18, 3))
"""Where the errors stand; that of the orientation is a small rotation in the IMU's own frame."""
POSE = slice(0, 6)
_SIZE = 18
GRAVITY = 9.81
_SPEED = 3.0
"""Standard deviation of the unknown velocity at the start, m/s."""
_TILT = 2.0
"""Standard deviation of gravity as the first samples give it, m/s²: that of their acceleration."""
_LENGTH = 0.02
"""Standard deviation of the length of gravity, from place to place, m/s²."""
_UNSTATED = np.array([0.01, 0.1])
"""Standard deviations of biases of which nothing is announced: rad/s, m/s²."""
_STEPS = 2
_HUBER = 2.0
_FLOOR = 1e-3
"""Metres and radians by which a pose may be off without a surprise."""
_IMPLAUSIBLE = 60.0
"""Squared Mahalanobis distance (6 degrees of freedom) beyond which a map's pose is not believed."""


class State(msgspec.Struct, frozen=True, eq=False):
    """What is estimated.

    Attributes:
        rotation: From the IMU to the world, shape (3, 3).
        position: Of the IMU in the world, metres, shape (3,).
        velocity: In the world, m/s, shape (3,).
        bias: Of gyroscope (rad/s) and accelerometer (m/s²), shape (6,).
        gravity: In the world, m/s², shape (3,).
    """

    rotation: Floats
    position: Floats
    velocity: Floats
    bias: Floats
    gravity: Floats

    def moved(self, error: Floats) -> State:
        """Return the state that differs by an error, shape (18,)."""
        return State(
            self.rotation @ Rotation.from_rotvec(error[THETA]).as_matrix(),
            self.position + error[P],
            self.velocity + error[V],
            self.bias + error[BG.start : BA.stop],
            self.gravity + error[G],
        )

    def error_of(self, other: State) -> Floats:
        """Return by how much another state differs from this one, shape (18,)."""
        turn = Rotation.from_matrix(self.rotation.T @ other.rotation).as_rotvec()
        return np.concatenate(
            [
                turn,
                other.position - self.position,
                other.velocity - self.velocity,
                other.bias - self.bias,
                other.gravity - self.gravity,
            ]
        )


class Sighting(msgspec.Struct, frozen=True, eq=False):
    """Landmarks as one image shows them.

    Attributes:
        places: Metres in the world, shape (n, 3).
        keyframes: Number of the key frame that each was first seen in, shape (n,).
        measured: x/z, y/z and 1/z in the camera, shape (n, 3).
        scale: One by their standard deviations; 0 where nothing was measured, shape (n, 3).
    """

    places: Floats
    keyframes: npt.NDArray[np.int64]
    measured: Floats
    scale: Floats


class InertialFilter:
    """Estimates the state of an IMU.

    Args:
        imu: Its model.
        camera: The optical camera in the IMU's frame, shape (4, 4).
        capacity: Number of key frames that are remembered.

    Attributes:
        state: The estimate.
        covariance: Of the state's error, shape (18, 18).
    """

    def __init__(self, imu: ImuModel, camera: Floats, capacity: int) -> None:
        self._imu, self.camera = imu, camera
        self._capacity = capacity
        back = inverse(camera)
        none = np.zeros(3)
        self.state = State(back[:3, :3], back[:3, 3], none, np.zeros(6), none)
        self.covariance = np.zeros((_SIZE, _SIZE))
        self.forget()

    def start(self, force: Floats) -> None:
        """Begin at the first image, with gravity against the specific force, if not zero.

        The world is the camera at this image, so that its pose is known exactly. What is not known
        of velocity, gravity and biases is found from the first images, at rest or in motion.
        """
        felt, length = -self.state.rotation @ force, float(np.linalg.norm(force))
        direction = felt / max(length, 1e-9)
        bias = np.where(self._imu.turn_on > 0, self._imu.turn_on, _UNSTATED)
        deviations = [0.0, 0.0, _SPEED, *bias, _TILT if length > 0 else GRAVITY]
        self.covariance = np.diag(np.repeat(np.square(deviations), 3))
        self.state = msgspec.structs.replace(self.state, gravity=GRAVITY * direction)
        # The length of gravity is known, its direction is not.
        gain = self.covariance[G, G] @ direction
        gain /= direction @ gain + _LENGTH**2
        self.covariance[G, G] -= np.outer(gain, direction) @ self.covariance[G, G]

    def restart(self, camera: Floats) -> None:
        """Take over the pose of the camera in the world, shape (4, 4); begin the rest again."""
        pose = camera @ np.linalg.inv(self.camera)
        self.state = msgspec.structs.replace(
            self.state, rotation=pose[:3, :3], position=pose[:3, 3]
        )
        deviations = np.repeat([0.01, 0.02, _SPEED, *_UNSTATED, _TILT], 3)
        self.covariance = self.covariance + np.diag(deviations**2)

    def forget(self) -> None:
        """Forget all key frames: a new map begins."""
        capacity = 6 * self._capacity
        self._frames: dict[int, tuple[Floats, Floats]] = {}
        self._with_frames = np.zeros((_SIZE, capacity))
        self._of_frames = np.zeros((capacity, capacity))

    def remember(self, number: int) -> None:
        """Note the present pose as that of a key frame, the newest one."""
        at = 6 * (number % self._capacity)
        self._frames.pop(number - self._capacity, None)
        self._frames[number] = self.state.rotation, self.state.position
        here = slice(at, at + 6)
        self._of_frames[here] = self._with_frames[POSE]
        self._of_frames[:, here] = self._with_frames[POSE].T
        self._of_frames[here, here] = self.covariance[POSE, POSE]
        self._with_frames[:, here] = self.covariance[:, POSE]

    def propagate(self, motion: Preintegrated) -> None:
        """Let a motion pass that the IMU felt, with the biases of the present state."""
        state, t = self.state, motion.seconds
        turn = np.kron(np.eye(3), state.rotation)
        turn[:3, :3] = np.eye(3)
        change = np.eye(_SIZE)
        change[THETA, THETA] = motion.rotation.T
        change[V, THETA] = -state.rotation @ cross(motion.velocity)
        change[P, THETA] = -state.rotation @ cross(motion.position)
        change[P, V], change[V, G], change[P, G] = (np.eye(3) * k for k in (t, t, t * t / 2))
        order = np.r_[THETA, V, P]
        change[order[:, None], np.arange(BG.start, BA.stop)] = turn @ motion.by_bias
        self.covariance = change @ self.covariance @ change.T
        self.covariance[np.ix_(order, order)] += turn @ motion.covariance @ turn.T
        walk = np.repeat(self._imu.walk**2 * t, 3)
        self.covariance[np.arange(9, 15), np.arange(9, 15)] += walk
        self._with_frames = change @ self._with_frames
        self.state = State(
            state.rotation @ motion.rotation,
            state.position
            + state.velocity * t
            + state.gravity * (t * t / 2)
            + state.rotation @ motion.position,
            state.velocity + state.gravity * t + state.rotation @ motion.velocity,
            state.bias,
            state.gravity,
        )

    def update(self, seen: Sighting) -> bool:
        """Take in landmarks of an image; return False, changing nothing, if they contradict.

        Iterated Kalman update in the information form of the measurements: with their information
        Λ and the covariance M of the poses concerned, gain and covariance need (I + ΛM)⁻¹ only.
        """
        numbers, group = np.unique(seen.keyframes, return_inverse=True)
        slots = (6 * (numbers % self._capacity)[:, None] + np.arange(6)).ravel()
        # Covariances of the poses concerned with themselves, and of the state with these.
        across = self._with_frames[:, slots]
        concerned = np.block(
            [
                [self.covariance[POSE, POSE], across[POSE]],
                [across[POSE].T, self._of_frames[np.ix_(slots, slots)]],
            ]
        )
        state_with = np.hstack([self.covariance[:, POSE], across])
        prior, error = self.state, np.zeros(_SIZE)
        floor = self.covariance[POSE, POSE] + _FLOOR**2 * np.eye(6)
        for step in range(_STEPS):
            information, vector = self._information(self.state, seen, group, numbers)
            vector = vector + information[:, POSE] @ error[POSE]
            both = np.column_stack([vector, information])
            solved = np.linalg.solve(np.eye(len(vector)) + information @ concerned, both)
            error = state_with @ solved[:, 0]
            shift = error[POSE]
            if step == 0 and shift @ np.linalg.solve(floor, shift) > _IMPLAUSIBLE:
                return False
            self.state = prior.moved(error)
        gain = state_with @ ((solved[:, 1:] + solved[:, 1:].T) / 2)
        with_frames = np.vstack([self._with_frames[POSE], self._of_frames[slots]])
        self.covariance = self.covariance - gain @ state_with.T
        self._with_frames = self._with_frames - gain @ with_frames
        return True

    def _information(
        self,
        state: State,
        seen: Sighting,
        group: npt.NDArray[np.intp],
        numbers: npt.NDArray[np.int64],
    ) -> tuple[Floats, Floats]:
        """Return Λ and Aᵀr of landmarks about a state, by its pose and by those of key frames."""
        in_body = (seen.places - state.position) @ state.rotation
        x, y, z = ((in_body - self.camera[:3, 3]) @ self.camera[:3, :3]).T
        ahead = z > 0.05
        inverse = 1.0 / np.where(ahead, z, 1.0)
        image = np.stack([x * inverse, y * inverse, inverse], axis=1)
        residual = (seen.measured - image) * seen.scale
        size = np.abs(residual)
        size[:, :2] = np.hypot(residual[:, 0], residual[:, 1])[:, None]
        weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(size, _HUBER))) * ahead[:, None]
        by_point = np.zeros((len(x), 3, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = inverse
        by_point[:, :, 2] = -image * inverse[:, None]
        by_body = (by_point * (weight * seen.scale)[:, :, None]) @ self.camera[:3, :3].T
        by_world = by_body @ state.rotation.T
        frames = [self._frames[number] for number in numbers.tolist()]
        rotations = np.array([rotation for rotation, _ in frames])[group]
        positions = np.array([position for _, position in frames])[group]
        arms = np.einsum("nji,nj->ni", rotations, seen.places - positions)
        matrix = np.zeros((len(x), 3, 1 + len(numbers), 6))
        matrix[:, :, 0, :3], matrix[:, :, 0, 3:] = by_body @ crosses(in_body), -by_world
        rows = np.arange(len(x))
        matrix[rows, :, 1 + group, :3] = -by_world @ rotations @ crosses(arms)
        matrix[rows, :, 1 + group, 3:] = by_world
        flat = matrix.reshape(3 * len(x), -1)
        return flat.T @ flat, flat.T @ (weight * residual).ravel()
