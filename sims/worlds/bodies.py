"""Bodies that move by themselves: people, cars, doors and boxes, on splines and hinges.

Their settings are in ``map`` (NED); what is built of them, in MuJoCo's axes (NWU).
"""

from __future__ import annotations

import math
from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import mujoco

from events import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation
from events.rotations import from_yaw
from runtime.units import Duration
from sims.worlds.curves import Path, interpolated, path_through
from sims.worlds.dynamics import Dynamics, Scene

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Kind = Literal["person", "car", "door", "box"]

SIZES: dict[Kind, Vector3] = {
    "person": (0.36, 0.52, 1.76),
    "car": (4.1, 1.75, 1.45),
    "door": (0.92, 0.045, 2.05),
    "box": (0.6, 0.6, 0.6),
}
"""Length along the heading, width, height, metres, unless the settings say another."""

COLOURS: dict[Kind, Vector3] = {
    "person": (0.75, 0.22, 0.14),
    "car": (0.16, 0.30, 0.52),
    "door": (0.50, 0.34, 0.20),
    "box": (0.62, 0.48, 0.30),
}


class BodySpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a body that moves by itself.

    Attributes:
        name: Its name, unique in the world; its source is ``<node>/<name>``.
        kind: What it is: ``person``, ``car``, ``door`` or ``box``.
        waypoints: Places that it passes on a smooth curve, the middle of its foot, metres in
            ``map``. Its heading is that of its way. One place: it stands there. Of a door: its
            hinge.
        times: When it is at each waypoint, and in a loop once more at the first. If left out,
            `speed` says it.
        speed: Mean speed on the straight lines between the waypoints, metres per second.
        loop: Whether it returns from the last waypoint to the first and goes on for ever; else it
            starts and ends at rest.
        heading: Heading of what stands, degrees clockwise from north; of a door: that of its
            panel when it is closed.
        angles: Of a door: how far it is open at each of the `times`, degrees clockwise seen from
            above. In a loop the last is the first.
        size: Length along its heading, width and height, metres; that of its kind if left out.
        colour: Red, green and blue, 0 to 1; that of its kind if left out.
    """

    name: Annotated[str, msgspec.Meta(min_length=1, pattern="^[A-Za-z0-9_]+$")]
    kind: Kind
    waypoints: Annotated[tuple[Vector3, ...], msgspec.Meta(min_length=1)]
    times: tuple[Duration, ...] = ()
    speed: Positive = 1.0
    loop: bool = True
    heading: float = 0.0
    angles: tuple[float, ...] = ()
    size: tuple[Positive, Positive, Positive] | None = None
    colour: tuple[Share, Share, Share] | None = None

    def __post_init__(self) -> None:
        where = f"bodies: {self.name}"
        if self.kind == "door" and len(self.waypoints) != 1:
            raise ValueError(
                f"{where}: waypoints: expected one, a door's hinge, found {len(self.waypoints)}"
            )
        if (self.kind == "door") != bool(self.angles):
            raise ValueError(f"{where}: angles: expected some of a door, and of nothing else")
        moves = len(self.waypoints) > 1
        needed = len(self.angles) or (len(self.waypoints) + self.loop if moves else 0)
        if len(self.times) != needed and (self.times or self.angles):
            raise ValueError(f"{where}: times: expected {needed}, found {len(self.times)}")
        if any(after <= before for before, after in pairwise(self.times)):
            raise ValueError(f"{where}: times: expected rising ones, found {list(self.times)}")
        if self.loop and self.angles and self.angles[0] != self.angles[-1]:
            raise ValueError(
                f"{where}: angles: expected a loop to end as it begins, with {self.angles[0]:g}, "
                f"found {self.angles[-1]:g}"
            )
        if moves and any(a == b for a, b in pairwise(self.places())):
            raise ValueError(f"{where}: waypoints: expected no two neighbours alike")

    def places(self) -> tuple[Vector3, ...]:
        """Return the waypoints, of a loop with the first one again at the end."""
        return self.waypoints + (self.waypoints[:1] if self.loop else ())


class BodyMotion(NamedTuple):
    """Where a body is at each time.

    Attributes:
        name: Name of the MuJoCo body, which is a mocap body.
        place: Where it stands, metres NED, if it has no path.
        yaw: Its heading there, radians.
        path: Its way, if it has one.
        times: Of a door.
        angles: Of a door, radians, at those times.
        loop: Whether a door does the same again and again.
    """

    name: str
    place: Vector3
    yaw: float
    path: Path | None = None
    times: tuple[float, ...] = ()
    angles: tuple[float, ...] = ()
    loop: bool = False

    @property
    def solid(self) -> bool:
        """Whether vehicles can touch it: always."""
        return True

    def pose(self, seconds: float) -> tuple[Vector3, Quaternion]:
        """Return its foot's place, metres NED, and its rotation (FRD → NED) at a time."""
        if self.path is not None:
            place, yaw = self.path.at(seconds)
            return place, from_yaw(yaw)
        yaw = self.yaw
        if self.angles:
            yaw += interpolated(self.times, self.angles, seconds, loop=self.loop, smooth=True)
        return self.place, from_yaw(yaw)

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Put it where it is at a time."""
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, self.name)
        place, turn = self.pose(seconds)
        mocap = model.body_mocapid[body]
        data.mocap_pos[mocap] = flip_yz(place)
        data.mocap_quat[mocap] = flip_yz_rotation(turn)


def motion_of(spec: BodySpec, name: str) -> BodyMotion:
    """Return how a body of these settings moves, as the MuJoCo body of a name."""
    yaw = math.radians(spec.heading)
    if len(spec.waypoints) == 1:
        angles = tuple(math.radians(angle) for angle in spec.angles)
        times = tuple(float(each) for each in spec.times)
        return BodyMotion(name, spec.waypoints[0], yaw, None, times, angles, spec.loop)
    places = spec.places()
    legs = (math.dist(a, b) / spec.speed for a, b in pairwise(places))
    times = spec.times or tuple(accumulate(legs, initial=0.0))
    path = path_through(places, times, loop=spec.loop, yaw=yaw)
    return BodyMotion(name, spec.waypoints[0], yaw, path)


def add_bodies(scene: Scene, node: str, specs: tuple[BodySpec, ...]) -> Dynamics:
    """Put bodies into a world, each called ``<node>/<name>``, and return how they move.

    Raises:
        ValueError: Two have one name.
    """
    motions = []
    for spec in specs:
        name = f"{node}/{spec.name}"
        if scene.spec.body(name) is not None:
            raise ValueError(f"bodies: expected a name for each, found two called {spec.name}")
        motion = motion_of(spec, name)
        place, turn = motion.pose(0.0)
        body = scene.spec.worldbody.add_body(
            name=name, mocap=True, pos=flip_yz(place), quat=flip_yz_rotation(turn)
        )
        _SHAPES[spec.kind](_Shape(scene.spec, body, name, spec))
        motions.append(motion)
    return Dynamics(tuple(motions))


class _Shape:
    """Adds parts to a body; x is ahead, y left, z up, in shares of its length, width and height."""

    def __init__(self, world: Any, body: Any, name: str, spec: BodySpec) -> None:
        self._world = world
        self._body = body
        self._name = name
        self.colour: Vector3 = spec.colour or COLOURS[spec.kind]
        self._size = spec.size or SIZES[spec.kind]
        self._parts = 0

    def cloth(self, part: str, colour: Vector3, *, marks: Vector3 | None = None) -> str:
        """Return a material with small marks on it, so that it is not smooth to a camera."""
        name = f"{self._name}/{part}"
        self._world.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_CUBE,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=colour,
            rgb2=[0.75 * each for each in colour],
            mark=mujoco.mjtMark.mjMARK_RANDOM,
            markrgb=marks or [min(1.25 * each + 0.08, 1.0) for each in colour],
            random=0.06,
            width=64,
            height=64,
        )
        material = self._world.add_material(name=name, specular=0.15, shininess=0.2)
        textures = list(material.textures)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.textures = textures
        return name

    def part(
        self,
        kind: Any,
        half: Vector3,
        place: Vector3,
        *,
        material: str = "",
        rgb: Vector3 = (1.0, 1.0, 1.0),
        quat: Quaternion = (1.0, 0.0, 0.0, 0.0),
    ) -> None:
        """Add a part: a primitive, solid and seen, of half lengths."""
        self._parts += 1
        length, width, height = self._size
        self._body.add_geom(
            name=f"{self._name}/part_{self._parts}",
            type=kind,
            size=[half[0] * length, half[1] * width, half[2] * height],
            pos=[place[0] * length, place[1] * width, place[2] * height],
            quat=quat,
            material=material,
            rgba=[*rgb, 1.0],
            group=0,
        )

    def limb(self, radius: float, top: Vector3, bottom: Vector3, *, material: str = "") -> None:
        """Add a capsule between two places; its radius is a share of the width."""
        self._parts += 1
        ends = [
            share * size
            for end in (top, bottom)
            for share, size in zip(end, self._size, strict=True)
        ]
        self._body.add_geom(
            name=f"{self._name}/part_{self._parts}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=ends,
            size=[radius * self._size[1], 0.0, 0.0],
            material=material,
            group=0,
        )


_BOX, _BALL = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID
_WHEEL = mujoco.mjtGeom.mjGEOM_CYLINDER
_SIDEWAYS: Quaternion = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)


def _person(shape: _Shape) -> None:
    jacket = shape.cloth("jacket", shape.colour)
    trousers = shape.cloth("trousers", (0.16, 0.19, 0.28))
    skin = shape.cloth("skin", (0.72, 0.53, 0.42), marks=(0.66, 0.45, 0.36))
    for side, ahead in ((1, 0.42), (-1, -0.42)):  # in the middle of a step
        shape.limb(
            0.15, (0.0, side * 0.18, 0.49), (ahead * 0.4, side * 0.18, 0.28), material=trousers
        )
        shape.limb(
            0.12, (ahead * 0.4, side * 0.18, 0.28), (ahead, side * 0.18, 0.05), material=trousers
        )
        shape.part(
            _BALL, (0.36, 0.1, 0.03), (ahead + 0.18, side * 0.18, 0.03), rgb=(0.1, 0.09, 0.08)
        )
        shape.limb(
            0.1, (0.0, side * 0.42, 0.78), (-ahead * 0.4, side * 0.46, 0.62), material=jacket
        )
        shape.limb(
            0.085,
            (-ahead * 0.4, side * 0.46, 0.62),
            (-ahead * 0.9, side * 0.44, 0.5),
            material=jacket,
        )
        shape.part(_BALL, (0.13, 0.07, 0.03), (-ahead, side * 0.44, 0.475), material=skin)
    shape.part(_BALL, (0.36, 0.4, 0.2), (0.0, 0.0, 0.66), material=jacket)
    shape.limb(0.24, (0.0, 0.14, 0.76), (0.0, -0.14, 0.76), material=jacket)
    shape.limb(0.11, (0.0, 0.0, 0.84), (0.03, 0.0, 0.87), material=skin)
    shape.part(_BALL, (0.28, 0.145, 0.07), (0.04, 0.0, 0.925), material=skin)
    shape.part(_BALL, (0.29, 0.155, 0.055), (-0.02, 0.0, 0.95), rgb=(0.2, 0.14, 0.09))


def _car(shape: _Shape) -> None:
    paint = shape.cloth("paint", shape.colour)
    glass = (0.09, 0.11, 0.13)
    shape.part(_BOX, (0.49, 0.47, 0.2), (0.0, 0.0, 0.38), material=paint)
    shape.part(_BOX, (0.5, 0.44, 0.07), (0.0, 0.0, 0.3), rgb=(0.16, 0.16, 0.17))
    shape.part(_BOX, (0.27, 0.42, 0.17), (-0.05, 0.0, 0.74), rgb=glass)
    shape.part(_BOX, (0.24, 0.43, 0.035), (-0.05, 0.0, 0.95), material=paint)
    for x in (-0.31, -0.06, 0.21):  # pillars
        for y in (-0.41, 0.41):
            shape.part(_BOX, (0.012, 0.03, 0.18), (x, y, 0.75), material=paint)
    for x in (-0.31, 0.31):
        for y in (-0.43, 0.43):
            shape.part(
                _WHEEL, (0.078, 0.05, 0.0), (x, y, 0.22), rgb=(0.05, 0.05, 0.05), quat=_SIDEWAYS
            )
            shape.part(
                _WHEEL, (0.045, 0.056, 0.0), (x, y, 0.22), rgb=(0.6, 0.6, 0.62), quat=_SIDEWAYS
            )
    for y in (-0.33, 0.33):
        shape.part(_BALL, (0.012, 0.08, 0.05), (0.488, y, 0.45), rgb=(0.95, 0.94, 0.85))
        shape.part(_BOX, (0.006, 0.09, 0.04), (-0.489, y, 0.47), rgb=(0.7, 0.08, 0.06))
    shape.part(_BOX, (0.004, 0.16, 0.04), (-0.492, 0.0, 0.33), rgb=(0.9, 0.9, 0.86))


def _door(shape: _Shape) -> None:
    wood = shape.cloth("wood", shape.colour)
    dark = shape.cloth("panel", tuple(0.8 * each for each in shape.colour))  # type: ignore[arg-type]
    shape.part(_BOX, (0.5, 0.5, 0.5), (0.5, 0.0, 0.5), material=wood)
    for low, high in ((0.06, 0.46), (0.54, 0.94)):
        middle, half = (low + high) / 2, (high - low) / 2
        shape.part(_BOX, (0.36, 0.58, half), (0.5, 0.0, middle), material=dark)
    for side in (-1, 1):
        shape.part(_BALL, (0.06, 0.4, 0.012), (0.92, side * 1.1, 0.5), rgb=(0.75, 0.72, 0.6))


def _box(shape: _Shape) -> None:
    board = shape.cloth("board", shape.colour, marks=(0.35, 0.26, 0.16))
    tape = shape.cloth("tape", (0.80, 0.74, 0.58))
    shape.part(_BOX, (0.5, 0.5, 0.5), (0.0, 0.0, 0.5), material=board)
    shape.part(_BOX, (0.502, 0.08, 0.502), (0.0, 0.0, 0.5), material=tape)


_SHAPES = {"person": _person, "car": _car, "door": _door, "box": _box}
