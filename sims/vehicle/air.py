"""The air that moves round the vehicles of a simulation, and what that does to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from events import Vector3
from events.frames import flip_yz, multiply, rotate, rotate_inverse
from sims.vehicle.model import TIMESTEP_NS
from sims.worlds.wind import Turbulence, WindSpec, turned

STEP = TIMESTEP_NS * 1e-9


class Air:
    """Wind as an influence on a simulation.

    Mean wind and gusts are the same everywhere: MuJoCo's own fluid model takes them into account.
    Turbulence is that of each vehicle's height and speed, all from one noise: vehicles side by
    side feel the same. What it adds to the drag of the vehicle's body is applied as a force.

    Args:
        model: The compiled world.
        spec: Settings of the wind.
        vehicles: Names of the vehicles.
        random: Source of the turbulence.

    Attributes:
        velocity: Mean wind, m/s NED; may be set, and holds from the next millisecond on.
    """

    def __init__(
        self, model: Any, spec: WindSpec, vehicles: Sequence[str], random: np.random.Generator
    ) -> None:
        self.velocity = spec.velocity
        self._spec = spec
        self._random = random
        start = random.standard_normal(Turbulence.NUMBERS).tolist()
        self._felt = {name: _Felt(model, name, Turbulence(start)) for name in vehicles}

    def velocity_at(self, vehicle: str) -> Vector3:
        """Return the velocity of the air round a vehicle at the present time, m/s NED."""
        return self._felt[vehicle].wind

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Move the air as it moves at the next millisecond."""
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
    """What one vehicle feels of the air."""

    def __init__(self, model: Any, name: str, turbulence: Turbulence) -> None:
        self.wind: Vector3 = (0.0, 0.0, 0.0)
        self._turbulence = turbulence
        self._body = int(model.body(f"{name}/base_link").id)
        joint = model.joint(f"{name}/free")
        self._pose, self._twist = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._box = equivalent_box(model, self._body)
        self._to_box = tuple(model.body_iquat[self._body].tolist())

    def disturb(
        self,
        model: Any,
        data: Any,
        mean: Vector3,
        common: Vector3,
        w20: float,
        noise: list[float],
    ) -> None:
        """Add turbulence to the wind that is common to all, and its force to the vehicle's."""
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
    """Return the edges, metres, of the box that MuJoCo takes for a body in the air."""
    inertia, mass = model.body_inertia[body], float(model.body_mass[body])
    total = float(inertia.sum())
    x, y, z = (math.sqrt(max(total - 2.0 * each, 0.0) * 6.0 / mass) for each in inertia.tolist())
    return x, y, z


def drag(model: Any, box: Vector3, velocity: Vector3) -> Vector3:
    """Return the force of the air on a box, as MuJoCo's fluid model on inertia boxes has it.

    Args:
        model: The world, for the air's density and viscosity.
        box: Its edges, metres.
        velocity: Of the box through the air, m/s along its edges.
    """
    x, y, z = box
    viscous = math.pi * (x + y + z) * model.opt.viscosity  # Stokes on a sphere of mean diameter
    dense = 0.5 * model.opt.density
    fx, fy, fz = (
        -(viscous + dense * area * abs(v)) * v
        for area, v in zip((y * z, x * z, x * y), velocity, strict=True)
    )
    return fx, fy, fz
