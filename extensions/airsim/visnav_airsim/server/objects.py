"""Methods of the world round the vehicles: its objects, wind, lines of sight and extents.

An object is a named geom of the model, with its look, or a named body with all its geoms; a
vehicle, or a body that moves by itself, is one object whatever it is made of.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from msgspec.structs import astuple

from events import Vector3
from events.frames import flip_yz, flip_yz_rotation, from_geodetic
from runtime.logs import NodeLogger
from sims.cameras.stage import LOOK
from sims.ray_casting import cast_ray
from sims.vehicle.simulation import mover_of
from sims.world import SharedWorld
from sims.worlds.dynamics import check_strength
from visnav_airsim.server import movables
from visnav_airsim.server.methods import RpcError, rpc
from visnav_airsim.server.vehicles import FIRST, ServedVehicle, Vehicles
from visnav_airsim.wire import NAN, GeoPoint, Pose, Quaternionr, Vector3r

FARTHEST = 1e4  # metres from the origin within which objects can be put
FARTHEST_PLACE = 1e9  # degrees, and metres above the sea
LONGEST_NAME = 100  # characters of the name of an object that is brought in
MOST_MESSAGES, LONGEST_MESSAGE = 1000, 500  # messages that are logged, and characters of one
HIDDEN = -1  # ID of an object that is left out of segmentation images: black, as nothing is

_BODY = mujoco.mjtObj.mjOBJ_BODY

UNKNOWN = Pose(Vector3r(NAN, NAN, NAN), Quaternionr(NAN, NAN, NAN, NAN))
"""Pose of a missing object: all NaN."""


def initial_id(name: str) -> int:
    """Return AirSim's first ID of an object: of its lower-cased name 5 and all codes from 97."""
    return (5 + sum(code for code in map(ord, name.lower()) if code >= 97)) % 256


