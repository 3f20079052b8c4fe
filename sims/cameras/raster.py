"""Stage of the project's own rasteriser: the same bytes on every machine, in a few milliseconds.

The drawing itself is in C++ (``sims/cameras/rasteriser``); here a model becomes the triangles,
textures and lights that it takes. Every lens is drawn directly, without pinhole drawings between.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from events import CameraInfo
from runtime.typed import override
from sims.cameras.layouts import GEOM, LIGHT, POSE, VIEW
from sims.cameras.layouts import address as _at
from sims.cameras.meshes import narrow
from sims.cameras.optics import pixel_rays
from sims.cameras.packed import DRAWN_GROUPS, Drawable, PreparedMesh, prepare
from sims.cameras.shadows import ShadowMaps
from sims.cameras.stage import (
    NEAR,
    RANGE,
    Changing,
    Drawn,
    Floats,
    GraphicsError,
    Stage,
    View,
    object_numbers,
)
from sims.cameras.surfaces import geom_numbers
from sims.compiled import libraries

_Kind = mujoco.mjtGeom
_OPTICAL = np.tile([1.0, -1.0, -1.0], 3)  # MuJoCo's camera looks along -z, with y up
FROM_BEHIND = 0.3  # factor on the opacity of a plane that is seen from behind, as MuJoCo's
_GREY = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # a geom's colour if nothing is said


class Raster(Stage):
    """Stage of the rasteriser.

    Args:
        threads: Threads that draw; any number draws the same.
        instructions: One of `libraries`; the quickest by default. All draw the same.
        drawable: From `prepare` of this model, if that is done.

    Raises:
        GraphicsError: The rasteriser was not compiled with the package.
        ValueError: The model has skins, flexes or geoms that are not drawn, more texels or
            triangles than have room, or settings without a meaning (`check_settings`).
    """

    keeps_rows = True

    def __init__(
        self,
        model: Any,
        dynamics: Changing | None = None,
        threads: int = 1,
        instructions: str = "",
        drawable: Drawable | None = None,
    ) -> None:
        super().__init__(model, dynamics)
        self._threads = threads
        self._colours = b""  # those that the geoms have
        self._kept: list[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = []  # poses of eye and geoms
        self._library = library_for(model, instructions)
        if drawable is None:
            drawable = prepare(model, self._library)
        self._drawable = drawable  # which the scene refers to
        self._world = ctypes.c_void_p(self._library.raster_new())
        self._shadows = ShadowMaps(self._library, self._world, model, threads)
        self._library.raster_texels(self._world, _at(drawable.texels))
        self._textures = [
            -1 if place is None else int(self._library.raster_texture(self._world, *place))
            for place in drawable.textures
        ]
        skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._sky = self._textures[skies[0]] if skies.size else -1
        self._drawn = np.flatnonzero(model.geom_group < DRAWN_GROUPS)
        self._geoms = np.zeros(len(self._drawn), GEOM)
        self._geoms["double_sided"] = geom_numbers(model, "double_sided")[self._drawn] != 0.0
        self._geoms["cutoff"] = narrow(geom_numbers(model, "alpha_cutoff")[self._drawn])
        planes = model.geom_type[self._drawn] == _Kind.mjGEOM_PLANE
        self._planes = np.flatnonzero(planes & (self._geoms["double_sided"] == 0))
        self._behind: dict[int, int] = {}  # by a plane's mesh, that of its other side
        meshes = []
        for mesh, behind in drawable.meshes:
            meshes.append(self._add_mesh(mesh))
            if behind is not None:
                self._behind[meshes[-1]] = self._add_mesh(behind)
        self._geoms["mesh"] = [meshes[number] for number in drawable.mesh_of_geom]
        self._describe()
        self._lenses: dict[CameraInfo, int] = {}

    @property
    @override
    def closed(self) -> bool:
        return self._world.value is None

    @property
    @override
    def name(self) -> str:
        return "raster"

    @override
    def enter(self) -> None:
        pass  # it belongs to no thread

    @override
    def close(self) -> None:
        if not self.closed:
            self._library.raster_free(self._world)
            self._world = ctypes.c_void_p(None)

    @override
    def draw(
        self,
        view: View,
        colour: bool,
        depth: bool,
        numbers: bool,
        rows: tuple[int, int] | None = None,
    ) -> Drawn:
        height, width = view.info.height, view.info.width
        begin, end = rows or (0, height)
        first, last = max(begin - 1, 0), min(end + 1, height)  # outlines take from their neighbours
        shape = last - first, width
        drawn = Drawn(
            np.empty((*shape, 3), np.uint8) if colour else None,
            np.empty(shape, np.float32) if depth else None,
            np.empty(shape, np.int32) if numbers else None,
        )
        if not self._kept:
            self._kept.append(self._seen(self._camera.fixedcamid))
        eyes, poses = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        frame = np.zeros(1, VIEW)
        frame["height"], frame["width"], frame["threads"] = height, width, self._threads
        frame["first"], frame["last"], frame["sky"] = first, last, self._sky
        frame["near"], frame["far"], frame["poses"] = NEAR, RANGE, len(self._kept)
        if (fog := self._fog()) is not None:
            frame["fogged"], frame["fog"] = 1, narrow(self.model.vis.rgba.fog[:3])
            frame["fog_start"], frame["fog_end"] = narrow(fog)
        geoms, lights = self._coloured(), self._lights()
        eye, places = self._kept[len(self._kept) // 2]
        if colour:
            self._shadows.draw(lights, geoms, places)
        geoms = self._from_behind(geoms, places, eye["position"][0])
        self._kept = []
        self._library.raster_draw(
            self._world, self._lens(view.info), _at(frame), _at(eyes), len(geoms), _at(geoms),
            _at(poses), len(lights), _at(lights), *map(_at, drawn),
        )  # fmt: skip
        if rows is None:
            return drawn
        wanted = slice(begin - first, end - first)
        colours, depths, seen = drawn
        return Drawn(
            None if colours is None else colours[wanted],
            None if depths is None else depths[wanted],
            None if seen is None else seen[wanted],
        )

    @override
    def _update(self) -> None:
        """Let the lights shine; the headlight stands where the camera does."""
        mujoco.mjv_updateCamera(self.model, self._data, self._camera, self._scene)
        mujoco.mjv_makeLights(self.model, self._data, self._scene)

    def _lights(self) -> npt.NDArray[Any]:
        """Return the lights; those of an image without a place in the scene are left out."""
        kinds = mujoco.mjtLightType
        known = {
            int(kinds.mjLIGHT_SPOT): 2,
            int(kinds.mjLIGHT_POINT): 1,
            int(kinds.mjLIGHT_DIRECTIONAL): 0,
        }
        lights = [of for of in self._scene.lights[: self._scene.nlight] if int(of.type) in known]
        rows = np.zeros(len(lights), LIGHT)
        for to, of in zip(rows, lights, strict=True):
            to["kind"] = known[int(of.type)]
            to["ambient"], to["diffuse"], to["specular"] = of.ambient, of.diffuse, of.specular
            # MuJoCo gives the scene's point lights none.
            fall = self.model.light_attenuation[of.id] if to["kind"] == 1 else of.attenuation
            to["attenuation"], to["exponent"] = fall, max(of.exponent, 0.0)
            throws = of.castshadow and to["kind"] != 1
            if 0.0 <= of.cutoff <= 90.0:
                to["cutoff"] = math.cos(math.radians(of.cutoff))
            elif to["kind"] == 2:
                to["kind"] = 1  # OpenGL has no such cones, and lets it shine to all sides
            # Light from everywhere, as a headlight often is, has no place: it would move with the
            # camera, and the light on all surfaces would be computed anew.
            if to["kind"] or of.diffuse.any() or of.specular.any():
                to["position"], to["direction"] = of.pos, of.dir
                if throws:
                    self._shadows.add(to, of, int((rows["size"] > 0).sum()))
        return rows

    def _from_behind(self, geoms: Any, poses: Any, eye: Floats) -> Any:
        """Return the geoms, of planes that an eye is behind the other side, see-through."""
        if not self._planes.size:
            return geoms
        places = poses[self._planes]
        with np.errstate(invalid="ignore", over="ignore"):
            ahead = ((eye - places["position"]) * places["turn"][:, 2::3]).sum(axis=1)
        behind = self._planes[ahead < 0.0]
        if not behind.size:
            return geoms
        turned = geoms.copy()
        turned["mesh"][behind] = [self._behind[mesh] for mesh in geoms["mesh"][behind].tolist()]
        turned["rgba"][behind, 3] *= np.float32(FROM_BEHIND)
        return turned

    @override
    def keep(self, camera_id: int, qpos: Floats, seconds: float) -> None:
        self._place(qpos, seconds)
        mujoco.mj_camlight(self.model, self._data)
        self._kept.append(self._seen(camera_id))

    def _seen(self, camera_id: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the poses of the eye and of all geoms."""
        data, eye, poses = self._data, np.empty(1, POSE), np.empty(len(self._drawn), POSE)
        eye["position"] = data.cam_xpos[camera_id]
        eye["turn"] = data.cam_xmat[camera_id] * _OPTICAL
        poses["position"], poses["turn"] = data.geom_xpos[self._drawn], data.geom_xmat[self._drawn]
        return eye, poses

    def _coloured(self) -> npt.NDArray[Any]:
        """Return the geoms in their colours of now."""
        model, drawn, geoms = self.model, self._drawn, self._geoms
        colours = model.geom_rgba.tobytes() + model.mat_rgba.tobytes()
        if colours == self._colours:
            return geoms
        self._colours = colours
        rgba = model.geom_rgba[drawn]
        # A material's colour, unless the geom has one of its own.
        plain = (model.geom_matid[drawn] >= 0) & (rgba == _GREY).all(axis=1)
        rgba[plain] = model.mat_rgba[model.geom_matid[drawn[plain]]]
        geoms["rgba"] = rgba
        return geoms

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")  # `narrow` bounds it
    def _describe(self) -> None:
        """Fill in the geoms' fields that stay as they are."""
        model, geoms = self.model, self._geoms
        kind, size = model.geom_type[self._drawn], model.geom_size[self._drawn]
        own = np.append(model.mesh_texcoordadr, -1)[model.geom_dataid[self._drawn]] >= 0
        self._own_places = (kind == _Kind.mjGEOM_MESH) & own
        self._from_above = (kind == _Kind.mjGEOM_HFIELD) | ((kind == _Kind.mjGEOM_MESH) & ~own)
        self._from_above |= (kind == _Kind.mjGEOM_PLANE) & (size[:, :2] == 0.0).any(axis=1)
        geoms["offset"] = 0.5 * self._from_above
        geoms["number"] = object_numbers(model)[self._drawn]
        geoms["specular"], geoms["shininess"] = 0.5, 0.5
        geoms["texture"], geoms["repeat"] = -1, 1.0
        has = np.flatnonzero(model.geom_matid[self._drawn] >= 0)
        if has.size:
            material = model.geom_matid[self._drawn[has]]
            for field in ("emission", "specular", "shininess"):
                geoms[field][has] = getattr(model, f"mat_{field}")[material]
            textures = model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
            geoms["texture"][has] = np.append(self._textures, -1)[textures]
            repeat = model.mat_texrepeat[material].astype(np.float64)
            # With places on the surface, MuJoCo takes 0 and less for 1.
            in_metres = np.isin(kind, (_Kind.mjGEOM_MESH, _Kind.mjGEOM_HFIELD))
            on_surface = (self._own_places | ~in_metres)[has, None]
            repeat = np.where(on_surface & ~(repeat > 0.0), 1.0, repeat)
            geoms["repeat"][has] = narrow(repeat * self._scale()[has])
            geoms["cube"] = narrow(self._cube())

    def _scale(self) -> Floats:
        """Return how often a texture is repeated on each geom for its size, shape (n, 2)."""
        model, drawn = self.model, self._drawn
        uniform = model.mat_texuniform[model.geom_matid[drawn]][:, None]
        size = _sizes(model.geom_type[drawn], model.geom_size[drawn])[:, :2]
        above = self._from_above[:, None]
        scale = np.where(above, np.where(uniform, 1.0, 1.0 / size), np.where(uniform, size, 1.0))
        return np.where(self._own_places[:, None], 1.0, scale)

    def _cube(self) -> Floats:
        """Return factors of the geoms' points to directions in a cube of textures, shape (n, 3)."""
        model, drawn = self.model, self._drawn
        uniform = model.mat_texuniform[model.geom_matid[drawn]][:, None]
        kind, size = model.geom_type[drawn], _sizes(model.geom_type[drawn], model.geom_size[drawn])
        in_metres = np.isin(kind, (_Kind.mjGEOM_MESH, _Kind.mjGEOM_HFIELD, _Kind.mjGEOM_PLANE))
        return np.where(uniform, size, 1.0) / np.where(in_metres[:, None], 1.0, size)

    def _add_mesh(self, mesh: PreparedMesh) -> int:
        return int(
            self._library.raster_mesh(
                self._world, len(mesh.points), _at(mesh.points), _at(mesh.normals),
                _at(mesh.places), _at(mesh.colours), len(mesh.corners), _at(mesh.corners),
                _at(mesh.parts), mesh.part_count, _at(mesh.beyond), _at(mesh.clusters),
            )
        )  # fmt: skip

    def _lens(self, info: CameraInfo) -> int:
        if info not in self._lenses:
            x = ((np.arange(info.width) - info.cx) / info.fx).astype(np.float32)
            y = ((np.arange(info.height) - info.cy) / info.fy).astype(np.float32)
            planes: Any = x, y, None
            if not (info.is_pinhole and _even(x) and _even(y)):
                planes = np.moveaxis(pixel_rays(info), -1, 0).astype(np.float32)
                planes = [np.ascontiguousarray(plane) for plane in planes]
            self._lenses[info] = self._library.raster_lens(
                self._world, info.width, info.height, *map(_at, planes)
            )
        return self._lenses[info]


