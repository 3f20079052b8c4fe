"""Movable parts of a world for scripts: settings, and bodies of the model.

Each is a body with a free joint, whose pose physics, cameras and lidars know anyway. A held body is
heavy, has no weight, and is put back at each millisecond: it is a wall to others, and does not meet
the world, which would push it out.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from sims.cameras.stage import LOOK
from sims.vehicle import Simulation
from sims.worlds import Scene
from sims.worlds.bodies import COLOURS, SIZES, Kind, add_shape

Factor = Annotated[float, msgspec.Meta(ge=0.01, le=1000)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Basic = Literal["Cube", "Sphere", "Cylinder", "Cone"]

AWAY = 1e5  # metres above the world, beyond what cameras see, at which what is not there is kept
# Inertia that a held body has in addition, kg and kg m²: far more than a vehicle's.
HELD = 100.0
# Bits of MuJoCo's ``contype`` and ``conaffinity``: what geoms are and meet.
WORLD, MOVABLE = 1, 2
# Of an expression: characters, repetitions, and alternatives; a repetition counts as three.
LONGEST, MOST_REPETITIONS, MOST_CHOICES = 200, 3, 12

_PIECE = re.compile(r"\\.|\[\^?\]?(?:\\.|[^\]\\])*\]|\(\?|\)?(?:[*+?]|\{[\d,]*\})|.", re.DOTALL)
_TYPES = {
    "Cube": mujoco.mjtGeom.mjGEOM_BOX,
    "Sphere": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "Cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "Cone": mujoco.mjtGeom.mjGEOM_MESH,
}
_COPIED = (
    *("conaffinity", "condim", "contype", "density", "friction", "gap", "group", "margin", "mass"),
    *("material", "meshname", "name", "priority", "rgba", "size", "solimp", "solmix", "solref"),
    "type",
)


class SpareObject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of spare objects for ``simSpawnObject``.

    Attributes:
        asset: Kind: one of AirSim's shapes of 1 m about their middle (a cylinder and a cone stand
            upright), or a ``person``, ``car``, ``door`` or ``box``, which stands on its position.
        scale: Factors on length, width and height, which cannot be changed later.
        count: Maximum number of them at a time.
        colour: Red, green, blue, 0 to 1; by default grey or the kind's. A cylinder is as wide as
            long.
    """

    asset: Basic | Kind
    scale: tuple[Factor, Factor, Factor] = (1.0, 1.0, 1.0)
    count: Annotated[int, msgspec.Meta(ge=1, le=100)] = 1
    colour: tuple[Share, Share, Share] | None = None


def spare_objects(node: str, specs: tuple[SpareObject, ...]) -> dict[str, SpareObject]:
    """Return the spare objects of a server's settings, by the names of their bodies."""
    spares = (spec for spec in specs for _ in range(spec.count))
    return {f"{node}/{spec.asset}_{number}": spec for number, spec in enumerate(spares)}


def add_movables(
    scene: Scene, node: str, specs: tuple[SpareObject, ...], movable: tuple[str, ...]
) -> None:
    """Add spare and free movable parts, held; `ValueError` for an expression without any."""
    if not specs and not movable:
        return
    world = scene.spec.copy().compile()
    # MuJoCo's means over all bodies stay as without these.
    for name in ("meanmass", "meansize", "extent", "center"):
        setattr(scene.spec.stat, name, getattr(world.stat, name))
    names = []
    for number, (name, spec) in enumerate(spare_objects(node, specs).items()):
        _add_spare(scene, name, spec, (0.0, 0.0, AWAY + 100.0 * number))
        names.append(name)
    for expression in movable:
        names += _free(scene.spec, world, expression)
    for geom in (geom for name in names for geom in scene.spec.body(name).geoms):
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = MOVABLE, 0


def movable_bodies(model: Any) -> dict[str, int]:
    """Return name and number of each body with a free joint, but vehicles."""
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    named = {model.body(int(body)).name: int(body) for body in model.jnt_bodyid[joints]}
    return {name: body for name, body in named.items() if not name.endswith("/base_link")}


