"""Lidars: patterns, rays cast by a worker from where the sensor is then, and scans' delivery."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from events import LidarAnnouncement, LidarScan
from events.frames import flip_yz, flip_yz_rotation
from runtime import Node, Tick, Worker
from sims.calibration import check_lists, chosen, generator_of
from sims.cameras.optics import generator
from sims.cameras.renderer import model_from_bytes
from sims.cameras.rig import DrawnWorld
from sims.cameras.stage import object_numbers
from sims.presets import LIDARS
from sims.ray_casting import MeshRays, met_by_trees
from sims.sensors.calibration import LIDAR_SIZES, USUAL_LIDAR, LidarCalibrationError
from sims.sensors.rays import Floats, Rays
from sims.sensors.sensor import Mounted, Name, NonNegative, Positive, SensorSpec
from sims.vehicle import TIMESTEP_NS, VehicleMotion
from sims.worlds import Dynamics

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

PRISMS = (121.57, -77.73)
"""Turns per second of the two prisms of a solid-state lidar, as of a Livox Mid-40: together they
draw a rosette that is never the same twice."""


class LidarSpec(SensorSpec, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a lidar: without errors by default, with errors as its settings say.

    AirSim's ``PointsPerSecond`` is `channels` · `columns` · `rate`.

    Attributes:
        name: Name of the sensor, unique on its body.
        preset: Real sensor with its figures as defaults; keys beside it override them.
        rate: Turns per second (AirSim: ``RotationsPerSecond``).
        pattern: ``spinning``: rings, column by column, clockwise seen from above. ``solid_state``:
            a rosette in the field of view that does not repeat, as two turning prisms draw it.
        channels: Rays that are sent at a time, the uppermost first (AirSim: ``NumberOfChannels``).
        columns: Times in a turn at which they are sent.
        azimuths: First and last direction, degrees clockwise from ahead (AirSim:
            ``HorizontalFOVStart`` and ``End``). A spinning lidar is blind for the rest of the turn.
        elevations: Lowest and highest, degrees upwards (AirSim: ``VerticalFOVLower`` and
            ``Upper``).
        min_range: Metres; what is nearer gives no point.
        max_range: Metres; what is farther gives no point (AirSim: ``Range``).
        noise: Standard deviation of the white noise along the ray, metres.
        dropout: Share of rays that give no point, at random.
        min_intensity: What returns less light than this gives no point.
        full_range: Metres up to which a facing white surface has intensity 1; falling by the
            square.
        calibration_error: Errors of the announced mounting; ``true`` for those of a good
            calibration. The points are what they are.
    """

    name: Name
    preset: Annotated[str | None, msgspec.Meta(extra={"presets": LIDARS})] = None
    rate: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 10.0
    pattern: Literal["spinning", "solid_state"] = "spinning"
    channels: Annotated[int, msgspec.Meta(ge=1, le=256)] = 16
    columns: Annotated[int, msgspec.Meta(ge=1, le=65536)] = 1024
    azimuths: tuple[float, float] = (0.0, 360.0)
    elevations: tuple[float, float] = (-15.0, 15.0)
    min_range: NonNegative = 0.1
    max_range: Positive = 100.0
    noise: NonNegative = 0.0
    dropout: Share = 0.0
    min_intensity: Share = 0.0
    full_range: Positive = 20.0
    calibration_error: LidarCalibrationError | bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.wrong is not None:
            check_lists(self.wrong, LIDAR_SIZES)
        first, last = self.azimuths
        low, high = self.elevations
        if not 0.0 < last - first <= 360.0:
            raise ValueError(
                f"{self.name}: azimuths: expected up to 360 degrees from the first to the last, "
                f"found {first:g} to {last:g}"
            )
        if not -90.0 <= low <= high <= 90.0:
            raise ValueError(
                f"{self.name}: elevations: expected the lowest and the highest, from -90 to 90 "
                f"degrees, found {low:g} and {high:g}"
            )
        if self.max_range <= self.min_range:
            raise ValueError(
                f"{self.name}: max_range: expected more than the {self.min_range:g} m of "
                f"min_range, found {self.max_range:g} m"
            )

    @property
    def wrong(self) -> LidarCalibrationError | None:
        """Errors of the announced mounting; `None` if it is exact."""
        return chosen(self.calibration_error, USUAL_LIDAR)


