"""Vehicles, multirotors and free cameras, as seen by clients: poses, motion, and contacts."""

from __future__ import annotations

import functools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, Collision, Vector3, VehicleEvent
from events.frames import OPTICAL_TO_FRD, to_geodetic
from events.geometry import pose_matrix
from runtime.node import Node
from sims.cameras import pose_to_qpos
from sims.cameras.spec import CameraSpec, camera_info, eyes
from sims.mounting import EurocMatrix, angles_of
from sims.sensors.sensor import pressure_at, temperature_at
from sims.vehicle import Physics, State
from sims.vehicle.physics import Contact
from sims.world import SharedWorld
from visnav_airsim import wire
from visnav_airsim.server.methods import Named, RpcError, rpc
from visnav_airsim.wire import Pose, Quaternionr, Vector3r

Floats = npt.NDArray[np.float64]

FIRST: Any = ""  # default vehicle in handlers' parameters: the vehicle for an empty name
GAS_CONSTANT = 287.053  # of dry air, J/(kg K)
LANDED_SPEED = 0.08  # as AirSim's: m/s and rad/s, of each component of the velocity of what stands
APART = 10  # looks, of 20 ms each, without contact after which the next contact is a new one
# Contacts of a vehicle that was just placed: with anything, for `APART` looks.
_ANYTHING: dict[str, int] = {"": 0}


class ServedVehicle(Named, ABC):
    """Vehicle of the run, as seen by AirSim's methods, at a time that `now` gives, ns.

    Its local frame has the axes of ``map`` and its origin where the vehicle is at the start.
    """

    def __init__(self, name: str, world: SharedWorld, config: Any, now: Callable[[], int]) -> None:
        self.name = name
        self.config = config
        self.world = world
        self._now = now
        self.release()

    def release(self) -> None:
        """Be as at the start for clients: not under control, armed, without a collision."""
        self.api_control, self.armed, self.collision = False, True, wire.CollisionInfo()

    @property
    def start(self) -> State:
        """Start state, in ``map``; at rest on the ground for a start there."""
        return self.world.starts[self.name]

    @property
    @abstractmethod
    def stamp(self) -> int:
        """Time of the last requested state, ns."""

    @abstractmethod
    def state(self) -> State:
        """Return the true state now, in ``map``."""

    @abstractmethod
    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return linear (m/s² NED) and angular (rad/s² FRD) acceleration at `stamp`."""

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
        """Return the true pose now, in the local frame."""
        state = self.state()
        return Pose(self.local(state.position), Quaternionr(*state.orientation))

    def kinematics(self) -> wire.KinematicsState:
        """Return the kinematics as AirSim's: angular rates in FRD, all else local."""
        state = self.state()
        acceleration, angular = self.accelerations()
        return wire.KinematicsState(
            self.local(state.position),
            Quaternionr(*state.orientation),
            Vector3r(*state.velocity),
            Vector3r(*state.angular_velocity),
            Vector3r(*acceleration),
            Vector3r(*angular),
        )

    def geo_point(self, position: Vector3) -> wire.GeoPoint:
        """Return where a position of ``map`` is on the earth."""
        return wire.GeoPoint(*to_geodetic(position, self.config.origin))


