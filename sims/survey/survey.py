"""Survey of a mesh file as a world: its figures, a start and a tour, views and a plan."""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import msgspec
import mujoco
import numpy as np
import numpy.typing as npt

from events import Vector3
from events.frames import from_rpy
from runtime.errors import CommandError
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.renderer import Shot
from sims.cameras.surfaces import geom_numbers
from sims.scans.mesh_file import Floats
from sims.scans.preparing import joined
from sims.scans.settings import MeshSpec
from sims.scans.solids import voxelise
from sims.scans.world import build, prepared_mesh
from sims.sensors.rays import Hits, Rays
from sims.survey.free_space import find_free_space
from sims.worlds.dynamics import Dynamics

Image = npt.NDArray[np.uint8]

VIEWS = 8  # along the tour, of which every other one is drawn
CAMERA = CameraSpec(
    name="camera", images=("rgb", "depth"), width=752, height=480, position=(0.0, 0.0, 0.0)
)
WIDEST = 100.0  # metres, of a triangle of what is surveyed
CHANNELS, COLUMNS = 16, 1024  # of the lidar whose turn is timed

_CONFIGURATION = """\
[run]
name = {name}
seed = 1
duration = "10min"        # at most; the pilot ends the run when it has landed

[[nodes]]
name = "drone"
type = "Multirotor"
world = {world}
position = {position}
{height}{mesh}
[[nodes.cameras]]
name = "camera"
noise = 2.0
depth_noise = 0.0015

[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [{waypoints}]

[[nodes]]
name = "odometry"
type = "VisualOdometry"

[[nodes]]
name = "evaluation"
type = "Evaluation"

[[nodes]]
name = "report"
type = "Report"
"""