def enable_collisions(model: Any) -> None:
    """Make vehicles and all other moving bodies collide with held bodies."""
    free = (model.body_weldid[model.geom_bodyid] != 0) & (model.geom_contype == WORLD)
    model.geom_conaffinity[free] |= MOVABLE
    for body in np.unique(model.geom_bodyid[free]):
        model.body_conaffinity[body] |= MOVABLE


def set_free(model: Any, body: int, free: bool) -> None:
    """Let physics move a body (`free`), or make the body holdable; after `enable_collisions`."""
    dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + 6)
    geoms = (model.geom_bodyid == body) & (model.geom_contype != 0)
    model.body_gravcomp[body] = 0.0 if free else 1.0
    model.dof_armature[dofs] = 0.0 if free else HELD
    for element, chosen in (("geom", geoms), ("body", body)):
        getattr(model, f"{element}_contype")[chosen] = WORLD if free else MOVABLE
        getattr(model, f"{element}_conaffinity")[chosen] = WORLD | MOVABLE if free else 0
    # Values that MuJoCo computes when it compiles a model.
    model.dof_M0[dofs] = [*[model.body_mass[body]] * 3, *model.body_inertia[body]]
    model.dof_M0[dofs] += model.dof_armature[dofs]
    straight, turn = (1.0 / model.dof_M0[dofs]).reshape(2, 3).mean(axis=1)
    model.body_invweight0[body] = straight, turn
    model.dof_invweight0[dofs] = np.repeat((straight, turn), 3)


class Holder:
    """Influence on a simulation that holds bodies at given poses."""

    @classmethod
    def of(cls, simulation: Simulation) -> Holder:
        """Return the holder of a simulation, added at the first request."""
        holders = [holder for holder in simulation.influences if isinstance(holder, Holder)]
        if not holders:
            holders.append(cls())
            simulation.add_influence(holders[0])
        return holders[0]

    def __init__(self) -> None:
        self._poses: dict[int, Any] = {}
        self._positions = self._velocities = np.empty(0, np.intp)
        self._held_poses = np.empty(0)

    def hold(self, model: Any, body: int, pose: Any) -> None:
        """Hold a body at its free joint's pose, shape (7,); `None` releases the body."""
        self._poses.pop(body, None)
        if pose is not None:
            self._poses[body] = pose
        bodies = list(self._poses)
        dofs = model.body_dofadr[bodies]
        poses = model.jnt_qposadr[model.body_jntadr[bodies]]
        self._positions = np.add.outer(poses, np.arange(7)).ravel()
        self._velocities = np.add.outer(dofs, np.arange(6)).ravel()
        self._held_poses = np.concatenate([*self._poses.values(), np.empty(0)])

    def apply(self, model: Any, data: Any, seconds: float) -> None:  # noqa: ARG002
        """Set all bodies to their poses."""
        data.qpos[self._positions] = self._held_poses
        data.qvel[self._velocities] = 0.0


def _add_spare(
    scene: Scene, name: str, spec: SpareObject, place: tuple[float, float, float]
) -> None:
    body = _add_held_body(scene.spec, name, pos=place)
    if spec.asset in COLOURS:
        kind: Any = spec.asset
        length, width, height = (a * b for a, b in zip(SIZES[kind], spec.scale, strict=True))
        add_shape(scene, body, kind, (length, width, height), spec.colour or COLOURS[kind])
        return
    x, y, z = (0.5 * length for length in spec.scale)
    options: dict[str, Any] = {"size": [x, z, 0.0] if spec.asset == "Cylinder" else [x, y, z]}
    if spec.asset == "Cone":
        turns = np.arange(24) * math.pi / 12
        vertices = [(x * math.cos(turn), y * math.sin(turn), -z) for turn in turns]
        scene.spec.add_mesh(name=name, uservert=np.ravel([(0.0, 0.0, z), *vertices]))
        options = {"meshname": name}
    rgba = [*(spec.colour or (0.6, 0.6, 0.6)), 1.0]
    body.add_geom(type=_TYPES[spec.asset], rgba=rgba, group=0, **options)