class ServedMultirotor(ServedVehicle):
    """A multirotor; `motors_on` says whether its autopilot is armed."""

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
        """View of the world's physics, renewed after divergence."""
        if self._physics.simulation is not self.world.simulation:
            self._physics = self._look()
        return self._physics

    @property
    def stamp(self) -> int:
        """Time of the last requested state, ns."""
        return self.physics.time_ns

    def state(self) -> State:
        """Return the true state at the last whole millisecond, in ``map``."""
        self.physics.advance_to(self._now())
        return self.physics.state()

    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return linear (m/s² NED) and angular (rad/s² FRD) acceleration at `stamp`."""
        return self.physics.accelerations()

    def landed(self) -> bool:
        """Return whether the vehicle stood at `stamp`, its weight partly carried."""
        if sum(self.physics.thrusts.tolist()) >= self._carried:
            return False
        state = self.physics.state()
        speeds = (*state.velocity, *state.angular_velocity)
        return max(map(abs, speeds)) < LANDED_SPEED and self.physics.touching()


Commanded = Annotated[ServedMultirotor, "one that clients may command"]
"""Type of parameters of handlers: without API control, or disarmed, the call is refused."""


class ServedFreeCamera(ServedVehicle):
    """Free camera: no physics, stays where last put."""

    stamp = 0

    def state(self) -> State:
        """Return the true state now, in ``map``."""
        self.stamp = self._now()
        return self.world.free_cameras[self.name](self.stamp)

    def accelerations(self) -> tuple[Vector3, Vector3]:
        """Return zeros."""
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


class Vehicles(dict[str, ServedVehicle]):
    """All vehicles of a run, by name, and the methods about vehicles.

    Args:
        default: Name that an empty name stands for; empty for the first by name.
        settings: The settings.json for clients: its text, or a file; empty to describe the run.
    """

    def __init__(self, world: SharedWorld, default: str, settings: str, node: Node[Any]) -> None:
        super().__init__()
        self._world, self._default, self._settings, self._node = world, default, settings, node
        self._cameras: dict[str, CameraAnnouncement] = {}

    def announced(self, camera: CameraAnnouncement) -> None:
        """Store the announced calibration of a vehicle's camera."""
        self._cameras[camera.source] = camera

    def find(self, name: str) -> ServedVehicle:
        """Return a vehicle of either kind by name, or raise `RpcError`."""
        vehicle = self.get(name or self._default or min(self, default=""))
        if vehicle is None:
            raise _unknown("Vehicle Sim-API", name)
        return vehicle

    def find_multirotor(self, name: str) -> ServedMultirotor:
        """Return a multirotor, unnamed the first by name; an `RpcError` if there is none."""
        flying = (key for key in self if isinstance(self[key], ServedMultirotor))
        vehicle = self.get(name or self._default or min(flying, default=""))
        if vehicle is None and not name and self:
            vehicle = self.find("")
        if isinstance(vehicle, ServedFreeCamera):
            raise RpcError(
                f"{_unknown('Vehicle API', name)}: '{vehicle.name}' is a free camera "
                "(ComputerVision), which has cameras and no other sensor, neither motors nor "
                "physics; simSetVehiclePose moves it"
            )
        if not isinstance(vehicle, ServedMultirotor):
            raise _unknown("Vehicle API", name)
        return vehicle

    def find_commanded(self, name: str) -> ServedMultirotor:
        """Return a multirotor open to commands; an `RpcError` where AirSim would wait."""
        vehicle = self.find_multirotor(name)
        if not vehicle.api_control:
            raise RpcError(
                f"vehicle '{vehicle.name}' is not under API control: call enableApiControl first"
            )
        if not vehicle.armed:
            raise RpcError(f"vehicle '{vehicle.name}' is disarmed: call armDisarm first")
        return vehicle

    def drawn_state(self, now: int) -> tuple[int, Floats]:
        """Return time (ns) and a copy of positions, shape (nq,), of the last whole millisecond."""
        if self._world.simulation is None:
            stamp, qpos = now, self._world.model.qpos0.copy()
        else:
            self._world.simulation.advance_to(now)
            stamp = self._world.simulation.time_ns
            qpos = self._world.simulation.data.qpos.copy()
        for name, state_at in self._world.free_cameras.items():
            start = int(self._world.model.joint(name).qposadr[0])
            state = state_at(stamp)
            qpos[start : start + 7] = pose_to_qpos(state.position, state.orientation)
        return stamp, qpos

    @rpc("listVehicles")
    def names(self) -> list[str]:
        """Return the names of all vehicles, sorted."""
        return sorted(self)

    @rpc("getSettingsString")
    def settings(self) -> Awaitable[str] | str:
        """Return the settings.json of the settings, else a description of the run."""
        settings = self._settings
        if not settings:
            return json.dumps(self._described())
        if settings.lstrip().startswith("{"):
            return settings

        async def read() -> str:
            try:
                return await self._node.offload(Path(settings).read_text, "utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise RpcError(f"settings: expected a readable file, found: {error}") from None

        return read()

    @rpc("getMultirotorState")
    def multirotor_state(self, vehicle: ServedMultirotor) -> wire.MultirotorState:
        """Return the true state, with its exact stamp, and the last collision."""
        kinematics = vehicle.kinematics()
        place = vehicle.geo_point(vehicle.in_map(kinematics.position))
        landed_state = 0 if vehicle.landed() else 1
        return wire.MultirotorState(
            vehicle.collision, kinematics, place, vehicle.stamp, landed_state
        )

    @rpc("getComputerVisionState")
    def computer_vision_state(self, vehicle: ServedVehicle) -> wire.ComputerVisionState:
        """Return a vehicle's true state, of either kind, with its exact stamp."""
        return wire.ComputerVisionState(vehicle.kinematics(), vehicle.stamp)

    @rpc("simGetVehiclePose")
    def pose(self, vehicle: ServedVehicle) -> Pose:
        """Return a vehicle's true pose in its local frame."""
        return vehicle.pose()

    @rpc("simGetGroundTruthKinematics")
    def kinematics(self, vehicle: ServedVehicle) -> wire.KinematicsState:
        """Return how a vehicle truly moves; the accelerations are those of the physics."""
        return vehicle.kinematics()

    @rpc("simGetGroundTruthEnvironment")
    def environment(self, vehicle: ServedVehicle) -> wire.EnvironmentState:
        """Return the standard atmosphere, and the world's gravity, where a vehicle is."""
        position = vehicle.state().position
        place = vehicle.geo_point(position)
        gravity = Vector3r(0.0, 0.0, -float(self._world.model.opt.gravity[2]))
        pressure, temperature = pressure_at(place.altitude), temperature_at(place.altitude)
        density = pressure / (GAS_CONSTANT * temperature)
        local = vehicle.local(position)
        return wire.EnvironmentState(local, place, gravity, pressure, temperature, density)

    @rpc("getHomeGeoPoint")
    def home(self, vehicle: ServedVehicle) -> wire.GeoPoint:
        """Return where on the earth a vehicle was at the start."""
        return vehicle.geo_point(vehicle.origin)

    @rpc("getRotorStates")
    def rotors(self, vehicle: ServedMultirotor) -> wire.RotorStates:
        """Return speed (as in vibration), thrust and torque: front right, rear left, the others."""
        vehicle.state()
        fastest = math.tau * vehicle.config.imu.vibration.rotor_speed
        thrusts, motors = vehicle.physics.thrusts.tolist(), vehicle.physics.parameters.motors
        rotors = tuple(
            wire.RotorParameters(
                fastest * math.sqrt(max(share, 0.0)),
                share * motor.max_thrust,
                share * motor.max_torque,
            )
            for share, motor in zip(thrusts, motors, strict=True)
        )
        return wire.RotorStates(vehicle.stamp, rotors)

    def _described(self) -> dict[str, Any]:
        vehicles = {}
        for name, vehicle in self.items():
            flies = isinstance(vehicle, ServedMultirotor)
            cameras = (eye for camera in vehicle.config.cameras for eye in eyes(camera))
            vehicles[name] = {
                "VehicleType": "SimpleFlight" if flies else "ComputerVision",
                **dict(zip("XYZ", vehicle.origin, strict=True)),
                "Cameras": {
                    camera.name: _described_camera(
                        camera, self._cameras.get(f"{name}/{camera.name}")
                    )
                    for camera in cameras
                },
            }
        types = {vehicle["VehicleType"] for vehicle in vehicles.values()}
        mode = "ComputerVision" if types == {"ComputerVision"} else "Multirotor"
        return {"SettingsVersion": 1.2, "SimMode": mode, "Vehicles": vehicles}


class Collisions:
    """The last collision of each vehicle, with names and IDs by `identify`, of a geom or body.

    It is one of its node's; or, as AirSim counts the ground, any contact with a thing after a while
    without: landing counts, standing at the start does not, and the ground hides no wall.
    """

    def __init__(
        self, vehicles: dict[str, ServedVehicle], identify: Callable[[str], tuple[str, int]]
    ) -> None:
        self._vehicles, self._identify = vehicles, identify
        # By vehicle what it has touched, and how many looks ago.
        self._touched: dict[str, dict[str, int]] = {}

    @rpc("simGetCollisionInfo")
    def collision_info(self, vehicle: ServedVehicle) -> wire.CollisionInfo:
        """Return a vehicle's last collision, and clear its ``has_collided``."""
        collision = vehicle.collision
        vehicle.collision = msgspec.structs.replace(collision, has_collided=False)
        return collision

    def forget(self, vehicle: ServedVehicle) -> None:
        """Forget a vehicle's collision, and count its present contacts as known."""
        vehicle.collision = wire.CollisionInfo()
        self._touched[vehicle.name] = _ANYTHING

    def handle_event(self, vehicle: ServedMultirotor, event: VehicleEvent) -> None:
        """Record a collision from an event of the vehicle's node."""
        if isinstance(event, Collision):
            self._handle_contacts(
                vehicle, [c for c in vehicle.physics.contacts() if c.other == event.other]
            )

    def watch(self) -> None:
        """Check the vehicles' contacts; to be called 50 times a second."""
        for vehicle in self._vehicles.values():
            if not isinstance(vehicle, ServedMultirotor):
                continue
            vehicle.state()
            contacts = vehicle.physics.contacts() if vehicle.physics.touching() else []
            before = self._touched.get(vehicle.name, _ANYTHING)
            aged = {name: looks + 1 for name, looks in before.items() if looks < APART}
            self._touched[vehicle.name] = aged | {contact.other: 0 for contact in contacts}
            new = [contact for contact in contacts if contact.other not in before]
            if new and "" not in before:
                self._handle_contacts(vehicle, new)

    def _handle_contacts(self, vehicle: ServedMultirotor, contacts: list[Contact]) -> None:
        contact = max(contacts, key=lambda c: c.depth)
        vehicle.collision = wire.CollisionInfo(
            True,
            contact.depth,
            vehicle.stamp,
            Vector3r(*contact.normal),
            vehicle.local(contact.position),
            vehicle.local(vehicle.state().position),
            *self._identify(contact.other),
        )


def _described_camera(
    camera: CameraSpec, announcement: CameraAnnouncement | None
) -> dict[str, Any]:
    info, position, angles = camera_info(camera), camera.position, camera.orientation
    if camera.wrong is not None and announcement is not None:
        matrix = pose_matrix(announcement.position, announcement.orientation)
        data = EurocMatrix(data=tuple(matrix.ravel().tolist()))
        info, (position, angles) = announcement.info, angles_of(data, OPTICAL_TO_FRD)
    fov = math.degrees(2 * math.atan(info.width / (2 * info.fx)))
    size = {"Width": info.width, "Height": info.height, "FOV_Degrees": fov}
    return {
        **dict(zip("XYZ", position, strict=True)),
        **dict(zip(("Roll", "Pitch", "Yaw"), angles, strict=True)),
        "CaptureSettings": [{"ImageType": type_, **size} for type_ in range(8)],
    }


def _unknown(interface: str, name: str) -> RpcError:
    return RpcError(
        f"{interface} for '{name}' is not available. This could either because this is "
        "simulation-only API or this vehicle does not exist"
    )