class Survey:
    """What a mesh file gives as a world, found out at once.

    Raises:
        MeshError: As `sims.scans.world.prepared_mesh`.
    """

    def __init__(self, path: Path, mesh: MeshSpec) -> None:
        self.path, self.mesh = path, mesh
        start = time.process_time()
        self.prepared = prepared_mesh(path, mesh)
        spec = build(self.prepared, path.stem, mesh.solid)
        prefix = add_free_camera(spec, "survey", (CAMERA,))
        model = spec.compile()
        self._stage = CameraRenderer(model_to_bytes(model), (CAMERA,), prefix, 0, 1)
        self.load_seconds = time.process_time() - start
        self._voxels = voxelise(*self._triangles(), mesh.voxel, self.prepared.floor or 0.0).filled()
        self.space = find_free_space(self._voxels, self.prepared.floor)
        self._rays = Rays(model, Dynamics(), "survey")
        self._images: list[Image] = []
        self._behind = 0.0  # share of single-sided triangles met by rays that is met from behind

    def lines(self) -> Iterator[str]:
        """Yield what there is to say, a line each."""
        prepared, path = self.prepared, self.path
        low, high = prepared.extent.tolist()
        triangles = sum(len(part.corners) for part in prepared.parts)
        objects = {part.name.rpartition(".chunk")[0] for part in prepared.parts}
        images = [m.image.shape for m in prepared.materials if m.image is not None]
        size = ""
        if images:
            size = f" of up to {max(s[1] for s in images)} x {max(s[0] for s in images)}"
        yield (
            f"{path.name}: {triangles:,} triangles, {len(objects)} objects, {len(images)} "
            f"images{size}"
        )
        yield (
            f"extent: north {low[0]:.2f} to {high[0]:.2f}, east {-high[1]:.2f} to {-low[1]:.2f}, "
            f"height {low[2]:.2f} to {high[2]:.2f} m"
        )
        yield "light: " + ("baked into the images" if prepared.baked else "lit from above")
        floor = (
            "none" if prepared.floor is None else f"a plane at a height of {prepared.floor:.2f} m"
        )
        yield f"ground: {floor}"
        yield f"solid: {self._solid()}"
        for note in prepared.notes:
            yield f"note: {note}"
        yield f"read, prepared and staged: {self.load_seconds:.1f} s of one core"
        size = f"{CAMERA.width} x {CAMERA.height}"
        yield f"image of {size}, colour and depth: {self._image_ms():.1f} ms"
        yield f"lidar turn of {CHANNELS} x {COLUMNS}: {self._turn_ms():.1f} ms"
        if self._behind > 0.5:
            yield (
                f"note: {self._behind:.0%} of what is met from within is met from behind, where it "
                "is not drawn: its faces point outwards; double_sided = true draws them"
            )
        yield from self._free()

    def sheet(self) -> Image:
        """Return four views along the tour and the plan, as an image (BGR); after `lines`."""
        views = [
            cv2.resize(view, (564, 360), interpolation=cv2.INTER_AREA) for view in self._images
        ]
        sheet = np.vstack([np.hstack(views[k : k + 4 : 2]) for k in (0, 4)])
        return np.hstack([sheet, self._plan(sheet.shape[0])])

    def draw(self, path: Path) -> None:
        """Write the sheet as a PNG; `CommandError` if that cannot be."""
        _, data = cv2.imencode(".png", self.sheet())
        try:
            path.write_bytes(data.tobytes())
        except OSError as error:
            raise CommandError(f"{path}: expected a file to write: {error.strerror}") from None

    def configuration(self, folder: Path) -> str:
        """Return a configuration, to be in a folder, that flies the tour with visual odometry."""
        if self.space is None:
            raise CommandError("--config: expected room for a vehicle, found none")
        changed = msgspec.to_builtins(self.mesh)
        usual = msgspec.to_builtins(MeshSpec())
        settings = {key: value for key, value in changed.items() if value != usual[key]}
        mesh = "".join(f"mesh.{key} = {json.dumps(value)}\n" for key, value in settings.items())
        start = self.space.start
        path = os.path.relpath(self.path.absolute(), folder)
        return _CONFIGURATION.format(
            name=json.dumps(re.sub(r"[^\w-]+", "_", self.path.stem).strip("_") or "scan"),
            world=json.dumps(path if "/" in path else f"./{path}"),
            mesh=mesh,
            height=f"height = {start[2]:.3f}\n" if abs(start[2]) > 5e-4 else "",
            position=[round(start[0], 2), round(0.0 - start[1], 2)],
            waypoints=_rows([*self._tour(), self._tour()[0]]),
        )

    def _triangles(self) -> tuple[Floats, npt.NDArray[np.int32]]:
        points, corners = joined(self.prepared.parts)
        # A plane that stands for the ground may be kilometres wide, and is none of the room.
        wide = np.ptp(points[corners][:, :, :2], axis=1).max(axis=1) > WIDEST
        return points, corners[~wide] if self.prepared.floor is not None else corners

    def _tour(self) -> list[Vector3]:
        """Return the tour's waypoints, NED."""
        assert self.space is not None
        return [
            (round(x, 2), round(0.0 - y, 2), round(0.0 - z, 2))
            for x, y, z in self.space.tour.waypoints
        ]

    def _free(self) -> Iterator[str]:
        space = self.space
        if space is None:
            yield "free: a vehicle fits nowhere: is the unit right, and the axis that points up?"
            return
        yield f"free: {space.volume:.0f} m³"
        north, west, height = space.start
        yield f"start: position = [{north:.2f}, {0.0 - west:.2f}], height = {height + 0.0:.3f}"
        tour = space.tour
        yield f"tour: {tour.length:.1f} m, {tour.clearance:.2f} m clear of everything"
        yield f"waypoints = [{_rows([*self._tour(), self._tour()[0]])}]"

    def _views(self) -> list[tuple[Vector3, float]]:
        """Return places (NED) and headings along the tour; without one, in the mesh's middle."""
        if self.space is None or len(self.space.tour.waypoints) < 2:
            middle = self.prepared.extent.mean(axis=0).tolist()
            place = (middle[0], -middle[1], -middle[2])
            return [(place, 2.0 * math.pi * k / VIEWS) for k in range(VIEWS)]
        closed = np.array([*self._tour(), self._tour()[0]])
        steps = np.diff(closed, axis=0)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T[:2]))])
        views = []
        for distance in np.linspace(0.0, along[-1], VIEWS, endpoint=False):
            leg = min(int(np.searchsorted(along, distance, "right")) - 1, len(steps) - 1)
            share = (distance - along[leg]) / max(along[leg + 1] - along[leg], 1e-9)
            north, east, down = (closed[leg] + share * steps[leg]).tolist()
            views.append(((north, east, down), math.atan2(steps[leg, 1], steps[leg, 0])))
        return views

    def _plan(self, height: int) -> Image:
        """Return the plan, north up: what is solid 0.4 to 2 m above ground, and the tour."""
        voxels, floor = self._voxels, self.prepared.floor
        low, high = self.prepared.extent
        scale = min(
            (height - 40) / max(high[0] - low[0], 0.1), (height - 40) / max(high[1] - low[1], 0.1)
        )
        sheet = np.full((height, int((high[1] - low[1]) * scale) + 40, 3), 250, np.uint8)

        def at(north: Any, west: Any) -> tuple[Any, Any]:
            column = (high[1] - west) * scale + 20
            return column, (high[0] - north) * scale + (height - (high[0] - low[0]) * scale) / 2

        heights = voxels.cells[:, 2] * voxels.size + voxels.level
        ground = low[2] if floor is None else floor
        within = (heights > ground + 0.4) & (heights < ground + 2.0)
        for cell in np.unique(voxels.cells[within, :2], axis=0) * voxels.size:
            first, last = at(*(cell + voxels.size / 2)), at(*(cell - voxels.size / 2))
            (left, top), (right, bottom) = np.rint([first, last]).astype(int).tolist()
            sheet[max(top, 0) : bottom + 1, max(left, 0) : right + 1] = (90, 80, 70)
        if self.space is not None:
            places = [at(x, y) for x, y, _ in self.space.tour.waypoints]
            line = np.rint(places).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(sheet, [line], True, (30, 110, 240), 2, cv2.LINE_AA)
            column, row = at(*self.space.start[:2])
            cv2.circle(
                sheet, (round(column), round(row)), 6, (60, 160, 40), cv2.FILLED, cv2.LINE_AA
            )
        metres = 10.0 ** math.floor(math.log10(max((high - low)[:2].max() / 2.0, 0.1)))
        end = (20 + round(metres * scale), height - 12)
        cv2.line(sheet, (20, height - 12), end, (60, 60, 60), 2)
        cv2.putText(
            sheet, f"{metres:g} m", (end[0] + 6, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5,
            (60, 60, 60), 1, cv2.LINE_AA,
        )  # fmt: skip
        return sheet

    def _solid(self) -> str:
        prepared = self.prepared
        if len(prepared.boxes):
            return f"{len(prepared.boxes)} boxes of voxels of {self.mesh.voxel:g} m"
        if prepared.hulls or self.mesh.solid == "hulls":
            return f"{len(prepared.hulls or prepared.parts)} convex hulls"
        return "nothing but the ground" if prepared.floor is not None else "nothing"

    def _image_ms(self) -> float:
        self._images = []
        times = []
        for number, (position, yaw) in enumerate(self._views()):
            shot = Shot("camera", number, pose_to_qpos(position, from_rpy(0.0, 0.0, yaw)))
            start = time.process_time()
            (frame,) = self._stage.expose((shot,))
            times.append(time.process_time() - start)
            assert frame.rgb is not None
            self._images.append(frame.rgb[..., ::-1])
        return 1e3 * median(times)

    def _turn_ms(self) -> float:
        around = np.arange(COLUMNS) * 2.0 * math.pi / COLUMNS
        up = np.radians(np.linspace(-15.0, 15.0, CHANNELS))
        turn, rise = (grid.ravel() for grid in np.meshgrid(around, up))
        directions = np.stack(
            [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=-1
        )
        self._rays.look(self._rays.model.qpos0, 0.0)
        times, behind = [], []
        for (north, east, down), _ in self._views():
            start = time.process_time()
            hits = self._rays.cast(np.array([north, -east, -down]), directions, 100.0)
            times.append(time.process_time() - start)
            behind.append(self._met_from_behind(hits, directions))
        middle = self.prepared.extent.mean(axis=0)
        if self.prepared.floor is not None and self.prepared.floor > middle[2]:
            # The ground is what faces up: of a room that faces outwards its roof.
            hits = self._rays.cast(middle, directions, 100.0)
            behind = [self._met_from_behind(hits, directions)]
        met = np.concatenate(behind)
        self._behind = float(met.mean()) if met.size else 0.0
        return 1e3 * median(times)

    def _met_from_behind(self, hits: Hits, directions: Floats) -> npt.NDArray[np.bool_]:
        """Return of each hit of a single-sided triangle whether it is on its back."""
        model = self._rays.model
        single = geom_numbers(model, "double_sided") == 0.0
        single &= model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        away = np.einsum("ri,ri->r", hits.normals, directions) > 0.0
        return np.asarray(away[single[hits.geoms] & np.isfinite(hits.distances)])


def _rows(places: list[Vector3]) -> str:
    """Return waypoints as TOML, four a line."""
    texts = [f"[{', '.join(f'{value:g}' for value in place)}]" for place in places]
    lines = [", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4)]
    return "\n    " + ",\n    ".join(lines) + ",\n"
