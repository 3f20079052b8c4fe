"""Self-moving bodies: people, cars, doors and boxes, on splines and hinges.

Their settings are in ``map`` (NED); what is built of them, in MuJoCo's axes (NWU), from the shapes
in ``bodies.xml``.
"""

from __future__ import annotations

import functools
import math
import pathlib
import xml.etree.ElementTree as ET
from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal

import msgspec
import mujoco

from events import Quaternion, Vector3
from events.frames import flip_yz, flip_yz_rotation, from_yaw
from runtime.units import Duration
from sims.worlds.builder import add_material
from sims.worlds.dynamics import Dynamics, Motion, Path, Scene, interpolated, path_through

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Kind = Literal["person", "car", "door", "box"]

SIZES: dict[Kind, Vector3] = {
    "person": (0.36, 0.52, 1.76),
    "car": (4.1, 1.75, 1.45),
    "door": (0.92, 0.045, 2.05),
    "box": (0.6, 0.6, 0.6),
}  # length along the heading, width, height, metres, unless the settings say another

COLOURS: dict[Kind, Vector3] = {
    "person": (0.75, 0.22, 0.14),
    "car": (0.16, 0.30, 0.52),
    "door": (0.50, 0.34, 0.20),
    "box": (0.62, 0.48, 0.30),
}


class BodySpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a self-moving body.

    Attributes:
        name: Name, unique in the world; the source is ``<node>/<name>``.
        kind: ``person``, ``car``, ``door`` or ``box``.
        waypoints: Points of a smooth curve for the middle of its foot, metres in ``map``. The body
            heads along the curve. A single point: it stands there. Of a door: its hinge.
        times: Time at each waypoint, in a loop again at the first; by `speed` if left out.
        speed: Mean speed on the straight lines between the waypoints, metres per second.
        loop: Return from the last waypoint to the first, for ever; else start and end at rest.
        heading: Heading of a standing body or a closed door, degrees clockwise from north.
        angles: Opening of a door at the `times`, degrees clockwise from above; a loop's ends are
            equal.
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
        """Return the waypoints; of a loop, with the first repeated at the end."""
        return self.waypoints + (self.waypoints[:1] if self.loop else ())


class BodyMotion(Motion, frozen=True):
    """Where a body is at each time."""

    solid = True
    name: str  # name of the MuJoCo body, which is a mocap body
    place: Vector3  # where it stands, metres NED, if it has no path
    yaw: float
    path: Path | None = None  # its way, if it has one
    times: tuple[float, ...] = ()
    angles: tuple[float, ...] = ()  # of a door, radians, at those times
    loop: bool = False  # whether a door does the same again and again

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
        """Move the body to its pose at a time."""
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
        times = tuple(float(time) for time in spec.times)
        return BodyMotion(name, spec.waypoints[0], yaw, None, times, angles, spec.loop)
    places = spec.places()
    legs = (math.dist(a, b) / spec.speed for a, b in pairwise(places))
    times = spec.times or tuple(accumulate(legs, initial=0.0))
    path = path_through(places, times, loop=spec.loop, yaw=yaw)
    return BodyMotion(name, spec.waypoints[0], yaw, path)


def add_bodies(scene: Scene, node: str, specs: tuple[BodySpec, ...]) -> Dynamics:
    """Put bodies into a world, each ``<node>/<name>``, or raise `ValueError` for equal names."""
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
        size, colour = spec.size or SIZES[spec.kind], spec.colour or COLOURS[spec.kind]
        add_shape(scene, body, spec.kind, size, colour)
        motions.append(motion)
    return Dynamics(tuple(motions))


def add_shape(scene: Scene, body: Any, kind: Kind, size: Vector3, colour: Vector3) -> None:
    """Add a kind's parts and materials to a body, whose origin is the middle of its foot."""
    shape = _Shape(scene.spec, body, size, colour)
    for element in _shapes().iterfind(f"{kind}/*"):
        getattr(shape, element.tag)(element)


class _Shape:
    def __init__(self, world: Any, body: Any, size: Vector3, colour: Vector3) -> None:
        self._world = world
        self._body = body
        self._name = body.name
        self._colour = colour
        self._size = size
        self._parts = 0

    def cloth(self, given: ET.Element) -> None:
        name = f"{self._name}/{given.get('name')}"
        shade = float(given.get("shade", 1.0))
        colour = _numbers(given, "rgb") or [shade * channel for channel in self._colour]
        self._world.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_CUBE,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=colour,
            rgb2=[0.75 * channel for channel in colour],
            mark=mujoco.mjtMark.mjMARK_RANDOM,
            markrgb=_numbers(given, "marks") or [min(1.25 * c + 0.08, 1.0) for c in colour],
            random=0.06,
            width=64,
            height=64,
        )
        add_material(self._world, name, specular=0.15, shininess=0.2)

    def part(self, given: ET.Element) -> None:
        self._geom(
            given,
            type=_TYPES[given.attrib["type"]],
            size=self._scaled(given, "half"),
            pos=self._scaled(given, "at"),
            quat=_ACROSS if given.get("axis") == "across" else (1.0, 0.0, 0.0, 0.0),
            rgba=[*(_numbers(given, "rgb") or (1.0, 1.0, 1.0)), 1.0],
        )

    def limb(self, given: ET.Element) -> None:
        self._geom(
            given,
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*self._scaled(given, "top"), *self._scaled(given, "bottom")],
            size=[float(given.attrib["radius"]) * self._size[1], 0.0, 0.0],
        )

    def _geom(self, given: ET.Element, **options: Any) -> None:
        self._parts += 1
        cloth = given.get("material")
        material = f"{self._name}/{cloth}" if cloth else ""
        name = f"{self._name}/part_{self._parts}"
        self._body.add_geom(name=name, material=material, group=0, **options)

    def _scaled(self, given: ET.Element, key: str) -> list[float]:
        return [share * size for share, size in zip(_numbers(given, key), self._size, strict=True)]


@functools.cache
def _shapes() -> ET.Element:
    return ET.parse(pathlib.Path(__file__).with_name("bodies.xml")).getroot()  # noqa: S314  # ours


def _numbers(given: ET.Element, key: str) -> list[float]:
    return [float(number) for number in given.get(key, "").split()]


_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
_ACROSS: Quaternion = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Turns an upright cylinder to the side."""
