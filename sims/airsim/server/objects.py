"""Methods of the objects in the world: their names, and where they are.

An object is a named geom of the model, with its look, or a named body with all its geoms; a
vehicle, or a body that moves by itself, is one object whatever it is made of.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import msgspec
import mujoco
import numpy as np

from events.frames import flip_yz, flip_yz_rotation
from sims.airsim.server.methods import RpcError, rpc
from sims.airsim.server.movables import (
    AWAY,
    HELD,
    Holder,
    have_met,
    movable_bodies,
    set_free,
    spare_objects,
)
from sims.airsim.server.regex import whole_matches
from sims.airsim.structures import NAN, Pose, Quaternionr, Vector3r
from sims.cameras.stage import LOOK
from sims.vehicle.model import mover_of

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

FARTHEST = 1e4
"""Metres from the origin within which objects can be put."""

LONGEST_NAME = 100
"""Characters of the name of an object that is brought in."""

_BODY = mujoco.mjtObj.mjOBJ_BODY

UNKNOWN = Pose(Vector3r(NAN, NAN, NAN), Quaternionr(NAN, NAN, NAN, NAN))
"""Pose of an object that is not there."""


class Objects:
    """The objects of the world.

    Whatever changes them does so at the instant of the request.

    Attributes:
        geoms: Numbers of each object's geoms in the model, by the object's name, sorted.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._world = server.world
        self._still: Any = None
        self._warned: set[str] = set()
        model, config = self._world.model, server.config
        spares = spare_objects(server.name, config.objects)
        self._spares = {model.body(name).id: spec for name, spec in spares.items()}
        self.geoms = {
            name: geoms
            for name, geoms in geoms_by_object(model).items()
            if model.geom_bodyid[geoms[0]] not in self._spares
        }
        bodies = movable_bodies(model)
        self._bodies = {name: body for name, body in bodies.items() if name in self.geoms}
        armature = {body: model.dof_armature[model.body_dofadr[body]] for body in bodies.values()}
        self._held = {body for body in armature if armature[body] == HELD or body in self._spares}
        self._at_start = dict(self._bodies), dict(self.geoms), model.qpos0.copy()
        if self._held and self._world.simulation is not None:
            have_met(model)
            self._holder = Holder.of(self._world.simulation)
        for body in self._held:
            self._put(body, self._home(body))

    def reset(self) -> None:
        """Bring all objects back to where they were at the start."""
        self._bodies = dict(self._at_start[0])
        self._show(dict(self._at_start[1]))
        for body in {*self._bodies.values(), *self._held}:
            self._put(body, self._home(body))

    def data(self) -> Any:
        """Return MuJoCo's data of the world at the present time, with positions computed."""
        simulation, now = self._world.simulation, self._server.clock.now()
        if simulation is not None:
            simulation.advance_to(now)
            simulation.refresh()
            return simulation.data
        if self._still is None:
            self._still = mujoco.MjData(self._world.model)
        _, self._still.qpos[:], _ = self._world.state_at(now)
        self._world.dynamics.apply(self._world.model, self._still, now * 1e-9)
        mujoco.mj_kinematics(self._world.model, self._still)
        return self._still

    def pose(self, name: str) -> Pose:
        """Return where an object is in ``map``; `UNKNOWN` if it is not there."""
        if name not in self.geoms:
            return UNKNOWN
        model, data = self._world.model, self.data()
        bodies = (mujoco.mj_name2id(model, _BODY, each) for each in (name, f"{name}/base_link"))
        body = self._bodies.get(name, max(bodies))
        if body >= 0:
            place, turn = data.xpos[body], data.xquat[body]
        else:
            geom = model.geom(name).id
            place, turn = data.geom_xpos[geom], np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
        position, rotation = flip_yz(tuple(place.tolist())), flip_yz_rotation(tuple(turn.tolist()))
        return Pose(Vector3r(*position), Quaternionr(*rotation))

    def name_of(self, touched: str) -> str:
        """Return the name of the object that a geom or body is of, by its name in the model.

        A spare object that is in the world has another one than its body.
        """
        model = self._world.model
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, touched)
        body = mujoco.mj_name2id(model, _BODY, touched)
        body = int(model.geom_bodyid[geom]) if geom >= 0 else body
        return next((name for name, each in self._bodies.items() if each == body), touched)

    @rpc("simListSceneObjects")
    def names(self, expression: str) -> list[str]:
        """Return the names of objects that a regular expression matches as a whole, sorted."""
        return whole_matches(expression, self.geoms)

    @rpc("simGetObjectPose", cosys=2)
    def object_pose(self, name: str, ned: bool = True) -> Pose:  # noqa: ARG002  # Cosys only
        """Return an object's pose in the world's NED frame; NaN of one that is not known."""
        return self.pose(name)

    @rpc("simSetObjectPose")
    def set_pose(self, name: str, pose: Pose, teleport: bool = True) -> bool:  # noqa: ARG002
        """Put an object somewhere at once; ``False`` of one that the settings do not let move."""
        qpos = _qpos(pose)
        if name not in self._bodies:
            self._warn("simSetObjectPose", f"{name!r:.80} is not in `movable` of the settings")
            return False
        self._put(self._bodies[name], qpos, keep=True)
        return True

    @rpc("simListAssets")
    def assets(self) -> list[str]:
        """Return what ``simSpawnObject`` can bring in, as the settings say."""
        return sorted({each.asset for each in self._spares.values()})

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
        """Bring in a spare object of the settings, of this scale if there is one; return its name.

        Of a name that is taken it is one with a number.
        """
        if len(name) > LONGEST_NAME:
            raise RpcError(f"name: expected up to {LONGEST_NAME} characters, found {len(name)}")
        qpos = _qpos(pose)
        if asset not in self.assets():
            raise RpcError(f"asset: expected one of {self.assets()}, found {asset!r:.80}")
        used = set(self._bodies.values())
        free = [body for body, spare in self._spares.items() if spare.asset == asset]
        if not (free := [body for body in free if body not in used]):
            raise RpcError(f"all objects {asset} are in the world: the settings can have more")
        wanted = scale.x_val, scale.y_val, scale.z_val
        body = next((each for each in free if self._spares[each].scale == wanted), free[0])
        if (found := self._spares[body].scale) != wanted:
            self._warn("simSpawnObject", f"the scale is {found} of the settings, not {wanted}")
        name = name or asset
        numbered = (f"{name}{number}" for number in itertools.count(1))
        if name in self.geoms:
            name = next(each for each in numbered if each not in self.geoms)
        self._bodies[name] = body
        geoms = tuple(np.flatnonzero(self._world.model.geom_bodyid == body).tolist())
        self._show(self.geoms | {name: geoms})
        self._server.segmentation.added(name)
        self._put(body, qpos, free=physics)
        return name

    @rpc("simDestroyObject")
    def destroy(self, name: str) -> bool:
        """Take an object out of the world; ``False`` of one that the settings do not let move."""
        if (body := self._bodies.get(name, -1)) not in self._held:
            return False
        del self._bodies[name]
        self._show({each: geoms for each, geoms in self.geoms.items() if each != name})
        away = self._home(body)
        if body not in self._spares:
            away[2] += AWAY + 100.0 * (len(self._spares) + body)
        self._put(body, away)
        return True

    @rpc("simGetObjectScale")
    def scale(self, name: str) -> Vector3r:
        """Return the scale of a spare object, 1 of all else, and 0 of what is not known."""
        if name not in self.geoms:
            return Vector3r()
        spare = self._spares.get(self._bodies.get(name, -1))
        return Vector3r(*(spare.scale if spare else (1.0, 1.0, 1.0)))

    @rpc("simSetObjectScale")
    def set_scale(self, name: str, scale: Vector3r) -> bool:
        """Return whether an object has this scale: it cannot be changed."""
        return name in self.geoms and self.scale(name) == scale

    def _warn(self, method: str, text: str) -> None:
        """Log what a method does not do as asked, when it first happens."""
        if method not in self._warned:
            self._warned.add(method)
            self._server.log.warning("%s: %s", method, text)

    def _home(self, body: int) -> Any:
        begin = self._world.model.jnt_qposadr[self._world.model.body_jntadr[body]]
        return self._at_start[2][begin : begin + 7].copy()

    def _show(self, geoms: dict[str, tuple[int, ...]]) -> None:
        self.geoms.clear()
        self.geoms.update(sorted(geoms.items()))

    def _put(self, body: int, qpos: Any, *, free: bool = False, keep: bool = False) -> None:
        """Put a body somewhere, at rest: held, free, or as it was (`keep`)."""
        model, simulation = self._world.model, self._world.simulation
        begin = int(model.jnt_qposadr[model.body_jntadr[body]])
        dof = int(model.body_dofadr[body])
        if simulation is None:
            model.qpos0[begin : begin + 7] = qpos
            return
        simulation.advance_to(self._server.clock.now())
        if body in self._held:
            if keep:
                free = model.dof_armature[dof] == 0.0
            set_free(model, body, free)
            self._holder.hold(model, body, None if free else qpos)
        simulation.data.qpos[begin : begin + 7] = qpos
        simulation.data.qvel[dof : dof + 6] = 0.0
        simulation.changed()


