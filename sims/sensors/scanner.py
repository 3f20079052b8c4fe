"""Turns of lidars in a world: each ray from where the sensor is at the ray's own time.

Made for a worker process; MuJoCo casts the rays.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import LidarScan
from events.frames import flip_yz, flip_yz_rotation
from sims.cameras.noise import generator
from sims.cameras.renderer import model_from_bytes
from sims.cameras.stage import LOOK
from sims.sensors.lidar import LidarSpec, pattern_of
from sims.sensors.rays import Floats, Rays
from sims.vehicle.model import TIMESTEP_NS
from sims.worlds import Dynamics

_STEP = TIMESTEP_NS * 1e-9
_ONLY_FIRST = np.array([1, 0, 0, 0, 0, 0], np.uint8)
_DEFAULT = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""Colour of a geom that has been given none, and so has its material's."""


class _Boxes:
    """The boxes around a world's geoms, as they are at the start."""

    def __init__(self, rays: Rays) -> None:
        rays.look(rays.model.qpos0, 0.0)
        aabb, axes = rays.model.geom_aabb, rays.data.geom_xmat.reshape(-1, 3, 3)
        centres = rays.data.geom_xpos + np.einsum("gij,gj->gi", axes, aabb[:, :3])
        self._centres = np.ascontiguousarray(centres.T)
        self._edges = [
            np.ascontiguousarray((axes[:, :, i] * aabb[:, 3 + i, None]).T) for i in range(3)
        ]

    def extents(self, normals: Floats, origins: Floats) -> tuple[Floats, Floats]:
        """Return between which heights each box is over planes, shape (planes, geoms)."""
        height = normals @ self._centres - (normals * origins).sum(axis=1)[:, None]
        half = sum(np.abs(normals @ edges) for edges in self._edges)
        return height - half, height + half


class Scanner:
    """Scans turns of the lidars of one body.

    Args:
        model_bytes: The compiled world, from `sims.cameras.renderer.model_to_bytes`.
        dynamics: What moves in it by itself.
        specs: Settings of the lidars.
        vehicle: Name of the vehicle that carries them.
        seed: Seed of noise and drop-outs.
    """

    def __init__(
        self,
        model_bytes: bytes,
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
        order = _put_first(model, met)
        self._hidden, self._reflectivity = ~met[order], greys[order]
        # Whatever may move, and planes, whose bound is 0, are always looked at.
        self._bounded = (model.geom_bodyid == 0) & (model.geom_rbound > 0.0)
        self._boxes = _Boxes(self._rays)

    def scan(self, name: str, start: int, states: Floats) -> LidarScan:
        """Scan one turn.

        Args:
            name: Name of the lidar.
            start: Stamp of the first ray (ns).
            states: The world's generalised positions at each millisecond from then on, shape
                (milliseconds, nq); the last for what comes later, too.

        Returns:
            The scan. The same arguments give the same bits.
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
        distances, returned = (each.reshape(rays.shape[:2]) for each in (distances, returned))
        return self._measured(spec, start, directions, times, distances, returned)

    def _poses(self, spec: LidarSpec, states: Floats, times: Floats) -> tuple[Floats, Floats]:
        """Return the sensor's place at each state, and its rotation at each time (NWU)."""
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
        """Return which geoms no ray of a group can meet, shape (groups, geoms).

        Four planes through the group's origin have all its rays on one side; a geom whose box is
        wholly on the other side of one of them, behind the origin or out of reach, is aside.
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
        return np.asarray(aside & narrow[:, None] & self._bounded)

    def _measured(
        self,
        spec: LidarSpec,
        start: int,
        directions: Floats,
        times: Floats,
        distances: Floats,
        returned: Floats,
    ) -> LidarScan:
        """Return what the sensor makes of true distances; arrays of columns and channels."""
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


def _put_first(model: Any, met: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    """Have MuJoCo forget those of the world's own geoms that light does not meet.

    For each ray it goes through all geoms of a body, the first `body_geomnum` of its own.

    Returns:
        The old number of each geom; names lead to the old ones still.
    """
    order = np.arange(model.ngeom)
    world = np.flatnonzero(model.geom_bodyid == 0)
    order[world] = world[np.argsort(~met[world], kind="stable")]
    for name in dir(model):
        array = getattr(model, name)
        if name.startswith("geom_") and len(array) == model.ngeom:
            array[:] = array[order]
    model.body_geomnum[0] = met[world].sum()
    return order


def solids(model: Any) -> npt.NDArray[np.bool_]:
    """Return which geoms light meets, shape (ngeom,): what is drawn, and is not transparent.

    Where a built-in world has a solid and its look, which coincide, it is the solid: rays meet its
    plain shape in less time than the look's mesh.
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
    """Return the mean colour of a texture, from one pixel in sixteen."""
    channels = int(model.tex_nchannel[texture])
    size = int(model.tex_height[texture]) * int(model.tex_width[texture]) * channels
    begin = int(model.tex_adr[texture])
    pixels = model.tex_data[begin : begin + size].reshape(-1, channels)[::16]
    mean = pixels.mean(axis=0) / 255.0
    return np.asarray(mean[:3] if channels >= 3 else np.repeat(mean[:1], 3))


def _looks(model: Any) -> list[tuple[int, int]]:
    """Return geoms that are another's look, and that other geom."""
    pairs = []
    for look in range(model.ngeom):
        name = model.geom(look).name
        if name.endswith(LOOK):
            solid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name.removesuffix(LOOK))
            if solid >= 0:
                pairs.append((look, solid))
    return pairs
