"""A recorded motion as sensors know it: rows for the spline, and the body along it."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD, cross, from_rpy, inverse, rotate_inverse
from runtime.recorded import RecordedMotion
from sims.cameras import pose_to_qpos
from sims.carried.placing import EASE, products
from sims.carried.spline import Moment, MotionSpline
from sims.sensors.imu import ImuParameters
from sims.vehicle import State
from sims.world import SharedWorld

Floats = npt.NDArray[np.float64]
BodyAxes = Literal["frd", "flu", "optical", "euroc"]

BODIES: dict[BodyAxes, Quaternion] = {
    "frd": (1.0, 0.0, 0.0, 0.0),
    "flu": (0.0, 1.0, 0.0, 0.0),
    "optical": OPTICAL_TO_FRD,
    "euroc": from_rpy(0.0, np.pi / 2.0, 0.0),
}
"""Rotations from a recorded body's axes to FRD; ``euroc``: x up, y right, z ahead."""

_UPRIGHT = 0.7  # least mean of the vertical part of the axis that tells a body's axes
_DOWN: dict[BodyAxes, Vector3] = {
    name: rotate_inverse(turn, (0.0, 0.0, 1.0)) for name, turn in BODIES.items()
}


def axes_of(recorded: RecordedMotion) -> BodyAxes:
    """Return the body's axes: as declared, else by which of them points down on average.

    Raises:
        ValueError: Nobody declares them, and none points down for most of the time.
    """
    if recorded.body:
        return recorded.body
    means = {
        name: float(_rotated(recorded.orientations, axis)[:, 2].mean())
        for name, axis in _DOWN.items()
    }
    name = max(means, key=lambda axis_name: means[axis_name])
    if means[name] < _UPRIGHT:
        raise ValueError(
            f"body: expected one of {', '.join(BODIES)}, since no axis of the recorded body points "
            f"down on average (at most {means[name]:.2g} of its length), found auto"
        )
    return name


def rows_of(recorded: RecordedMotion, axes: BodyAxes, lever: Vector3, speed: float) -> Floats:
    """Return the body's rows: seconds from the first, x y z (m NED), w x y z (FRD to NED).

    Args:
        axes: Axes of the recorded body.
        lever: The recorded point on the body, metres FRD.
        speed: 2 is twice as fast.
    """
    seconds = (recorded.stamps - recorded.stamps[0]) / 1e9 / speed
    turns = products(recorded.orientations, np.array(inverse(BODIES[axes])))
    positions = recorded.positions - _rotated(turns, lever)
    return np.column_stack([seconds, positions, turns])


def _rotated(turns: Floats, vector: Vector3) -> Floats:
    """Return a vector turned by unit quaternions, shape (n, 3)."""
    back = turns * (1.0, -1.0, -1.0, -1.0)
    return products(products(turns, np.array((0.0, *vector))), back)[:, 1:]


class CarriedMotion:
    """Motion of a body along a spline; implements `sims.vehicle.VehicleMotion`.

    Args:
        name: Of the node, whose body `add_free_camera` put into the world as ``name/base_link``.
        rest: Seconds before the motion, in which imagined rotors stand still.
        thrust: Theirs in motion, 0 to 1 of their greatest, for the IMU's vibration.
    """

    def __init__(
        self,
        world: SharedWorld,
        name: str,
        spline: MotionSpline,
        imu: ImuParameters,
        rest: float = 0.0,
        thrust: float = 0.0,
    ) -> None:
        self.model: Any = world.model
        self._rest, self._thrust = rest, thrust
        self._world = world
        self._spline = spline
        self._imu = imu
        joint = self.model.joint(f"{name}/free")
        pose, twist = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._of_pose, self._of_twist = slice(pose, pose + 7), slice(twist, twist + 6)
        self._last: tuple[int, Moment] = (0, spline.at(0))

    @property
    def time_ns(self) -> int:
        """Time up to which the world's physics are stepped, ns; 0 if it has none."""
        return 0 if self._world.simulation is None else self._world.simulation.time_ns

    @property
    def thrusts(self) -> Floats:
        """Thrust of each imagined rotor at the time last asked for, 0 to 1 of its greatest."""
        moving = (self._last[0] / 1e9 - self._rest) / EASE if self._rest else 1.0
        return np.full(4, self._thrust * min(max(moving, 0.0), 1.0))

    @property
    def gravity(self) -> float:
        """Acceleration of free fall, m/s²."""
        return float(np.linalg.norm(self.model.opt.gravity))

    def advance_to(self, stamp_ns: int) -> None:
        """Step the world's physics, if it has any."""
        if self._world.simulation is not None:
            self._world.simulation.advance_to(stamp_ns)

    def at(self, stamp_ns: int) -> Moment:
        """Return the body's motion at a time, at rest before the motion and after it."""
        if self._last[0] != stamp_ns:
            self._last = stamp_ns, self._spline.at(stamp_ns)
        return self._last[1]

    def state(self, stamp_ns: int) -> State:
        """Return pose and velocity at a time."""
        moment = self.at(stamp_ns)
        return State(moment.position, moment.orientation, moment.velocity, moment.angular_velocity)

    def state_at(self, stamp_ns: int) -> tuple[State, Floats, Floats]:
        """Return the body's state, and the world's with the body in it."""
        state = self.state(stamp_ns)
        _, qpos, qvel = self._world.state_at(stamp_ns)
        qpos[self._of_pose] = pose_to_qpos(state.position, state.orientation)
        (vx, vy, vz), (wx, wy, wz) = state.velocity, state.angular_velocity
        qvel[self._of_twist] = (vx, -vy, -vz, wx, -wy, -wz)
        return state, qpos, qvel

    def imu(self, stamp_ns: int) -> tuple[Vector3, Vector3]:
        """Return true angular velocity (rad/s) and specific force (m/s²) in the IMU's frame."""
        moment, lever = self.at(stamp_ns), self._imu.position
        x, y, z = moment.acceleration
        fx, fy, fz = rotate_inverse(moment.orientation, (x, y, z - self.gravity))
        rates = moment.angular_velocity
        ax, ay, az = cross(moment.angular_acceleration, lever)
        bx, by, bz = cross(rates, cross(rates, lever))
        force = (fx + ax + bx, fy + ay + by, fz + az + bz)
        mounted = self._imu.rotation
        return rotate_inverse(mounted, rates), rotate_inverse(mounted, force)

    def keep(self, seconds: float) -> None:
        """Keep the world's past states; the body's are known at all times."""
        self._world.remember(seconds)

    def past(self, stamp_ns: int) -> Floats:
        """Return the world's positions at a time, shape (nq,), with the body in it."""
        qpos = self._world.past_state(stamp_ns)
        moment = self._spline.at(stamp_ns)
        qpos[self._of_pose] = pose_to_qpos(moment.position, moment.orientation)
        return qpos