class Pattern(NamedTuple):
    """Rays of a turn."""

    directions: Floats  # unit vectors in the sensor's frame (FRD), shape (columns, channels, 3)
    times: Floats  # seconds after the turn's start, not falling, shape (columns,)


def pattern_of(spec: LidarSpec, start: float) -> Pattern:
    """Return the rays of a turn beginning at `start`, seconds."""
    low, high = np.radians(spec.elevations)
    first, last = np.radians(spec.azimuths)
    share = np.arange(spec.columns) / spec.columns
    if spec.pattern == "spinning":
        turn = (first + share * (last - first))[:, None]
        elevation = np.linspace(high, low, spec.channels)[None, :]
        times = share * (last - first) / (2.0 * math.pi * spec.rate)
    else:
        times = share / spec.rate
        apart = np.arange(spec.channels) * 2.0 * math.pi / spec.channels
        one, other = (2.0 * math.pi * rate * (start + times)[:, None] for rate in PRISMS)
        across = (np.cos(one + apart) + np.cos(other)) / 2.0
        upwards = (np.sin(one + apart) + np.sin(other)) / 2.0
        turn = (first + last) / 2.0 + across * (last - first) / 2.0
        elevation = (low + high) / 2.0 + upwards * (high - low) / 2.0
    x, y, z = np.broadcast_arrays(
        np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), -np.sin(elevation)
    )
    return Pattern(np.stack([x, y, z], axis=-1), times)


class Lidar(Mounted[LidarSpec]):
    """A lidar on a body; its turns are scanned by `sims.sensors.lidar`."""

    announced = LidarAnnouncement

    def also_announced(self) -> dict[str, Any]:
        """Return the field of view in radians."""
        low, high = (math.radians(angle) for angle in self.spec.elevations)
        first, last = (math.radians(angle) for angle in self.spec.azimuths)
        return {"elevations": (low, high), "horizontal_fov": last - first}


