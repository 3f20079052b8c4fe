"""Vehicles in a MuJoCo world: their model, and its physics: steps, present and past states."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import flip_yz, flip_yz_rotation, from_yaw
from sims.worlds import WorldError

Floats = npt.NDArray[np.float64]


class PhysicsDivergedError(Exception):
    """State no longer finite: the world's model or a written state is at fault."""


class Influence(Protocol):
    """Influence on a world besides its physics: wind, self-moving bodies."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Apply the influence at a time; called every millisecond, from the first on."""


class Simulation:
    """A world, stepped by whole milliseconds.

    What is read is exactly that of `time_ns`: the accelerometer too. MuJoCo's ``mj_step`` leaves
    sensors and contacts of *before* its last integration behind, so the present forward pass is
    made when they are first asked for, and the next advance starts from it with ``mj_step2``. The
    motors' thrust is a state of its own (their lag), so a new command changes nothing at its
    instant: the order in which vehicles are controlled does not matter.

    Attributes:
        mocap_velocities: Of the bodies that move by themselves, m/s NWU, shape (nmocap, 3).
        diverged: Whether its state was not finite once, and is of no use any more.

    Raises:
        ValueError: The world has another time step.
    """

    def __init__(self, model: Any, influences: Sequence[Influence] = ()) -> None:
        if abs(model.opt.timestep * 1e9 - TIMESTEP_NS) > 1e-3:
            raise ValueError(
                f"expected a world with a time step of 0.001 s, found {model.opt.timestep} s"
            )
        self.model = model
        self.data: Any = mujoco.MjData(model)
        self._past: deque[tuple[Floats, Floats]] = deque(maxlen=0)  # of each millisecond
        self.diverged = False
        self.influences = tuple(influences)
        self._steps = 0
        self._fresh = False
        self._apply()

    @property
    def time_ns(self) -> int:
        """Nanoseconds simulated since the start or the last `reset`; whole milliseconds."""
        return self._steps * TIMESTEP_NS

    def advance_to(self, stamp_ns: int) -> None:
        """Step to the last whole millisecond up to a time, or raise a `PhysicsDivergedError`."""
        steps = stamp_ns // TIMESTEP_NS - self._steps
        if steps <= 0:
            return
        if self._past.maxlen or self.influences:
            for _ in range(steps):
                if self._past.maxlen:
                    self._past.append((self.data.qpos.copy(), self.data.qvel.copy()))
                self._step(1)
                self._apply()
        else:
            self._step(steps)
        # MuJoCo starts again at time 0 when it finds a number that is not finite.
        if self.data.time < (self._steps - 0.5) * 1e-9 * TIMESTEP_NS:
            self.diverged = True
            raise PhysicsDivergedError(
                f"the simulation diverged before {self.time_ns / 1e9:.3f} s: "
                "its state was no longer finite"
            )

    def state_at(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the state at a time from `time_ns` up to a whole step later.

        Between two steps the world is carried on as the next step will carry it. (Damped joints of
        other bodies, which MuJoCo steps implicitly, may differ slightly.)

        Returns:
            Copies of the generalised positions, shape (nq,), and of the velocities with which these
            change, shape (nv,): MuJoCo's own are half a step old, of the middle of the step before.

        Raises:
            ValueError: The time is before `time_ns`, or more than a step later.
        """
        ahead = stamp_ns - self.time_ns
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        if not 0 <= ahead <= TIMESTEP_NS:
            expected = f"{self.time_ns} to {self.time_ns + TIMESTEP_NS} ns"
            raise ValueError(f"state_at: expected a time of {expected}, found {stamp_ns} ns")
        self.refresh()
        if ahead:
            # As semi-implicit Euler does it: first the velocity, and with that the position.
            next_qvel = qvel + self.data.qacc * (TIMESTEP_NS * 1e-9)
            mujoco.mj_integratePos(self.model, qpos, next_qvel, ahead * 1e-9)
        return qpos, qvel + self.data.qacc * ((ahead + TIMESTEP_NS / 2) * 1e-9)

    def keep(self, seconds: float) -> None:
        """Keep at least the states of the last `seconds` from now on, for `past`."""
        steps = math.ceil(seconds * 1e9 / TIMESTEP_NS) + 1
        if steps > (self._past.maxlen or 0):
            self._past = deque(self._past, maxlen=steps)

    def past(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the world's state at a kept time, or up to a step ahead.

        On a whole millisecond positions are those of that step, between two as the step carried
        them (semi-implicit Euler); velocities are as of `state_at`. Time begins with 0.

        Returns:
            Generalised positions, shape (nq,), and velocities, shape (nv,); not to be written to.

        Raises:
            ValueError: The time is not kept any more, or is too far ahead.
        """
        stamp_ns = max(stamp_ns, 0)
        if stamp_ns >= self.time_ns:
            return self.state_at(stamp_ns)
        step, rest = divmod(stamp_ns, TIMESTEP_NS)
        oldest = self._steps - len(self._past)
        if step < oldest:
            raise ValueError(
                f"history: expected a time from {oldest * TIMESTEP_NS} ns on, which is what "
                f"`keep` asked for, found {stamp_ns} ns"
            )
        qpos, qvel = self._past[step - oldest]
        newest = step + 1 == self._steps
        later = self.data.qvel if newest else self._past[step + 1 - oldest][1]
        if rest:
            qpos = qpos.copy()
            mujoco.mj_integratePos(self.model, qpos, later, rest * 1e-9)
        return qpos, qvel + (later - qvel) * (0.5 + rest / TIMESTEP_NS)

    def refresh(self) -> None:
        """Have sensors, contacts and accelerations be those of the present instant."""
        if not self._fresh:
            mujoco.mj_forward(self.model, self.data)
            self._fresh = True

    def changed(self) -> None:
        """Take note of a state written into `data`."""
        self._fresh = False

    def add_influence(self, influence: Influence) -> None:
        """Apply an influence each millisecond from the next on, after others, `reset` or not."""
        self.influences += (influence,)

    def trial(self, seconds: float) -> Any:
        """Return MuJoCo's data of some seconds after the start, if nothing is done meanwhile."""
        trial = mujoco.MjData(self.model)
        mujoco.mj_step(self.model, trial, round(seconds * 1e9) // TIMESTEP_NS)
        return trial

    def reset(self) -> None:
        """Go back to the start: time 0, the world as compiled, motors off."""
        mujoco.mj_resetData(self.model, self.data)
        self._steps = 0
        self._fresh = False
        self._past.clear()
        self._apply()

    def _apply(self) -> None:
        before = self.data.mocap_pos.copy()
        for influence in self.influences:
            influence.apply(self.model, self.data, self._steps * TIMESTEP_NS * 1e-9)
        self.mocap_velocities = (self.data.mocap_pos - before) / (TIMESTEP_NS * 1e-9)

    def _step(self, steps: int) -> None:
        self._steps += steps
        if self._fresh:
            self._fresh = False
            mujoco.mj_step2(self.model, self.data)
            steps -= 1
        if steps:
            mujoco.mj_step(self.model, self.data, steps)


TIMESTEP_NS = 1_000_000  # time step of the physics, nanoseconds
GRAVITY = 9.81  # metres per second squared

STANDING_HEIGHT = 0.1
"""Metres from the ground to the origin of ``base_link`` when the vehicle stands on its feet."""

AIR_DENSITY = 1.225  # kilograms per cubic metre, at sea level in the standard atmosphere
AIR_VISCOSITY = 1.8e-5  # pascal seconds

_OPTIONS: dict[str, Any] = {
    "timestep": TIMESTEP_NS * 1e-9,
    "gravity": [0.0, 0.0, -GRAVITY],
    "density": AIR_DENSITY,
    "viscosity": AIR_VISCOSITY,
    "wind": [0.0, 0.0, 0.0],  # which is a setting of `World`
    # Semi-implicit Euler: nothing here is stiff, and MuJoCo's implicit integrators cost more.
    "integrator": int(mujoco.mjtIntegrator.mjINT_EULER),
}  # MuJoCo options of a world with vehicles

_VEHICLE = Path(__file__).with_name("vehicle.xml")


class Motor(msgspec.Struct, frozen=True, kw_only=True):
    """Rotor of a vehicle."""

    position: Vector3  # metres from the centre of mass, FRD
    max_thrust: float  # newtons at full control, along the body's -z
    # Newton metres that the body feels about its z (FRD: positive turns the nose right) at full
    # control.
    max_torque: float


class VehicleParameters(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of a vehicle for its controller."""

    mass: float  # kilograms
    inertia: Vector3  # principal moments about x, y, z (FRD), kg m²
    motors: tuple[Motor, Motor, Motor, Motor]  # the motors, in the order of the commands
    motor_time_constant: float  # seconds
    gravity: float  # metres per second squared

    @property
    def max_thrust(self) -> float:
        """Newtons, all motors together."""
        return sum(motor.max_thrust for motor in self.motors)

    @property
    def hover_thrust(self) -> float:
        """Thrust at hover, 0 to 1 of `max_thrust`."""
        return self.mass * self.gravity / self.max_thrust


def attach_vehicle(world: mujoco.MjSpec, name: str, position: Vector3, yaw: float) -> None:
    """Put a vehicle, with names ``name/…``, into a world, and set time step, gravity and air.

    Args:
        world: Changed in place; MuJoCo's axes are read as NWU.
        position: Initial position of ``base_link``, metres NED. Standing on flat ground at z = 0 is
            (x, y, -`STANDING_HEIGHT`).
        yaw: Initial heading, radians clockwise from north seen from above.

    Raises:
        ValueError: The name is empty, contains a slash, or is taken.
        WorldError: The world asks for other physics in its ``<option>``.
    """
    if not name or "/" in name:
        raise ValueError(f"expected a vehicle's name without a slash, found {name!r}")
    if any(body.name == f"{name}/base_link" for body in world.bodies):
        raise ValueError(f"the world already has a vehicle named {name!r}")
    vehicle = mujoco.MjSpec.from_file(str(_VEHICLE))
    frame = world.worldbody.add_frame(pos=flip_yz(position), quat=flip_yz_rotation(from_yaw(yaw)))
    world.attach(vehicle, prefix=f"{name}/", frame=frame)
    default: Any = mujoco.MjSpec().option
    for key, value in _OPTIONS.items():
        option = np.asarray(getattr(world.option, key))
        if not any(np.allclose(option, o, atol=0.0) for o in (value, getattr(default, key))):
            given, ours = (" ".join(f"{x:g}" for x in np.ravel(o)) for o in (option, value))
            raise WorldError(
                f'world: <option>: expected {key}="{ours}", or none, since vehicles are simulated '
                f'so, found {key}="{given}"'
            )
        setattr(world.option, key, value)


def read_parameters(model: mujoco.MjModel, name: str) -> VehicleParameters:
    """Read a vehicle's parameters from a compiled model, or raise `ValueError`."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{name}/base_link")
    if body < 0:
        raise ValueError(f"expected a vehicle named {name!r} in the world, found no such body")
    motors = tuple(_read_motor(model, f"{name}/motor{i}") for i in (1, 2, 3, 4))
    actuator = model.actuator(f"{name}/motor1")
    ix, iy, iz = model.body_inertia[body].tolist()
    return VehicleParameters(
        mass=float(model.body_mass[body]),
        inertia=(ix, iy, iz),
        motors=(motors[0], motors[1], motors[2], motors[3]),
        motor_time_constant=float(actuator.dynprm[0]),
        gravity=float(np.linalg.norm(model.opt.gravity)),
    )


def mover_of(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom's vehicle or self-moving body; empty for a geom of neither."""
    root = int(model.body_rootid[model.geom_bodyid[geom]])
    name = str(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, root) or "")
    if model.body_mocapid[root] >= 0:
        return name
    return name.removesuffix("/base_link") if name.endswith("/base_link") else ""


def name_of(model: mujoco.MjModel, geom: int) -> str:
    """Return a geom's name, else its body's; empty if neither has a name."""
    kinds = mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY
    numbers = geom, int(model.geom_bodyid[geom])
    names = (mujoco.mj_id2name(model, *entity) for entity in zip(kinds, numbers, strict=True))
    return next((name for name in names if name), "")


def _read_motor(model: mujoco.MjModel, name: str) -> Motor:
    gear = model.actuator(name).gear.tolist()
    x, y, z = model.site(name).pos.tolist()
    return Motor(position=(x, -y, -z), max_thrust=gear[2], max_torque=-gear[5])


class Mixer:
    """Control allocation for four motors.

    When a motor would leave 0 to 1, yaw is given up first, then thrust; roll and pitch are kept as
    long as any thrust allows them, and beyond that shortened together, keeping their direction.
    (Compare PX4's "airmode" for roll and pitch, and M. Faessler, D. Falanga, D. Scaramuzza, *Thrust
    mixing, saturation, and body-rate control for accurate aggressive quadrotor flight*, RA-L 2017.)

    Raises:
        ValueError: The motors cannot make all of thrust and torques, or turn at equal thrust.
    """

    def __init__(self, parameters: VehicleParameters) -> None:
        motors = parameters.motors
        # A thrust F along -z at (x, y) has the torque (-y F, x F) in FRD.
        effect = np.array(
            [
                (m.max_thrust, -m.position[1] * m.max_thrust, m.position[0] * m.max_thrust,
                 m.max_torque)
                for m in motors
            ]
        ).T  # fmt: skip
        if np.linalg.matrix_rank(effect) < 4:
            raise ValueError("expected motors that can make thrust, roll, pitch and yaw")
        inverse = _inverse(effect)
        if not np.allclose(inverse[:, 0], inverse[0, 0], rtol=1e-6):
            raise ValueError("expected motors that do not turn the vehicle at equal thrust")
        self.max_thrust = parameters.max_thrust
        self._thrust = float(inverse[0, 0])
        # One column each, as rows of four floats: motor fractions per newton metre.
        self._roll: list[float] = inverse[:, 1].tolist()
        self._pitch: list[float] = inverse[:, 2].tolist()
        self._yaw: list[float] = inverse[:, 3].tolist()

    def mix(
        self, thrust: float, roll: float, pitch: float, yaw: float
    ) -> tuple[float, float, float, float]:
        """Return the motor commands, 0 to 1 each, closest to the requested wrench."""
        motors = [r * roll + p * pitch for r, p in zip(self._roll, self._pitch, strict=True)]
        span = max(motors) - min(motors)
        if span > 1.0:
            scale = 1.0 / span
            motors = [motor * scale for motor in motors]
        base = max(-min(motors), min(1.0 - max(motors), thrust * self._thrust))
        turns = [effect * yaw for effect in self._yaw]
        pairs = [(motor + base, turn) for motor, turn in zip(motors, turns, strict=True)]
        a, b, c, d = (motor + turn for motor, turn in pairs)
        if min(a, b, c, d) < 0.0 or max(a, b, c, d) > 1.0:
            share = min(_room(motor, turn) for motor, turn in pairs)
            a, b, c, d = (min(1.0, max(0.0, motor + share * turn)) for motor, turn in pairs)
        return a, b, c, d


def _room(motor: float, change: float) -> float:
    """Return the largest share of `change`, 0 to 1, to keep `motor` within 0 to 1."""
    if change > 0.0:
        room = (1.0 - motor) / change
    elif change < 0.0:
        room = motor / -change
    else:
        return 1.0
    return min(1.0, max(0.0, room))


def _inverse(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the inverse by fractions; numpy's last bits are the processor's."""
    size = len(matrix)
    rows = [
        [Fraction(value) for value in row] + [Fraction(int(k == number)) for k in range(size)]
        for number, row in enumerate(matrix.tolist())
    ]
    for k in range(size):
        pivot = max(range(k, size), key=lambda row: abs(rows[row][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for other in range(size):
            if other != k:
                factor = rows[other][k]
                rows[other] = [a - factor * b for a, b in zip(rows[other], rows[k], strict=True)]
    return np.array([[float(value) for value in row[size:]] for row in rows])