def library_for(model: Any, instructions: str = "") -> Any:
    """Return the rasteriser's library for a model.

    Raises:
        GraphicsError: The rasteriser was not compiled with the package.
        ValueError: The model has skins or flexes, which are not drawn.
    """
    for kind, count in (("skin", model.nskin), ("flex", model.nflex)):
        if count:
            raise ValueError(
                f'renderer = "raster": expected a world without {kind}, found {count}; '
                '"mujoco" draws them'
            )
    if not libraries():
        raise GraphicsError(
            'renderer = "raster": expected sims/cameras/_raster_*.so, found none: there was no '
            "C++ compiler (GCC 11 or later) when the package was installed. Install one "
            "(Debian, Ubuntu: apt-get install g++) and the package again, or say "
            'renderer = "mujoco"'
        )
    return libraries()[instructions or next(iter(libraries()))]


def _even(rays: npt.NDArray[np.float32]) -> bool:
    """Return whether rays are at equal steps, if float32 can tell them apart at all."""
    steps = np.diff(rays.astype(np.float64))
    return not steps.size or bool(steps.min() > max(0.9 * steps.max(), 1e-30))


def _sizes(kind: npt.NDArray[Any], size: Floats) -> Floats:
    """Return half lengths of geoms along x, y and z, shape (n, 3)."""
    halves = size.copy()
    ball = kind == _Kind.mjGEOM_SPHERE
    halves[ball] = size[ball, :1]
    upright = np.isin(kind, (_Kind.mjGEOM_CYLINDER, _Kind.mjGEOM_CAPSULE))
    halves[upright, 1:] = size[upright, :2]
    halves[halves == 0.0] = 1.0  # a plane without end
    return halves
