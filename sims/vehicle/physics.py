"""True state of a vehicle in a simulated world, and the forces of the air.

All that comes out is in our frames, NED and FRD, without noise. Stepping is in `simulation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from events.frames import (
    cross,
    flip_yz,
    flip_yz_rotation,
    multiply,
    normalize,
    rotate,
    rotate_inverse,
)
from sims.vehicle.simulation import (
    TIMESTEP_NS,
    Simulation,
    VehicleParameters,
    mover_of,
    name_of,
    read_parameters,
)
from sims.worlds.dynamics import Turbulence, WindSpec, turned

Floats = npt.NDArray[np.float64]


class State(msgspec.Struct, frozen=True, gc=False):
    """Pose and velocity of a vehicle."""

    position: Vector3  # metres NED
    orientation: Quaternion  # rotation FRD → NED
    velocity: Vector3  # metres per second NED
    angular_velocity: Vector3  # radians per second FRD


class Contact(msgspec.Struct, frozen=True, gc=False):
    """Contact point of the vehicle with another object."""

    # Name of the vehicle, or of the body that moves by itself, that it touches; else of the geom,
    # or of its body if it has none.
    other: str
    position: Vector3  # metres NED
    normal: Vector3  # unit vector NED, from the other towards the vehicle
    # Metres per second at which the two close in along the normal; negative if they part.
    speed: float
    depth: float = 0.0  # metres by which the one is inside the other


class Physics:
    """Interface of a vehicle to a simulation: motors, state, IMU and contacts.

    Whoever writes a state into `data` does it before anything is read at that instant.

    Args:
        world: The simulation, which several vehicles may share; or a compiled world with the
            vehicle, attached by `model.attach_vehicle`, for a simulation of its own.

    Raises:
        ValueError: The world has no such vehicle, or another time step.
    """

    def __init__(self, world: Simulation | mujoco.MjModel, name: str) -> None:
        model = world.model if isinstance(world, Simulation) else world
        self.parameters: VehicleParameters = read_parameters(model, name)
        self.simulation = world if isinstance(world, Simulation) else Simulation(world)
        self.model = model
        self.data: Any = self.simulation.data
        self._body = model.body(f"{name}/base_link").id
        joint = model.joint(f"{name}/free")
        pose, twist = int(joint.qposadr[0]), int(joint.dofadr[0])
        motor = model.actuator(f"{name}/motor1").id
        thrust = int(model.actuator(f"{name}/motor1").actadr[0])
        site = model.site(f"{name}/imu")
        self._lever = flip_yz(tuple(site.pos.tolist()))
        self._mounted = flip_yz_rotation(tuple(site.quat.tolist()))
        # Views on MuJoCo's own memory; `tolist` makes plain floats of them in one C call each.
        self._of_pose, self._of_twist = slice(pose, pose + 7), slice(twist, twist + 6)
        self._pose = self.data.qpos[self._of_pose]
        self._twist = self.data.qvel[self._of_twist]
        self._motors = self.data.ctrl[motor : motor + 4]
        self._rotors = slice(thrust, thrust + 4)
        self.thrusts = self.data.act[self._rotors]
        """Thrust of each rotor, 0 to 1 of its greatest; present values, not to be written to."""
        thrusts = [motor.max_thrust for motor in self.parameters.motors]
        self._gains = np.array(thrusts) / self.parameters.mass

    @property
    def time_ns(self) -> int:
        """Nanoseconds simulated since the start or the last `reset`; whole milliseconds."""
        return self.simulation.time_ns

    @property
    def gravity(self) -> float:
        """Acceleration of free fall, m/s²."""
        return self.parameters.gravity

    def advance_to(self, stamp_ns: int) -> None:
        """Step the simulation; see `Simulation.advance_to`."""
        self.simulation.advance_to(stamp_ns)

    def keep(self, seconds: float) -> None:
        """Keep past states; see `Simulation.keep`."""
        self.simulation.keep(seconds)

    def past(self, stamp_ns: int) -> Floats:
        """Return the world's positions at a kept time, shape (nq,); see `Simulation.past`."""
        self.simulation.advance_to(stamp_ns)
        return self.simulation.past(stamp_ns)[0]

    def set_motors(self, m0: float, m1: float, m2: float, m3: float) -> None:
        """Set the motor commands, each 0 to 1 of its full thrust; clamped beyond."""
        self._motors[:] = m0, m1, m2, m3

    def state(self) -> State:
        """Return the vehicle's pose and velocity."""
        return self.state_at(self.time_ns)[0]

    def state_at(self, stamp_ns: int) -> tuple[State, Floats, Floats]:
        """Return the vehicle's state, and the world's as from `Simulation.state_at`."""
        qpos, qvel = self.simulation.state_at(stamp_ns)
        return self.state_in(qpos, qvel), qpos, qvel

    def state_in(self, qpos: Floats, qvel: Floats) -> State:
        """Return the vehicle's state in a world state, such as from `Simulation.past`."""
        return _state(qpos[self._of_pose], qvel[self._of_twist])

    def imu(self, stamp_ns: int = 0) -> tuple[Vector3, Vector3]:
        """Return angular velocity (rad/s) and specific force (m/s²), true, of the site `imu`.

        They are along its axes turned to FRD: centre of mass and body's axes unless moved. At rest
        the force is (0, 0, -9.81). A `stamp_ns` is as of `state_at`, at least `time_ns`.
        """
        ahead = max(stamp_ns - self.time_ns, 0)
        rates = self.state_at(self.time_ns + ahead)[0].angular_velocity
        (x, y, z), turning = self.accelerations()
        now = _state(self._pose, self._twist).orientation
        fx, fy, fz = rotate_inverse(now, (x, y, z - self.parameters.gravity))
        # Of all forces the rotors' change most within a step, and they are fixed to the body.
        fz -= float((self._gains * self.data.act_dot[self._rotors]).sum()) * ahead * 1e-9
        ax, ay, az = cross(turning, self._lever)
        bx, by, bz = cross(rates, cross(rates, self._lever))
        force = (fx + ax + bx, fy + ay + by, fz + az + bz)
        return rotate_inverse(self._mounted, rates), rotate_inverse(self._mounted, force)

    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return acceleration, m/s² NED, and angular acceleration, rad/s² FRD; zero at rest."""
        self.simulation.refresh()
        ax, ay, az, wx, wy, wz = self.data.qacc[self._of_twist].tolist()
        return (ax, -ay, -az), (wx, -wy, -wz)

    def touching(self) -> bool:
        """Return whether the vehicle touches anything; cheaper than `contacts`."""
        self.simulation.refresh()
        return bool(self.data.ncon) and bool(self._own_contacts())

    def contacts(self) -> list[Contact]:
        """Return all contact points of the vehicle."""
        self.simulation.refresh()
        if not self.data.ncon:
            return []
        return [self._contact(index, own) for index, own in self._own_contacts()]

    def put(self, state: State) -> None:
        """Have the vehicle be in a state at once, whatever is there; its rotors turn on."""
        (x, y, z), (vx, vy, vz) = state.position, state.velocity
        wx, wy, wz = state.angular_velocity
        qw, qx, qy, qz = normalize(state.orientation)
        self._pose[:] = (x, -y, -z, qw, qx, -qy, -qz)
        twist = np.array((vx, -vy, -vz, wx, -wy, -wz))
        self._twist[:] = twist
        self.simulation.changed()
        for _ in range(5):  # to where `Simulation.state_at` tells of this twist
            if self.touching():  # a push may be of any size
                break
            self._twist[:] = twist - self.data.qacc[self._of_twist] * (TIMESTEP_NS * 0.5e-9)
            self.simulation.changed()

    def stop_rotors(self) -> None:
        """Have the rotors stand still at once."""
        self.set_motors(0.0, 0.0, 0.0, 0.0)
        self.thrusts[:] = 0.0
        self.simulation.changed()

    def settle(self) -> None:
        """Let the vehicle rest on the ground, its weight carried, if starting there.

        Feet that only just touch are not pushed: the vehicle would fall by 0.1 mm. One that does
        not come to rest within 1 cm and half a second stays, as all else in the world. Call it
        before the first step.
        """
        trial = self.simulation.trial(0.5)
        pose, twist = trial.qpos[self._of_pose], trial.qvel[self._of_twist]
        if np.abs(twist).max() < 1e-3 and np.linalg.norm(pose[:3] - self._pose[:3]) < 0.01:
            self._pose[:] = pose
            self.simulation.changed()

    def reset(self) -> None:
        """Go back to the start; see `Simulation.reset`."""
        self.simulation.reset()

    def _own_contacts(self) -> list[tuple[int, int]]:
        """Return (contact, side of the vehicle's geom) for each pushing contact."""
        body_of = self.model.geom_bodyid
        contact = self.data.contact
        own = []
        for index, (pair, distance) in enumerate(
            zip(contact.geom.tolist(), contact.dist.tolist(), strict=True)
        ):
            sides = [side for side in (0, 1) if body_of[pair[side]] == self._body]
            # MuJoCo also lists pairs within the margin that do not touch yet.
            if sides and distance <= 0.0:
                own.append((index, sides[0]))
        return own

    def _contact(self, index: int, own: int) -> Contact:
        contact = self.data.contact[index]
        geom = int(contact.geom[1 - own])
        # The contact's first axis points from its first geom to its second.
        sign = 1.0 if own == 1 else -1.0
        nx, ny, nz = (sign * component for component in contact.frame[:3].tolist())
        point = tuple(contact.pos.tolist())
        ax, ay, az = self._velocity_at(self._body, point)
        bx, by, bz = self._velocity_at(int(self.model.geom_bodyid[geom]), point)
        closing = -((ax - bx) * nx + (ay - by) * ny + (az - bz) * nz)
        x, y, z = point
        depth = -float(contact.dist)
        other = mover_of(self.model, geom) or name_of(self.model, geom)
        return Contact(other or f"geom {geom}", (x, -y, -z), (nx, -ny, -nz), closing, depth)

    def _velocity_at(self, body: int, point: Vector3) -> Vector3:
        """Return the velocity, m/s NWU, of a body's material (or mocap origin) at a point."""
        mocap = int(self.model.body_mocapid[self.model.body_rootid[body]])
        if mocap >= 0:
            vx, vy, vz = self.simulation.mocap_velocities[mocap].tolist()
            return vx, vy, vz
        velocity = np.zeros(6)  # angular, then linear, at the body's origin, in the world's axes
        mujoco.mj_objectVelocity(
            self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0
        )
        wx, wy, wz, vx, vy, vz = velocity.tolist()
        ox, oy, oz = self.data.xpos[body].tolist()
        x, y, z = point[0] - ox, point[1] - oy, point[2] - oz
        return vx + wy * z - wz * y, vy + wz * x - wx * z, vz + wx * y - wy * x


def _state(pose: Floats, twist: Floats) -> State:
    """Return a free joint's qpos, shape (7,), and qvel, shape (6,), in our frames."""
    x, y, z, qw, qx, qy, qz = pose.tolist()
    vx, vy, vz, wx, wy, wz = twist.tolist()
    return State((x, -y, -z), (qw, qx, -qy, -qz), (vx, -vy, -vz), (wx, -wy, -wz))


STEP = TIMESTEP_NS * 1e-9


class Air:
    """Wind as an influence on a simulation.

    Mean wind and gusts are the same everywhere, by MuJoCo's own fluid model. Turbulence is that of
    each vehicle's height and speed, all from one noise; what it adds to the drag is applied as a
    force.
    """

    def __init__(
        self, model: Any, spec: WindSpec, vehicles: Sequence[str], random: np.random.Generator
    ) -> None:
        # Mean wind, m/s NED; may be set, and holds from the next millisecond on.
        self.velocity = spec.velocity
        self._spec = spec
        self._random = random
        start = random.standard_normal(Turbulence.NUMBERS).tolist()
        self._felt = {name: _Felt(model, name, Turbulence(start)) for name in vehicles}

    def velocity_at(self, vehicle: str) -> Vector3:
        """Return the velocity of the air round a vehicle at the present time, m/s NED."""
        return self._felt[vehicle].wind

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Set the air to its motion in the next millisecond."""
        common = self.velocity
        for gust in self._spec.gusts:
            share = gust.share(seconds)
            gx, gy, gz = gust.velocity
            common = (
                common[0] + share * gx, common[1] + share * gy, common[2] + share * gz
            )  # fmt: skip
        model.opt.wind[:] = flip_yz(common)
        w20 = self._spec.w20
        noise = self._random.standard_normal(Turbulence.NUMBERS).tolist() if w20 else []
        for felt in self._felt.values():
            felt.wind = common
            if w20:
                felt.disturb(model, data, self.velocity, common, w20, noise)


class _Felt:
    def __init__(self, model: Any, name: str, turbulence: Turbulence) -> None:
        self.wind: Vector3 = (0.0, 0.0, 0.0)
        self._turbulence = turbulence
        self._body = int(model.body(f"{name}/base_link").id)
        joint = model.joint(f"{name}/free")
        self._pose, self._twist = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._box = equivalent_box(model, self._body)
        self._to_box = tuple(model.body_iquat[self._body].tolist())

    def disturb(
        self, model: Any, data: Any, mean: Vector3, common: Vector3, w20: float, noise: list[float]
    ) -> None:
        """Add turbulence to the common wind, and its force to the vehicle."""
        pose = data.qpos[self._pose : self._pose + 7].tolist()
        vx, vy, vz = data.qvel[self._twist : self._twist + 3].tolist()
        wx, wy, wz = flip_yz(mean)
        speed = math.hypot(vx - wx, vy - wy, vz - wz)
        eddy = turned(self._turbulence.step(STEP, speed, pose[2], w20, noise), mean)
        self.wind = (common[0] + eddy[0], common[1] + eddy[1], common[2] + eddy[2])
        turn = multiply((pose[3], pose[4], pose[5], pose[6]), self._to_box)
        calm, rough = (
            drag(model, self._box, rotate_inverse(turn, (vx - a, vy - b, vz - c)))
            for a, b, c in (flip_yz(common), flip_yz(self.wind))
        )
        extra = rotate(turn, (rough[0] - calm[0], rough[1] - calm[1], rough[2] - calm[2]))
        data.xfrc_applied[self._body, :3] = extra


def equivalent_box(model: Any, body: int) -> Vector3:
    """Return the edges of MuJoCo's equivalent inertia box of a body, metres."""
    inertia, mass = model.body_inertia[body], float(model.body_mass[body])
    total = float(inertia.sum())
    x, y, z = (math.sqrt(max(total - 2.0 * i, 0.0) * 6.0 / mass) for i in inertia.tolist())
    return x, y, z


def drag(model: Any, box: Vector3, velocity: Vector3) -> Vector3:
    """Return MuJoCo's inertia-box fluid force on a box of edges (m) at a velocity along them."""
    x, y, z = box
    viscous = math.pi * (x + y + z) * model.opt.viscosity  # Stokes on a sphere of mean diameter
    dense = 0.5 * model.opt.density
    fx, fy, fz = (
        -(viscous + dense * area * abs(v)) * v
        for area, v in zip((y * z, x * z, x * y), velocity, strict=True)
    )
    return fx, fy, fz