def _free(spec: Any, world: Any, expression: str) -> list[str]:
    geoms = {geom.name: geom for geom in spec.worldbody.geoms if geom.name}
    bodies = {body.name: body for body in spec.worldbody.bodies if body.name}
    fixed = {name: body for name, body in bodies.items() if not body.joints and not body.mocap}
    matches = whole_matches(expression, [name for name in geoms if not name.endswith(LOOK)])
    for name in matches:
        parts = [geoms[key] for key in (name, name + LOOK) if key in geoms]
        if any(part.type == mujoco.mjtGeom.mjGEOM_PLANE for part in parts):
            raise ValueError(f"movable: expected what can be moved, found {name}, a plane")
        pose = _pose(world, name)
        body = _add_held_body(spec, name, **_options(pose))
        body.explicitinertial, body.mass, body.inertia = True, 100.0, [10.0, 10.0, 10.0]
        for part in parts:
            options = {key: getattr(part, key) for key in _COPIED}
            options |= _options(np.linalg.inv(pose) @ _pose(world, part.name))
            if part.type != mujoco.mjtGeom.mjGEOM_MESH:
                options["size"] = world.geom(part.name).size  # of a capsule between two points
            spec.delete(part)
            body.add_geom(**options)
    names = whole_matches(expression, fixed)
    for name in names:
        fixed[name].add_joint(type=mujoco.mjtJoint.mjJNT_FREE, armature=HELD)
        fixed[name].gravcomp = 1.0
    if not matches and not names:
        raise ValueError(
            f"movable: expected names of geoms or of bodies without joints, found {expression}"
        )
    return matches + names


def _pose(world: Any, geom: str) -> Any:
    """Return the pose, in its file, of a geom of the world itself, shape (4, 4)."""
    number = world.geom(geom).id
    pose = _matrix(world.geom_pos[number], world.geom_quat[number])
    if world.geom_type[number] != mujoco.mjtGeom.mjGEOM_MESH:
        return pose
    mesh = world.geom_dataid[number]  # MuJoCo has moved it to its centre of mass
    return pose @ np.linalg.inv(_matrix(world.mesh_pos[mesh], world.mesh_quat[mesh]))


def _matrix(place: Any, turn: Any) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(turn, scalar_first=True).as_matrix()
    matrix[:3, 3] = place
    return matrix


def _options(pose: Any) -> dict[str, Any]:
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    return {"pos": pose[:3, 3], "quat": turn}


def _add_held_body(spec: Any, name: str, **options: Any) -> Any:
    body = spec.worldbody.add_body(name=name, gravcomp=1.0, **options)
    body.add_joint(type=mujoco.mjtJoint.mjJNT_FREE, armature=HELD)
    return body


def whole_matches(expression: str, texts: Iterable[str], *, ignore_case: bool = False) -> list[str]:
    """Return the texts matched by a client's regular expression from beginning to end.

    None may keep the run waiting: the time of Python's search grows with the text's length to the
    power of the repetitions, without bounds if nested; each alternative in groups may double it.

    Raises:
        ValueError: It is no expression; or it is longer, has more repetitions (``*``, ``+``, ``?``,
            ``{2,3}``) than are allowed, or repeats a group.
    """
    pieces = [piece for piece in _PIECE.findall(expression) if piece[0] not in "\\["]
    repetitions = [piece for piece in pieces if piece[-1] in "*+?}" and piece not in ("(?", "}")]
    if len(expression) > LONGEST or len(repetitions) > MOST_REPETITIONS:
        raise _error(f"up to {LONGEST} characters and {MOST_REPETITIONS} repetitions", expression)
    if 3 * len(repetitions) + pieces.count("|") > MOST_CHOICES:
        raise _error("fewer alternatives", expression)
    if any(piece[0] == ")" for piece in repetitions):
        raise _error("no repeated group", expression)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what Python may read otherwise one day
            matches = re.compile(expression, re.IGNORECASE if ignore_case else 0).fullmatch
    except (re.error, OverflowError, RecursionError) as error:
        raise _error(f"one that can be read ({error})", expression) from None
    return [text for text in texts if matches(text)]


def _error(expected: str, expression: str) -> ValueError:
    return ValueError(f"regular expression: expected {expected}, found {expression!r:.80}")
