"""Shadow maps: the depth that each light sees of the geoms that throw shadows.

A light that stands still sees most of a world stand still, too. That part is drawn once; what moves
is laid over it in each frame, and restored in the next one, in the pixels that it covers and
nowhere else. A map of depths is a minimum: the result is that of drawing all geoms together.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sims.cameras.layouts import POSE, VIEW, address
from sims.cameras.stage import NEAR, SHADOW_SIZE

SUN_AWAY = 200.0  # distance at which a directional light's map is drawn, in half widths of it
PAUSE = 100  # changes of the scene after which a geom that moved counts as standing still again
_TILE = 16
_ROOM = _TILE + 8  # elements after a map, which its last tile and vectors at its end may touch


class _Map:
    """Shadow map of a light.

    Attributes:
        settings: What MuJoCo says of the light's place, direction and cone.
        eye: Pixel size and pose by these; None if the map covers nothing.
        depth: Distance along the light's axis to what is nearest, ``inf`` for nothing, metres,
            row by row, and some more elements for vectors.
        changes: Of each tile of `depth`, row by row, how often it was drawn: what the rasteriser
            knows of a tile is true until then.
        still: The same depth of the geoms that stand still.
        covered: Columns and rows where a geom makes `depth` differ from `still`: left, right, top,
            bottom, shape (geoms, 4).
        view: The light's pose and pixel size, as bytes.
        still_version: `ShadowMaps.still_version` that `still` shows; -1 if it shows nothing.
        version: `ShadowMaps.version` that `depth` shows.
    """

    def __init__(self) -> None:
        self.settings: Any = None
        self.eye: tuple[float, Any] | None = None
        self.depth = np.empty(0, np.float32)
        self.changes = np.zeros(0, np.uint32)
        self.still = np.empty(0, np.float32)
        self.covered = np.zeros((0, 4), np.int32)
        self.view = b""
        self.still_version = self.version = -1


class ShadowMaps:
    """Shadow maps of all lights of a model.

    Args:
        library: The rasteriser.
        world: Its scene, whose meshes the geoms refer to.
        threads: Threads that draw what stands still; any number draws the same.
    """

    def __init__(self, library: Any, world: ctypes.c_void_p, model: Any, threads: int) -> None:
        self._library, self._world, self._threads = library, world, threads
        size = int(model.vis.quality.shadowsize)
        # MuJoCo leaves out the outermost pixels of a map: it throws no shadows with two.
        self._size = min(size, SHADOW_SIZE) if size > 2 else 0
        # Metres; a sun whose map covers nothing throws no shadows.
        self._sun_reach = float(model.stat.extent) * float(model.vis.map.shadowclip)
        self._maps: list[_Map] = []
        self._lenses: dict[float, int] = {}  # by the size of their pixels
        self._poses = np.empty(0, POSE)  # the geoms' last ones
        self._solid = np.empty(0, np.bool_)  # geoms that throw shadows: opaque and cut-out ones
        self._moves = np.empty(0, np.bool_)  # geoms that are laid over what stands still
        self._moved = np.empty(0, np.int64)  # version in which each geom was last found changed
        self.version = 0  # of all geoms' poses and opacities
        self.still_version = 0  # of those that stand still

    def add(self, light: Any, source: Any, number: int) -> None:
        """Have a light throw shadows, by a map (of this number) of what MuJoCo's map covers.

        Args:
            light: Row of `layouts.LIGHT` to fill in; stays as it is if the map covers nothing.
            source: MuJoCo's light of the scene.
        """
        settings = (
            int(light["kind"]), float(source.cutoff), source.pos.tobytes(), source.dir.tobytes()
        )  # fmt: skip
        if number == len(self._maps):
            self._maps.append(_Map())
        shadow = self._maps[number]
        if shadow.settings != settings:
            shadow.settings, shadow.eye = settings, self._eye(light, source)
        if shadow.eye is not None:
            if not shadow.depth.size:
                shadow.depth = np.empty(self._size * self._size + _ROOM, np.float32)
                shadow.changes = np.zeros(((self._size + _TILE - 1) // _TILE) ** 2, np.uint32)
            light["size"], light["map"] = self._size, shadow.depth.ctypes.data
            light["changes"] = shadow.changes.ctypes.data
            light["step"], light["eye"] = shadow.eye

    def _eye(self, light: Any, source: Any) -> tuple[float, Any] | None:
        """Return a light's pixel size and pose; None if its map covers nothing."""
        ahead = source.dir.astype(float)
        length = float(np.linalg.norm(ahead))
        angle = source.cutoff if 0.0 <= source.cutoff <= 80.0 else 80.0
        reach, back = math.tan(math.radians(angle)), 0.0
        if light["kind"] == 0:  # rays of a sun are parallel: seen from far away
            reach, back = 1.0 / SUN_AWAY, SUN_AWAY * self._sun_reach
        covers = reach > 1e-6 and (light["kind"] != 0 or 0.0 < back < math.inf)
        if not (self._size and covers and 0.0 < length < math.inf):
            return None
        ahead /= length
        aside = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
        aside /= np.linalg.norm(aside)
        eye = np.zeros((), POSE)
        eye["position"] = source.pos - back * ahead
        eye["turn"] = np.stack([aside, np.cross(ahead, aside), ahead], axis=1).ravel()
        return 2.0 * reach / self._size, eye[()]

    def draw(self, lights: Any, geoms: Any, poses: Any) -> None:
        """Draw what each light that throws shadows sees, as far as that has changed.

        Args:
            lights: All lights, `layouts.LIGHT`.
            geoms: All geoms, `layouts.GEOM`, shape (n,).
            poses: Theirs, `layouts.POSE`, shape (n,); not to be changed later.
        """
        casting = lights[lights["size"] > 0]
        if not casting.size:
            return
        self._compare((geoms["rgba"][:, 3] >= 1.0) | (geoms["cutoff"] > 0.0), poses)
        moving = np.flatnonzero(self._moves & self._solid).astype(np.int32)
        for light, shadow in zip(casting, self._maps, strict=False):
            view = light["eye"].tobytes() + light["step"].tobytes()
            if view == shadow.view and shadow.version == self.version:
                continue
            shadow.version = self.version
            if view != shadow.view:  # perhaps it moves on: all is drawn together
                shadow.view, shadow.still_version = view, -1
                self._draw(light, lights, geoms, self._solid, shadow.depth)
                shadow.changes += 1
                continue
            if shadow.still_version != self.still_version:
                shadow.still_version = self.still_version
                shadow.still = np.empty_like(shadow.depth)
                self._draw(light, lights, geoms, self._solid & ~self._moves, shadow.still)
                shadow.depth[:] = shadow.still
                shadow.changes += 1
                shadow.covered = np.zeros((len(geoms), 4), np.int32)
            self._library.raster_shadow(
                self._world, self._lens(light), ctypes.c_float(NEAR),
                address(np.array([light["eye"]], POSE)), len(geoms), address(geoms), address(poses),
                len(moving), address(moving), address(shadow.still), address(shadow.depth),
                address(shadow.changes), address(shadow.covered),
            )  # fmt: skip

    def _compare(self, solid: npt.NDArray[np.bool_], poses: Any) -> None:
        """Find the geoms that changed since the last frame, and decide which of them move."""
        count = len(poses)
        if len(self._poses) != count:
            self._poses, self._solid = poses, solid
            self._moves, self._moved = np.zeros(count, np.bool_), np.zeros(count, np.int64)
            return
        before, after = (all_.view(np.int64).reshape(count, -1) for all_ in (self._poses, poses))
        changed = (before != after).any(axis=1) & solid | (solid != self._solid)
        self._poses, self._solid = poses, solid
        if not changed.any():
            return
        self.version += 1
        self._moved[changed] = self.version
        if (changed & ~self._moves).any():
            self._moves = (self._moved > 0) & (self._moved > self.version - PAUSE)
            self.still_version += 1

    def _lens(self, light: Any) -> int:
        if (step := float(light["step"])) not in self._lenses:
            size = self._size
            rays = ((np.arange(size) - 0.5 * (size - 1)) * step).astype(np.float32)
            self._lenses[step] = self._library.raster_lens(
                self._world, size, size, address(rays), address(rays), None
            )
        return self._lenses[step]

    def _draw(self, light: Any, lights: Any, geoms: Any, which: Any, depth: Any) -> None:
        """Draw some geoms, at their last poses, into a map."""
        frame = np.zeros(1, VIEW)
        frame["width"] = frame["height"] = frame["last"] = self._size
        frame["sky"], frame["poses"], frame["threads"] = -1, 1, self._threads
        frame["near"], frame["far"] = NEAR, np.inf
        eye, seen = np.array([light["eye"]], POSE), geoms.copy()
        seen["rgba"][~which, 3] = 0.0
        self._library.raster_draw(
            self._world, self._lens(light), address(frame), address(eye), len(seen), address(seen),
            address(self._poses), len(lights), address(lights), None, address(depth), None,
        )  # fmt: skip