class Objects:
    """Objects of the world, `spares` by their bodies' names, with their segmentation IDs."""

    def __init__(
        self,
        world: SharedWorld,
        spares: dict[str, movables.SpareObject],
        now: Callable[[], int],
        log: NodeLogger,
    ) -> None:
        self._world, self._now, self._log = world, now, log
        self._initial_data: Any = None
        self._warned: set[str] = set()
        model = world.model
        self._spares = {model.body(name).id: spec for name, spec in spares.items()}
        # Numbers of each object's geoms in the model, by the object's name, sorted.
        self.geoms = {
            name: geoms
            for name, geoms in geoms_by_object(model).items()
            if model.geom_bodyid[geoms[0]] not in self._spares
        }
        bodies = movables.movable_bodies(model)
        self._bodies = {name: body for name, body in bodies.items() if name in self.geoms}
        armature = {body: model.dof_armature[model.body_dofadr[body]] for body in bodies.values()}
        self._held = {
            body for body in armature if armature[body] == movables.HELD or body in self._spares
        }
        self._at_start = dict(self._bodies), dict(self.geoms), model.qpos0.copy()
        if self._held and world.simulation is not None:
            movables.enable_collisions(model)
            self._holder = movables.Holder.of(world.simulation)
        for body in self._held:
            self._place_body(body, self._home(body))
        self._ids = np.full(model.ngeom + 1, HIDDEN)
        for name in sorted(self.geoms, key=lambda object_name: -len(self.geoms[object_name])):
            self._number(name, initial_id(name))  # that of a part goes before that of the whole

    def reset(self) -> None:
        """Bring all objects back to where they were at the start."""
        self._bodies = dict(self._at_start[0])
        self.geoms = dict(self._at_start[1])
        for body in {*self._bodies.values(), *self._held}:
            self._place_body(body, self._home(body))

    def data(self) -> Any:
        """Return MuJoCo's data of the world at the present time, with positions computed."""
        simulation, now = self._world.simulation, self._now()
        if simulation is not None:
            simulation.advance_to(now)
            simulation.refresh()
            return simulation.data
        if self._initial_data is None:
            self._initial_data = mujoco.MjData(self._world.model)
        _, self._initial_data.qpos[:], _ = self._world.state_at(now)
        self._world.dynamics.apply(self._world.model, self._initial_data, now * 1e-9)
        mujoco.mj_kinematics(self._world.model, self._initial_data)
        return self._initial_data

    def identify(self, touched: str) -> tuple[str, int]:
        """Return name and segmentation ID of the object of a geom or body in the model."""
        model = self._world.model
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, touched)
        body = mujoco.mj_name2id(model, _BODY, touched)
        body = int(model.geom_bodyid[geom]) if geom >= 0 else body
        name = next((name for name, number in self._bodies.items() if number == body), touched)
        return name, self.segmentation_id(name)

    def segmentation_ids(self) -> npt.NDArray[np.uint8]:
        """Return the drawn ID of each geom, and last of nothing, shape (n + 1,)."""
        return np.maximum(self._ids, 0).astype(np.uint8)

    @rpc("simGetSegmentationObjectID")
    def segmentation_id(self, name: str) -> int:
        """Return the ID of an object, whatever the case of its name; -1 if there is none."""
        by_name = {key.lower(): geoms for key, geoms in self.geoms.items()}
        geoms = by_name.get(name.lower())
        return int(self._ids[geoms[0]]) if geoms else HIDDEN

    @rpc("simSetSegmentationObjectID")
    def set_segmentation_id(self, name: str, object_id: int, is_regex: bool = False) -> bool:
        """Set the ID (at most 255) of the objects of a name; -1 leaves them out, in black."""
        if is_regex:
            matches = movables.whole_matches(name, self.geoms, ignore_case=True)
        else:
            matches = [name] if name in self.geoms else []
        for matched in matches:
            self._number(matched, min(max(object_id, HIDDEN), 255))
        return bool(matches)

    @rpc("simListSceneObjects")
    def names(self, expression: str) -> list[str]:
        """Return the object names matched entirely by a regular expression, sorted."""
        return movables.whole_matches(expression, self.geoms)

    @rpc("simGetObjectPose", cosys=2)
    def pose(self, name: str, ned: bool = True) -> Pose:  # noqa: ARG002  # Cosys only
        """Return an object's pose in the world's NED frame; NaN if unknown."""
        if name not in self.geoms:
            return UNKNOWN
        model, data = self._world.model, self.data()
        bodies = (mujoco.mj_name2id(model, _BODY, key) for key in (name, f"{name}/base_link"))
        body = self._bodies.get(name, max(bodies))
        if body >= 0:
            place, turn = data.xpos[body], data.xquat[body]
        else:
            geom = model.geom(name).id
            place, turn = data.geom_xpos[geom], np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        position, rotation = flip_yz(tuple(place.tolist())), flip_yz_rotation(tuple(turn.tolist()))
        return Pose(Vector3r(*position), Quaternionr(*rotation))

    @rpc("simSetObjectPose")
    def set_pose(self, name: str, pose: Pose, teleport: bool = True) -> bool:  # noqa: ARG002
        """Set an object's pose at once; ``False`` if not movable by the settings."""
        qpos = _qpos(pose)
        if name not in self._bodies:
            self._warn("simSetObjectPose", f"{name!r:.80} is not in `movable` of the settings")
            return False
        self._place_body(self._bodies[name], qpos, keep=True)
        return True

    @rpc("simListAssets")
    def assets(self) -> list[str]:
        """Return the assets for ``simSpawnObject``, as given in the settings."""
        return sorted({spare.asset for spare in self._spares.values()})

    @rpc("simSpawnObject")
    def spawn(
        self,
        name: str,
        asset: str,
        pose: Pose,
        scale: Vector3r,
        physics: bool = False,
        blueprint: bool = False,  # noqa: ARG002
    ) -> str:
        """Add a spare object of this scale; return its name, numbered if the name is taken."""
        if len(name) > LONGEST_NAME:
            raise RpcError(f"name: expected up to {LONGEST_NAME} characters, found {len(name)}")
        qpos = _qpos(pose)
        if asset not in self.assets():
            raise RpcError(f"asset: expected one of {self.assets()}, found {asset!r:.80}")
        used = set(self._bodies.values())
        free = [body for body, spare in self._spares.items() if spare.asset == asset]
        if not (free := [body for body in free if body not in used]):
            raise RpcError(f"all objects {asset} are in the world: the settings can have more")
        factors = astuple(scale)
        body = next((body for body in free if self._spares[body].scale == factors), free[0])
        if (fixed := self._spares[body].scale) != factors:
            self._warn("simSpawnObject", f"the scale is {fixed} of the settings, not {factors}")
        name = name or asset
        if name in self.geoms:
            numbered = (f"{name}{number}" for number in itertools.count(1))
            name = next(candidate for candidate in numbered if candidate not in self.geoms)
        self._bodies[name] = body
        geoms = tuple(np.flatnonzero(self._world.model.geom_bodyid == body).tolist())
        self.geoms = dict(sorted({**self.geoms, name: geoms}.items()))
        self._number(name, initial_id(name))
        self._place_body(body, qpos, free=physics)
        return name

    @rpc("simDestroyObject")
    def destroy(self, name: str) -> bool:
        """Remove an object from the world; ``False`` if not movable by the settings."""
        if (body := self._bodies.get(name, -1)) not in self._held:
            return False
        del self._bodies[name], self.geoms[name]
        home = self._home(body)
        if body not in self._spares:
            home[2] += movables.AWAY + 100.0 * (len(self._spares) + body)
        self._place_body(body, home)
        return True

    @rpc("simGetObjectScale")
    def scale(self, name: str) -> Vector3r:
        """Return the scale of a spare object; 1 for other objects, 0 if unknown."""
        if name not in self.geoms:
            return Vector3r()
        spare = self._spares.get(self._bodies.get(name, -1))
        return Vector3r(*(spare.scale if spare else (1.0, 1.0, 1.0)))

    @rpc("simSetObjectScale")
    def set_scale(self, name: str, scale: Vector3r) -> bool:
        """Return whether an object has this scale: scales cannot be changed."""
        return name in self.geoms and self.scale(name) == scale

    def _number(self, name: str, object_id: int) -> None:
        self._ids[list(self.geoms[name])] = object_id

    def _warn(self, method: str, text: str) -> None:
        if method not in self._warned:
            self._warned.add(method)
            self._log.warning("%s: %s", method, text)

    def _home(self, body: int) -> Any:
        start = self._world.model.jnt_qposadr[self._world.model.body_jntadr[body]]
        return self._at_start[2][start : start + 7].copy()

    def _place_body(self, body: int, qpos: Any, *, free: bool = False, keep: bool = False) -> None:
        """Put a body at rest into a pose: held, free, or as before (`keep`)."""
        model, simulation = self._world.model, self._world.simulation
        first = int(model.jnt_qposadr[model.body_jntadr[body]])
        dof = int(model.body_dofadr[body])
        if simulation is None:
            model.qpos0[first : first + 7] = qpos
            return
        simulation.advance_to(self._now())
        if body in self._held:
            if keep:
                free = model.dof_armature[dof] == 0.0
            movables.set_free(model, body, free)
            self._holder.hold(model, body, None if free else qpos)
        simulation.data.qpos[first : first + 7] = qpos
        simulation.data.qvel[dof : dof + 6] = 0.0
        simulation.changed()


