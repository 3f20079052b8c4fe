"""Computer-vision mode: a free camera in a world, with no vehicle and no physics."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import PoseSetpoint, PositionSetpoint, Quaternion, Vector3, VelocitySetpoint
from events.frames import from_rpy, from_yaw, multiply, normalize, rotate, yaw_of
from runtime import Tick, every, on
from runtime.paths import InputPath
from sims.cameras import CameraSpec, add_free_camera, check_cameras, pose_to_qpos, qvel_between
from sims.vehicle import State
from sims.world import Rate, SharedWorld, Simulator, SimulatorConfig, join_world
from sims.worlds import Dynamics, Scene

Course = Callable[[int], tuple[Vector3, Quaternion]]  # poses in ``map`` at times (ns)
MOMENT = 1e-3  # interval of the camera's velocity, seconds, centred on the stamp


class FreeCameraConfig(SimulatorConfig):
    """Settings of a free camera, besides those of every simulator.

    Attributes:
        position: Position at the start, metres in ``map`` (NED).
        orientation: Roll, pitch, yaw at the start, degrees.
        rate: Updates per second; each exposes all cameras, whatever rate their own settings name.
        cameras: Cameras carried; there may be none if others look, as AirSim clients do.
        trajectory: TUM file (stamp x y z qx qy qz qw; NED, FRD), followed to the run's end; or
            empty.
    """

    position: Vector3 = (0.0, 0.0, -1.5)
    orientation: Vector3 = (0.0, 0.0, 0.0)
    rate: Rate = 30
    trajectory: InputPath = ""

    def __post_init__(self) -> None:
        check_cameras(_at_rate(self))


class FreeCamera(Simulator[FreeCameraConfig]):
    """Cameras moved by set-points or a trajectory file, without vehicle and physics.

    In a run with vehicles, the cameras share their world and see them. The odometry's twist is that
    of the trajectory, or of the velocity set-point; at a row of the file, where two straight lines
    meet, the mean of both; after a jump to a pose, zero.
    """

    alone = True

    @property
    def frame_id(self) -> str:
        """Frame of the cameras' body: the node's name."""
        return self.name

    @property
    def cameras(self) -> tuple[CameraSpec, ...]:
        """The cameras, all at the rate of the updates."""
        return _at_rate(self.config)

    async def on_startup(self) -> None:
        """Build the world and start the renderers."""
        await super().on_startup()
        config = self.config
        roll, pitch, yaw = (math.radians(angle) for angle in config.orientation)
        self._position = config.position
        self._orientation: Quaternion = from_rpy(roll, pitch, yaw)
        self._velocity: VelocitySetpoint | None = None
        self._stamp = 0
        self._rows = (
            await self.offload(read_tum, Path(config.trajectory)) if (config.trajectory) else None
        )
        await self.rig.start(self._join)
        self._world.remember(self.rig.past)

    async def _join(self) -> SharedWorld:
        self._world = await join_world(self)
        joint = self._world.model.joint(self.name)
        pose, twist = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._of_pose, self._of_twist = slice(pose, pose + 7), slice(twist, twist + 6)
        self._world.free_cameras[self.name] = self.state_at
        still = (0.0, 0.0, 0.0)
        self._world.starts.setdefault(
            self.name, State(self._position, self._orientation, still, still)
        )
        return self._world

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Put the cameras into the world."""
        add_free_camera(scene.spec, name, _at_rate(config))
        return Dynamics()

    @on(PoseSetpoint, PositionSetpoint, VelocitySetpoint)
    def setpoints(self, event: PoseSetpoint | PositionSetpoint | VelocitySetpoint) -> None:
        """Jump to a pose, or to a position with level attitude, or move with a velocity."""
        if not self._addressee.obeys(event, "setpoints"):
            return
        self._velocity = event if isinstance(event, VelocitySetpoint) else None
        if isinstance(event, PoseSetpoint):
            self._position, self._orientation = event.position, normalize(event.orientation)
        elif isinstance(event, PositionSetpoint):
            self._position, self._orientation = event.position, from_yaw(event.yaw)

    @every(hz="rate")
    def update(self, tick: Tick) -> None:
        """Move, send the pose, and expose all cameras."""
        if self._rows is not None and not self._follow(tick.stamp):
            self.stop("trajectory ended")
            return
        if self._rows is None:
            self._position, self._orientation = self._course(tick.stamp)(tick.stamp)
        self._stamp = tick.stamp
        course = self._course(tick.stamp)
        qvel = _velocity_on(course, tick.stamp)
        self._send_state(tick.stamp, _state(self._position, self._orientation, qvel))
        _, state, velocities = self._world.state_at(tick.stamp)
        state[self._of_pose] = pose_to_qpos(self._position, self._orientation)
        velocities[self._of_twist] = qvel

        def past_state(stamp: int) -> npt.NDArray[np.float64]:
            qpos = self._world.past_state(stamp)
            qpos[self._of_pose] = pose_to_qpos(*course(stamp))
            return qpos

        for camera in self.config.cameras:
            self.rig.expose(camera.name, tick.stamp, state, velocities, past_state)

    def state_at(self, stamp: int) -> State:
        """Return pose and velocity at a time (ns) not before the last update."""
        course = self._course(stamp)
        return _state(*course(stamp), _velocity_on(course, stamp))

    def _course(self, stamp: int) -> Course:
        """Return the camera's path near `stamp`, as poses of times (ns)."""
        rows = self._rows
        if rows is not None:
            return lambda time: pose_at(rows, time / 1e9)
        order, position, orientation = self._velocity, self._position, self._orientation
        if order is None or stamp - order.stamp > self.config.setpoint_timeout * 1e9:
            return lambda _: (position, orientation)
        velocity, since = order.velocity, self._stamp
        if order.frame_id == "heading":
            velocity = rotate(from_yaw(yaw_of(orientation)), velocity)

        def drifted(time: int) -> tuple[Vector3, Quaternion]:
            (x, y, z), (vx, vy, vz), seconds = position, velocity, (time - since) / 1e9
            place = (x + vx * seconds, y + vy * seconds, z + vz * seconds)
            turn = from_yaw(order.yaw_rate * seconds)
            return place, normalize(multiply(turn, orientation))

        return drifted

    def _follow(self, stamp: int) -> bool:
        """Move to the trajectory's pose at `stamp`; return False after its end."""
        assert self._rows is not None
        if stamp / 1e9 > self._rows[-1, 0]:
            return False
        self._position, self._orientation = pose_at(self._rows, stamp / 1e9)
        return True


