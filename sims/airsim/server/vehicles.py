"""What the server knows of each vehicle, and how it reads where the vehicle is now.

There are two kinds: multirotors, and the free cameras of computer-vision mode.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import to_geodetic
from sims.airsim.server.methods import RpcError
from sims.airsim.structures import (
    CollisionInfo,
    GeoPoint,
    KinematicsState,
    Pose,
    Quaternionr,
    Vector3r,
)
from sims.cameras import pose_to_qpos
from sims.vehicle import Physics, State
from sims.world import SharedWorld

Floats = npt.NDArray[np.float64]

LANDED_SPEED = 0.08
"""Of each component of velocity (m/s) and angular velocity (rad/s) of what stands, as in AirSim."""


class ServedVehicle(ABC):
    """A vehicle of the run as AirSim's methods see it.

    Its local frame has the axes of ``map`` and its origin where the vehicle is at the start.

    Args:
        name: The node's.
        world: The world that it is in.
        config: The node's settings.
        now: Gives the run's time (ns).

    Attributes:
        config: The node's settings.
        api_control: Whether clients may command it.
        armed: Whether clients have it armed.
        collision: Its last collision.
    """

    def __init__(self, name: str, world: SharedWorld, config: Any, now: Callable[[], int]) -> None:
        self.name = name
        self.config = config
        self.world = world
        self._now = now
        self.release()

    def release(self) -> None:
        """Be as at the start for clients: not under control, armed, without a collision."""
        self.api_control, self.armed, self.collision = False, True, CollisionInfo()

    @property
    def start(self) -> State:
        """Its state at the start, in ``map``: at rest on the ground, if it starts there."""
        return self.world.starts[self.name]

    @property
    @abstractmethod
    def stamp(self) -> int:
        """Time of the state that was last asked for (ns)."""

    @abstractmethod
    def state(self) -> State:
        """Return its true state now, in ``map``."""

    @abstractmethod
    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return acceleration, m/s² NED, and angular acceleration, rad/s² FRD, in that state."""

    @functools.cached_property
    def origin(self) -> Vector3:
        """Origin of the local frame in ``map``, metres NED."""
        return self.start.position

    def local(self, position: Vector3) -> Vector3r:
        """Return a position of ``map`` in the local frame."""
        (x, y, z), (ox, oy, oz) = position, self.origin
        return Vector3r(x - ox, y - oy, z - oz)

    def in_map(self, position: Vector3r) -> Vector3:
        """Return a position of the local frame in ``map``."""
        x, y, z = self.origin
        return position.x_val + x, position.y_val + y, position.z_val + z

    def pose(self) -> Pose:
        """Return its true pose now, in the local frame."""
        state = self.state()
        return Pose(self.local(state.position), Quaternionr(*state.orientation))

    def kinematics(self) -> KinematicsState:
        """Return how it moves now: as AirSim has it, angles in the body's frame, all else local."""
        state = self.state()
        acceleration, angular = self.accelerations()
        return KinematicsState(
            self.local(state.position),
            Quaternionr(*state.orientation),
            Vector3r(*state.velocity),
            Vector3r(*state.angular_velocity),
            Vector3r(*acceleration),
            Vector3r(*angular),
        )

    def geo_point(self, position: Vector3) -> GeoPoint:
        """Return where a position of ``map`` is on the earth."""
        return GeoPoint(*to_geodetic(position, self.config.origin))


class ServedMultirotor(ServedVehicle):
    """A multirotor.

    Attributes:
        motors_on: Whether its autopilot is armed.
    """

    def __init__(self, name: str, world: SharedWorld, config: Any, now: Callable[[], int]) -> None:
        super().__init__(name, world, config, now)
        self._physics = self._look()
        self.motors_on = False
        self._carried = 0.8 * 4.0 * self.physics.parameters.hover_thrust

    def _look(self) -> Physics:
        assert self.world.simulation is not None
        return Physics(self.world.simulation, self.name)

    @property
    def physics(self) -> Physics:
        """Its view of the world's physics, of which there is another after one has diverged."""
        if self._physics.simulation is not self.world.simulation:
            self._physics = self._look()
        return self._physics

    @property
    def stamp(self) -> int:
        """Time of the state that was last asked for (ns)."""
        return self.physics.time_ns

    def state(self) -> State:
        """Return its true state at the last whole millisecond, in ``map``."""
        self.physics.advance_to(self._now())
        return self.physics.state()

    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return acceleration, m/s² NED, and angular acceleration, rad/s² FRD, in that state."""
        return self.physics.accelerations()

    def landed(self) -> bool:
        """Return whether it stood in that state: something else carried part of its weight."""
        if sum(self.physics.thrusts.tolist()) >= self._carried:
            return False
        state = self.physics.state()
        speeds = (*state.velocity, *state.angular_velocity)
        return max(map(abs, speeds)) < LANDED_SPEED and self.physics.touching()


class ServedFreeCamera(ServedVehicle):
    """A free camera: it has no physics, and is where it has been put."""

    _stamp = 0

    @property
    def stamp(self) -> int:
        """Time of the state that was last asked for (ns)."""
        return self._stamp

    def state(self) -> State:
        """Return its true state now, in ``map``."""
        self._stamp = self._now()
        return self.world.free_cameras[self.name](self._stamp)

    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return zeros."""
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


class Vehicles(dict[str, ServedVehicle]):
    """All vehicles of a run, by name.

    Args:
        world: The world that they are in.
        default: Name of the one that an empty name stands for; empty for the first by name.
    """

    def __init__(self, world: SharedWorld, default: str) -> None:
        super().__init__()
        self._world = world
        self._default = default

    def find(self, name: str) -> ServedVehicle:
        """Return a vehicle of either kind.

        Raises:
            RpcError: There is none of that name.
        """
        found = self.get(name or self._default or min(self, default=""))
        if found is None:
            raise _unknown("Vehicle Sim-API", name)
        return found

    def find_multirotor(self, name: str) -> ServedMultirotor:
        """Return a multirotor; an empty name may stand for the first one, by name.

        Raises:
            RpcError: There is none of that name.
        """
        flying = (each for each in self if isinstance(self[each], ServedMultirotor))
        found = self.get(name or self._default or min(flying, default=""))
        if not isinstance(found, ServedMultirotor):
            raise _unknown("Vehicle API", name)
        return found

    def drawn_state(self, now: int) -> tuple[int, Floats]:
        """Return the world's state as it is to be drawn now; see `AirsimServer.drawn_state`."""
        if self._world.simulation is None:
            stamp, qpos = now, self._world.model.qpos0.copy()
        else:
            self._world.simulation.advance_to(now)
            stamp = self._world.simulation.time_ns
            qpos = self._world.simulation.data.qpos.copy()
        for name, state_at in self._world.free_cameras.items():
            begin = int(self._world.model.joint(name).qposadr[0])
            state = state_at(stamp)
            qpos[begin : begin + 7] = pose_to_qpos(state.position, state.orientation)
        return stamp, qpos


def _unknown(interface: str, name: str) -> RpcError:
    return RpcError(
        f"{interface} for '{name}' is not available. This could either because this is "
        "simulation-only API or this vehicle does not exist"
    )