class Scenery:
    """Wind, lines of sight, extents, the level, and messages of clients."""

    def __init__(
        self,
        world: SharedWorld,
        vehicles: Vehicles,
        objects: Objects,
        now: Callable[[], int],
        log: NodeLogger,
    ) -> None:
        self._world, self._vehicles, self._objects = world, vehicles, objects
        self._now, self._log = now, log
        self._messages = 0
        self._wind_before: Vector3 | None = None

    @rpc("simSetWind")
    def set_wind(self, velocity: Vector3r) -> None:
        """Set the mean wind, in the world's NED frame; gusts and turbulence of the file stay."""
        wind: Vector3 = astuple(velocity)
        check_strength(wind)
        self._blow(wind)

    def reset(self) -> None:
        """Restore the wind from before clients' changes."""
        if self._wind_before is not None:
            self._blow(self._wind_before)
            self._wind_before = None

    def _blow(self, wind: Vector3) -> None:
        world = self._world
        if world.simulation is not None:
            world.simulation.advance_to(self._now())
        if self._wind_before is None:
            self._wind_before = world.air.velocity if world.air is not None else (0.0, 0.0, 0.0)
        world.set_wind(wind)

    @rpc("simTestLineOfSightToPoint")
    def sees_point(self, point: GeoPoint, vehicle: ServedVehicle = FIRST) -> bool:
        """Return whether nothing is between a vehicle and a place on the earth."""
        return self._is_free(vehicle.state().position, self._in_map(point), vehicle.name)

    @rpc("simTestLineOfSightBetweenPoints")
    def sees_between(self, first: GeoPoint, second: GeoPoint) -> bool:
        """Return whether nothing is between two places on the earth."""
        return self._is_free(self._in_map(first), self._in_map(second))

    @rpc("simGetWorldExtents")
    def extents(self) -> list[GeoPoint]:
        """Return the lowest south-west corner of all finite objects, and the opposite."""
        model, data = self._world.model, self._objects.data()
        geoms_shown = {geom for geoms in self._objects.geoms.values() for geom in geoms}
        bounded = [geom for geom in sorted(geoms_shown) if model.geom_rbound[geom] > 0.0]
        boxes = model.geom_aabb[bounded]
        axes = data.geom_xmat[bounded].reshape(-1, 3, 3)
        middle = data.geom_xpos[bounded] + np.einsum("nij,nj->ni", axes, boxes[:, :3])
        reach = np.einsum("nij,nj->ni", np.abs(axes), boxes[:, 3:])
        north, west, up = (middle + reach).max(axis=0, initial=-1e9).tolist()
        south, east, down = (middle - reach).min(axis=0, initial=1e9).tolist()
        geo_point = self._vehicles.find("").geo_point
        return [geo_point((south, -west, -down)), geo_point((north, -east, -up))]

    @rpc("simLoadLevel")
    def load_level(self, name: str) -> bool:
        """Return whether this is the world's name: another cannot be loaded in a run."""
        return name == self._world.name

    @rpc("simPrintLogMessage")
    def message(self, text: str, parameter: str = "", severity: int = 0) -> None:
        """Log a message: of severity 1 as a warning, of 2 as an error, else as an info."""
        self._messages += 1
        if self._messages <= MOST_MESSAGES:
            write = {1: self._log.warning, 2: self._log.error}.get(severity, self._log.info)
            text = f"{text}{parameter}"[:LONGEST_MESSAGE]
            write("a client says: %s", text if text.isprintable() else ascii(text))

    def _is_free(self, start: Vector3, end: Vector3, vehicle: str = "") -> bool:
        """Return whether nothing but a vehicle is on a straight line, metres in ``map``."""
        model, data = self._world.model, self._objects.data()
        body = mujoco.mj_name2id(model, _BODY, f"{vehicle}/base_link")
        origin, direction = np.array(flip_yz(start)), np.subtract(flip_yz(end), flip_yz(start))
        length = float(np.linalg.norm(direction))
        if not 1e-9 < length < math.inf:
            return length <= 1e-9
        distance, _ = cast_ray(model, data, origin, direction / length, None, body)
        return distance < 0.0 or distance >= length

    def _in_map(self, point: GeoPoint) -> Vector3:
        place: Vector3 = astuple(point)
        if not all(abs(number) <= FARTHEST_PLACE for number in place):
            raise ValueError(f"place: expected up to {FARTHEST_PLACE:g}, found {place}")
        return from_geodetic(place, self._vehicles.find("").config.origin)