def _qpos(pose: Pose) -> Any:
    """Return a pose as a free joint has it, shape (7,).

    Raises:
        ValueError: It is not finite, or no pose, or beyond all worlds.
    """
    place = msgspec.structs.astuple(pose.position)
    turn = msgspec.structs.astuple(pose.orientation)
    length = math.hypot(*turn)
    if not (math.hypot(*place) < FARTHEST and 1e-3 < length < 1e3):
        raise ValueError(
            f"pose: expected one within {FARTHEST:g} m, with a rotation, found {place}, {turn}"
        )
    return np.array([*flip_yz(place), *flip_yz_rotation(tuple(each / length for each in turn))])


def geoms_by_object(model: Any) -> dict[str, tuple[int, ...]]:
    """Return the numbers of the geoms of each object of a model, by its name, sorted."""
    found: dict[str, list[int]] = defaultdict(list)
    for geom in range(model.ngeom):
        if mover := mover_of(model, geom):
            found[mover].append(geom)
            continue
        if name := model.geom(geom).name:
            found[name.removesuffix(LOOK)].append(geom)
        body = int(model.geom_bodyid[geom])
        while body:
            name, body = model.body(body).name, int(model.body_parentid[body])
            if name and (not found[name] or found[name][-1] != geom):
                found[name].append(geom)
    return {name: tuple(found[name]) for name in sorted(found)}
