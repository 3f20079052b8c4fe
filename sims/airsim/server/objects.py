"""Methods of the objects in the world: their names, and where they are.

An object is a named geom of the model, with its look, or a named body with all its geoms; a
vehicle, or a body that moves by itself, is one object whatever it is made of.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from events.frames import flip_yz, flip_yz_rotation
from sims.airsim.server.methods import rpc
from sims.airsim.server.regex import whole_matches
from sims.airsim.structures import NAN, Pose, Quaternionr, Vector3r
from sims.cameras.stage import LOOK
from sims.vehicle.model import mover_of

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

UNKNOWN = Pose(Vector3r(NAN, NAN, NAN), Quaternionr(NAN, NAN, NAN, NAN))
"""Pose of an object that is not there."""


class Objects:
    """The objects of the world.

    Attributes:
        geoms: Numbers of each object's geoms in the model, by the object's name, sorted.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._world = server.world
        self._still: Any = None
        self.geoms = geoms_by_object(self._world.model)

    def reset(self) -> None:
        """Bring all objects back to where they were at the start."""

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
        for body in (name, f"{name}/base_link"):
            number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
            if number >= 0:
                place, turn = data.xpos[number], data.xquat[number]
                break
        else:
            number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
            place, turn = data.geom_xpos[number], np.zeros(4)
            mujoco.mju_mat2Quat(turn, data.geom_xmat[number])
        position, rotation = flip_yz(tuple(place.tolist())), flip_yz_rotation(tuple(turn.tolist()))
        return Pose(Vector3r(*position), Quaternionr(*rotation))

    @rpc("simListSceneObjects")
    def names(self, expression: str) -> list[str]:
        """Return the names of objects that a regular expression matches as a whole, sorted."""
        return whole_matches(expression, self.geoms)

    @rpc("simGetObjectPose", cosys=2)
    def object_pose(self, name: str, ned: bool = True) -> Pose:  # noqa: ARG002  # Cosys only
        """Return an object's pose in the world's NED frame; NaN of one that is not known."""
        return self.pose(name)


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