def _qpos(pose: Pose) -> Any:
    """Return a free joint's pose, shape (7,); `ValueError` if not finite, a pose, or in reach."""
    place, turn = astuple(pose.position), astuple(pose.orientation)
    length = math.hypot(*turn)
    if not (math.hypot(*place) < FARTHEST and 1e-3 < length < 1e3):
        raise ValueError(
            f"pose: expected one within {FARTHEST:g} m, with a rotation, found {place}, {turn}"
        )
    return np.array([*flip_yz(place), *flip_yz_rotation(tuple(part / length for part in turn))])


def geoms_by_object(model: Any) -> dict[str, tuple[int, ...]]:
    """Return the numbers of the geoms of each object of a model, by its name, sorted."""
    geoms: dict[str, list[int]] = defaultdict(list)
    for geom in range(model.ngeom):
        if mover := mover_of(model, geom):
            geoms[mover].append(geom)
            continue
        if name := model.geom(geom).name:
            geoms[name.removesuffix(LOOK)].append(geom)
        body = int(model.geom_bodyid[geom])
        while body:
            name, body = model.body(body).name, int(model.body_parentid[body])
            if name and (not geoms[name] or geoms[name][-1] != geom):
                geoms[name].append(geom)
    return {name: tuple(geoms[name]) for name in sorted(geoms)}