_STEP = TIMESTEP_NS * 1e-9
_ONLY_FIRST = np.array([1, 0, 0, 0, 0, 0], np.uint8)
_DEFAULT = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""MuJoCo's default colour of a geom, replaced by its material's."""


class _Boxes:
    """The boxes around some of a world's geoms, as they are at the start."""

    def __init__(self, rays: Rays, geoms: npt.NDArray[np.intp]) -> None:
        rays.look(rays.model.qpos0, 0.0)
        aabb = rays.model.geom_aabb[geoms]
        axes = rays.data.geom_xmat[geoms].reshape(-1, 3, 3)
        centres = rays.data.geom_xpos[geoms] + np.einsum("gij,gj->gi", axes, aabb[:, :3])
        self._centres = np.ascontiguousarray(centres.T)
        self._edges = [
            np.ascontiguousarray((axes[:, :, i] * aabb[:, 3 + i, None]).T) for i in range(3)
        ]

    def extents(self, normals: Floats, origins: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper height of each box over planes, shape (planes, geoms)."""
        height = normals @ self._centres - (normals * origins).sum(axis=1)[:, None]
        half = sum(np.abs(normals @ edges) for edges in self._edges)
        return height - half, height + half


class Scanner:
    """Ray-casting scanner for the lidars of a body."""

    def __init__(
        self,
        model_bytes: bytes,  # the compiled world, from `sims.cameras.renderer.model_to_bytes`
        dynamics: Dynamics,
        specs: tuple[LidarSpec, ...],
        vehicle: str,
        seed: int,
    ) -> None:
        model = model_from_bytes(model_bytes)
        self._rays = Rays(model, dynamics, f"{vehicle}/base_link")
        self._specs = {spec.name: spec for spec in specs}
        self._seed = seed
        self._vehicle = vehicle
        pose = int(model.joint(f"{vehicle}/free").qposadr[0])
        self._pose = slice(pose, pose + 7)
        met = solids(model) & (model.geom_bodyid != model.body(f"{vehicle}/base_link").id)
        greys = reflectivities(model)
        by_trees = met & met_by_trees(model)
        order = _put_first(model, met & ~by_trees, build=bool(by_trees.any()))
        self._hidden, self._reflectivity = ~met[order], greys[order]
        # Whatever may move, and planes, whose bound is 0, are always looked at.
        bounded = (model.geom_bodyid == 0) & (model.geom_rbound > 0.0)
        self._bounded = np.flatnonzero(bounded & ~self._hidden & ~met_by_trees(model))
        self._boxes = _Boxes(self._rays, self._bounded)

    def scan(self, name: str, start: int, states: Floats) -> LidarScan:
        """Return the scan of a turn from `start` (ns) on. The same arguments give the same bits.

        Args:
            states: The world's generalised positions at each millisecond from then on, shape
                (milliseconds, nq); the last for what comes later, too.
        """
        spec = self._specs[name]
        directions, times = pattern_of(spec, start / 1e9)
        origins, turns = self._poses(spec, states, times)
        # FRD to FLU, and from there to the world's NWU.
        rays = (directions * (1.0, -1.0, -1.0)) @ turns.transpose(0, 2, 1)
        groups = np.minimum(np.rint(times / _STEP).astype(np.intp), len(states) - 1)
        borders = np.flatnonzero(np.diff(groups, prepend=-1))
        groups = groups[borders]
        self._rays.look(states[0], start / 1e9)
        hidden = self._hidden | self._aside(origins[groups], rays, borders, spec.max_range)
        flat, channels = rays.reshape(-1, 3), spec.channels
        ends = [*borders[1:].tolist(), len(rays)]
        model, hits = self._rays.model, []
        for group, begin, end, hide in zip(
            groups.tolist(), borders.tolist(), ends, hidden, strict=True
        ):
            self._rays.look(states[group], start / 1e9 + group * _STEP)
            model.geom_group[:] = hide  # 0 or 1: MuJoCo would look at each geom for each ray
            part = flat[begin * channels : end * channels]
            hits.append(self._rays.cast(origins[group], part, spec.max_range, _ONLY_FIRST))
        distances, geoms, normals = map(np.concatenate, zip(*hits, strict=True))
        returned = -np.einsum("ri,ri->r", normals, flat) * self._reflectivity[geoms]
        distances, returned = (values.reshape(rays.shape[:2]) for values in (distances, returned))
        return self._measured(spec, start, directions, times, distances, returned)

    def _poses(self, spec: LidarSpec, states: Floats, times: Floats) -> tuple[Floats, Floats]:
        """Return the sensor's place at each state, and its rotation at each time (NWU)."""
        from scipy.spatial.transform import Rotation  # a quarter of a second, for lidars only

        poses = states[:, self._pose]
        body = Rotation.from_quat(poses[:, 3:], scalar_first=True)
        origins = poses[:, :3] + body.apply(flip_yz(spec.position))
        mounting = Rotation.from_quat(flip_yz_rotation(spec.rotation), scalar_first=True)
        sensor = (body * mounting).as_quat()
        whole, share = np.divmod(np.minimum(times / _STEP, len(states) - 1), 1.0)
        before = sensor[whole.astype(np.intp)]
        after = sensor[np.minimum(whole.astype(np.intp) + 1, len(states) - 1)]
        after *= np.where((before * after).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        between = before + share[:, None] * (after - before)  # normalised by Rotation
        return origins, Rotation.from_quat(between).as_matrix()

    def _aside(
        self, origins: Floats, rays: Floats, borders: npt.NDArray[np.intp], reach: float
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of geoms no ray of a group can meet, shape (groups, geoms).

        Four planes through the group's origin have all its rays on one side; a geom is aside if its
        box is beyond one of them, behind the origin or out of reach.
        """
        middle = rays[:, 0] + rays[:, rays.shape[1] // 2] + rays[:, -1]
        ahead = _unit(np.add.reduceat(middle, borders, axis=0))
        right = np.cross(rays[borders, 0], rays[borders, -1])  # across a spinning lidar's columns
        right = _unit(
            np.where((right**2).sum(axis=1, keepdims=True) > 1e-12, right, ahead[:, ::-1])
        )
        right = _unit(np.cross(ahead, np.cross(right, ahead)))
        up = np.cross(ahead, right)
        counts = np.diff(borders, append=len(rays))
        forwards, rightwards, upwards = (
            np.einsum("cki,ci->kc", rays, np.repeat(axis, counts, axis=0))
            for axis in (ahead, right, up)
        )
        narrow = np.minimum.reduceat(forwards.min(axis=0), borders) > 0.01
        slopes = [
            np.maximum.reduceat((part / np.maximum(forwards, 0.01)).max(axis=0), borders)[:, None]
            for part in (rightwards, -rightwards, upwards, -upwards)
        ]
        nearest, farthest = self._boxes.extents(ahead, origins)
        aside = (farthest < 0.0) | (nearest > reach)
        for axis, slope in zip((right, -right, up, -up), slopes, strict=True):
            aside |= self._boxes.extents(axis - slope * ahead, origins)[0] > 0.0
        hidden = np.zeros((len(origins), len(self._hidden)), np.bool_)
        hidden[:, self._bounded] = aside & narrow[:, None]
        return hidden

    def _measured(
        self,
        spec: LidarSpec,
        start: int,
        directions: Floats,
        times: Floats,
        distances: Floats,
        returned: Floats,
    ) -> LidarScan:
        intensities = np.clip(returned, 0.0, 1.0)
        intensities *= np.minimum(1.0, spec.full_range / np.maximum(distances, 1e-9)) ** 2
        valid = np.isfinite(distances) & (intensities >= spec.min_intensity)
        random = generator(self._seed, spec.name, start)
        if spec.dropout:
            valid &= random.random(valid.shape) >= spec.dropout
        if spec.noise:
            distances = distances + spec.noise * random.standard_normal(valid.shape)
        valid &= (distances >= spec.min_range) & (distances <= spec.max_range)
        column, channel = np.nonzero(valid)
        points = directions[valid] * distances[valid][:, None]
        source = f"{self._vehicle}/{spec.name}"
        return LidarScan(
            stamp=start,
            source=source,
            frame_id=source,
            points=points.astype(np.float32),
            intensities=intensities[valid].astype(np.float32),
            times=times[column].astype(np.float32),
            rings=channel.astype(np.uint16),
        )


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)[:, None])


def _put_first(model: Any, met: npt.NDArray[np.bool_], build: bool) -> npt.NDArray[np.intp]:
    """Hide all of the world's own geoms but those met from MuJoCo's ray casting.

    For each ray it goes through all geoms of a body, the first `body_geomnum` of its own. Returned
    are the old numbers, to which names lead still.
    """
    order = np.arange(model.ngeom)
    world = np.flatnonzero(model.geom_bodyid == 0)
    order[world] = world[np.argsort(~met[world], kind="stable")]
    for name in dir(model):
        array = getattr(model, name)
        if name.startswith("geom_") and len(array) == model.ngeom:
            array[:] = array[order]
    if build:
        MeshRays.of(model).build(model)  # from below on MuJoCo does not compute their positions
    model.body_geomnum[0] = met[world].sum()
    return order


def solids(model: Any) -> npt.NDArray[np.bool_]:
    """Return a mask of geoms met by light, shape (ngeom,): drawn and not transparent.

    Of a solid and its look, the solid: rays meet its plain shape in less time than the look's mesh.
    """
    met = np.isin(model.geom_group, (0, 1, 2)) & (model.geom_rgba[:, 3] > 0.0)
    for look, solid in _looks(model):
        met[solid], met[look] = met[look], False
    return np.asarray(met)


def reflectivities(model: Any) -> Floats:
    """Return the mean grey of each geom's surface, 0 to 1, shape (ngeom,)."""
    colours = model.geom_rgba.astype(np.float64).copy()
    for geom, material in enumerate(model.geom_matid):
        if material < 0:
            continue
        if np.array_equal(model.geom_rgba[geom], _DEFAULT):
            colours[geom] = model.mat_rgba[material]
        textures = [number for number in model.mat_texid[material] if number >= 0]
        if textures:
            colours[geom, :3] *= _mean_of(model, textures[0])
    greys = colours[:, :3] @ (0.299, 0.587, 0.114)
    for look, solid in _looks(model):
        greys[solid] = greys[look]
    return np.asarray(greys)


def _mean_of(model: Any, texture: int) -> Floats:
    channels = int(model.tex_nchannel[texture])
    size = int(model.tex_height[texture]) * int(model.tex_width[texture]) * channels
    begin = int(model.tex_adr[texture])
    pixels = model.tex_data[begin : begin + size].reshape(-1, channels)[::16]
    mean = pixels.mean(axis=0) / 255.0
    return np.asarray(mean[:3] if channels >= 3 else np.repeat(mean[:1], 3))


def _looks(model: Any) -> list[tuple[int, int]]:
    numbers = enumerate(object_numbers(model).tolist())
    return [(look, solid) for look, solid in numbers if look != solid]


LATE = 1.0  # longest delay of a turn's end in real time, seconds; later turns are skipped


class LidarRig:
    """All lidars of a vehicle.

    A turn, from one tick to the next, is made from the vehicle's states meanwhile, and sent
    `latency` after its end, with the stamp of its first ray; `advance` steps the world up to a
    tick.
    """

    def __init__(
        self,
        node: Node[Any],
        lidars: list[Lidar],
        body: VehicleMotion,
        advance: Callable[[Tick], int],
    ) -> None:
        self._node: Any = node
        self._lidars = lidars
        self._body = body
        self._advance = advance
        self._scanner: Worker[Scanner] | None = None
        self._starts: dict[str, int] = {}
        self._in_flight = {lidar.source: 0 for lidar in lidars}
        self._skipped: set[str] = set()

    async def start(self, world: DrawnWorld) -> None:
        """Start the scanner and the turns; call in `on_startup`."""
        if not self._lidars:
            return
        specs = tuple(lidar.spec for lidar in self._lidars)
        seed = int(generator_of(self._node.rng, "lidars").integers(1 << 31))
        model = await self._node.offload(lambda: world.model_bytes)
        self._scanner = await self._node.worker(
            Scanner, model, world.dynamics, specs, self._node.name, seed
        )
        self._body.keep(max(1.0 / spec.rate for spec in specs) + LATE + 2e-3)
        for lidar in self._lidars:
            self._node.every(lidar.spec.rate, functools.partial(self._turn, lidar), lidar.spec.name)

    def _turn(self, lidar: Lidar, tick: Tick) -> None:
        end = self._advance(tick)
        start = self._starts.get(lidar.source, end)
        self._starts[lidar.source] = end
        if start == end or start < lidar.spec.startup_delay * 1e9:
            return
        on_their_way = math.ceil(lidar.spec.latency * lidar.spec.rate) + 1
        too_long = end - start > (1.0 / lidar.spec.rate + LATE) * 1e9
        # In real time it, or what calls this, may fall behind.
        if too_long or self._in_flight[lidar.source] > on_their_way:
            if lidar.source not in self._skipped:
                self._node.log.warning("%s: turns skipped, scanning is too slow", lidar.source)
            self._skipped.add(lidar.source)
            return
        stamps = range(start, end, TIMESTEP_NS)
        states = np.stack([self._body.past(stamp) for stamp in (*stamps, end)])
        self._in_flight[lidar.source] += 1
        self._node.start(self._deliver(lidar, start, end, states))

    async def _deliver(self, lidar: Lidar, start: int, end: int, states: Any) -> None:
        assert self._scanner is not None
        due = end + round(lidar.spec.latency * 1e9)
        wait = max(due - self._node.clock.now(), 0) / 1e9
        try:
            scan = await self._scanner.call_for(wait, Scanner.scan, lidar.spec.name, start, states)
        finally:
            self._in_flight[lidar.source] -= 1
        self._node.lidar_scans.send(scan)
