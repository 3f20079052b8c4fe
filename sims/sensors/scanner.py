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
        self._reflectivity = reflectivities(model)
        own = model.body(f"{vehicle}/base_link").id
        self._hidden = ~solids(model) | (model.geom_bodyid == own)
        # Whatever may move, and planes, whose bound is 0, are always looked at.
        bounded = (model.geom_bodyid == 0) & (model.geom_rbound > 0.0)
        self._radii = np.where(bounded, model.geom_rbound, np.inf)

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
        x, y, z = np.moveaxis(directions, -1, 0) * np.array([1.0, -1.0, -1.0])[:, None, None]
        rays = np.empty_like(directions)
        for axis in range(3):
            a, b, c = turns[:, axis].T[:, :, None]
            rays[..., axis] = a * x + b * y + c * z
        groups = np.minimum(np.rint(times / _STEP).astype(np.intp), len(states) - 1)
        borders = np.flatnonzero(np.diff(groups, prepend=-1))
        groups = groups[borders]
        self._rays.look(states[0], start / 1e9)
        hidden = self._hidden | self._aside(origins[groups], rays, borders, spec.max_range)
        distances = np.empty(rays.shape[:2])
        geoms, normals = np.empty(rays.shape[:2], np.int32), np.empty_like(rays)
        model = self._rays.model
        for group, begin, end, hide in zip(
            groups.tolist(),
            borders.tolist(),
            [*borders[1:].tolist(), len(rays)],
            hidden,
            strict=True,
        ):
            self._rays.look(states[group], start / 1e9 + group * _STEP)
            model.geom_group[:] = hide  # 0 or 1: MuJoCo would look at each geom for each ray
            part = rays[begin:end].reshape(-1, 3)
            hits = self._rays.cast(origins[group], part, spec.max_range, _ONLY_FIRST)
            size = (end - begin, spec.channels)
            distances[begin:end] = hits.distances.reshape(size)
            geoms[begin:end] = hits.geoms.reshape(size)
            normals[begin:end] = hits.normals.reshape(*size, 3)
        returned = -np.einsum("cki,cki->ck", normals, rays) * self._reflectivity[geoms]
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

        By their bounding spheres, and for each group of rays the cone around them and the plane
        that they are near to, such as that of a spinning lidar's column.
        """
        middle = rays[:, 0] + rays[:, rays.shape[1] // 2] + rays[:, -1]
        sums = np.add.reduceat(middle, borders, axis=0)
        axes = sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-12)[:, None]
        normals = np.cross(rays[borders, 0], rays[borders, -1])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
        counts = np.diff(borders, append=len(rays))
        along = np.einsum("cki,ci->kc", rays, np.repeat(axes, counts, axis=0)).min(axis=0)
        off = np.abs(np.einsum("cki,ci->kc", rays, np.repeat(normals, counts, axis=0))).max(axis=0)
        half = np.arccos(np.clip(np.minimum.reduceat(along, borders), -1.0, 1.0))[:, None]
        off = np.maximum.reduceat(off, borders)[:, None]
        apart = self._rays.data.geom_xpos[None] - origins[:, None]
        distances = np.sqrt(np.einsum("gni,gni->gn", apart, apart)) + 1e-9
        radii = self._radii[None]
        outside = distances > radii
        angles = np.arccos(np.clip(np.einsum("gni,gi->gn", apart, axes) / distances, -1.0, 1.0))
        wide = np.arcsin(np.where(outside, radii, 0.0) / distances)
        beside = np.abs(np.einsum("gni,gi->gn", apart, normals)) > radii + off * distances
        return np.asarray(outside & ((angles > half + wide) | beside | (distances - radii > reach)))

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