def _state(place: Vector3, turn: Quaternion, qvel: npt.NDArray[np.float64]) -> State:
    vx, vy, vz, wx, wy, wz = qvel.tolist()  # FLU, as MuJoCo has it: half a turn from FRD
    return State(place, turn, (vx, -vy, -vz), (wx, -wy, -wz))


def _velocity_on(course: Course, stamp: int) -> npt.NDArray[np.float64]:
    """Return the generalised velocity of a free camera on its way, shape (6,)."""
    half = round(MOMENT / 2 * 1e9)
    before, after = (pose_to_qpos(*course(stamp + sign * half)) for sign in (-1, 1))
    return qvel_between(before, after, MOMENT)


def read_tum(path: Path) -> npt.NDArray[np.float64]:
    """Return rows of stamp (from 0 s), x, y, z, qx, qy, qz, qw; `ValueError` for a wrong file."""
    try:
        rows = np.loadtxt(path, ndmin=2, comments="#")
    except (OSError, ValueError) as error:
        raise ValueError(f"trajectory: {path}: expected a TUM file, found: {error}") from None
    if rows.shape[0] < 2 or rows.shape[1] != 8:
        raise ValueError(
            f"trajectory: {path}: expected 2 or more rows of 8 numbers, found shape {rows.shape}"
        )
    if not (np.diff(rows[:, 0]) > 0).all():
        raise ValueError(f"trajectory: {path}: expected rising stamps, found a step back")
    rows[:, 0] -= rows[0, 0]  # seconds since 1970 would leave a quarter of a microsecond
    return rows


def pose_at(rows: npt.NDArray[np.float64], seconds: float) -> tuple[Vector3, Quaternion]:
    """Return a trajectory's (`read_tum`) pose seconds after its first row, by line and slerp."""
    after = int(np.clip(np.searchsorted(rows[:, 0], seconds), 1, len(rows) - 1))
    a, b = rows[after - 1], rows[after]
    share = (seconds - a[0]) / (b[0] - a[0])
    x, y, z = (a[1:4] + share * (b[1:4] - a[1:4])).tolist()
    # K. Shoemake, "Animating rotation with quaternion curves", 1985; along the shorter arc.
    q0, q1 = a[4:8] / np.linalg.norm(a[4:8]), b[4:8] / np.linalg.norm(b[4:8])
    if q0 @ q1 < 0:
        q1 = -q1
    angle = math.acos(min(float(q0 @ q1), 1.0))
    if angle < 1e-6:
        q = q1
    else:
        q = (math.sin((1 - share) * angle) * q0 + math.sin(share * angle) * q1) / math.sin(angle)
    qx, qy, qz, qw = q.tolist()
    return (x, y, z), (qw, qx, qy, qz)


def _at_rate(config: FreeCameraConfig) -> tuple[CameraSpec, ...]:
    return tuple(msgspec.structs.replace(c, rate=config.rate) for c in config.cameras)
