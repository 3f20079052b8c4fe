"""Milliseconds of a drawn frame on one core, by world and lens, and seconds to a first image.

The project's rasteriser beside MuJoCo's renderer (OpenGL in software, one thread) in turns, without
noise: colour, depth and object numbers at 512 x 512 from places along each world's tour. A frame's
state is new each time; the best of three drawings counts, as another process may hold one up, and
of the places the median.
"""

from __future__ import annotations

import functools
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench.benchmarks import Progress, Row
from bench.harness import lines_of, paired, silent, timed
from events import Image
from events.frames import from_rpy
from runtime import Input, Node
from runtime.units import Latency
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    GraphicsError,
    add_free_camera,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.optics import Lens
from sims.cameras.renderer import Motion, Shot
from sims.cameras.spec import ImageKind
from sims.cameras.stage import RendererName
from sims.worlds import TOURS, load_world

SIDE, READOUT = 512, 0.03
KINDS: tuple[ImageKind, ...] = ("rgb", "depth", "segmentation")
FISHEYE = Lens(model="equidistant", coefficients=(0.01, 0.002, 0.0, 0.0))
WORLDS = ("hall", "yard", "forest")
RENDERERS: tuple[RendererName, ...] = ("raster", "mujoco")


def _camera(name: str, **settings: Any) -> CameraSpec:
    place = (0.0, 0.0, 0.0)
    return CameraSpec(name=name, images=KINDS, width=SIDE, height=SIDE, position=place, **settings)


CAMERAS = {
    "pinhole, 90°": _camera("pinhole"),
    "rolling shutter, 30 ms": _camera("rolling", readout=Latency(READOUT)),
    "fisheye (KB4), 190°": _camera("fisheye", fov=190.0, lens=FISHEYE),
}


class Firsts(Node):
    """Ends the run at the first image."""

    images = Input(Image)

    async def run(self) -> None:
        """Wait for it."""
        async for image in self.images:
            self.log.info("first image, of %d columns", image.data.shape[1])
            self.stop("it came")


def measure(*, places: int = 5, progress: Progress = silent) -> list[Row]:
    """Measure at a number of places of each world, with both renderers in turns."""
    rows = []
    for world in WORLDS:
        progress(world)
        rows += _measure_world(world, places)
    return rows


def _measure_world(world: str, places: int) -> list[Row]:
    spec = load_world(world)
    prefix = add_free_camera(spec, "free", tuple(CAMERAS.values()))
    model = spec.compile()
    packed, cameras = model_to_bytes(model), tuple(CAMERAS.values())
    renderers: dict[RendererName, CameraRenderer] = {}
    for name in RENDERERS:
        try:
            renderers[name] = CameraRenderer(packed, cameras, prefix, seed=0, renderer=name)
        except GraphicsError:
            continue
    taken: dict[tuple[str, str], list[float]] = {}
    tour = TOURS[world]
    for number in range(places):
        place = np.asarray(tour[number * len(tour) // places])
        for camera, settings in CAMERAS.items():
            shot = _shot(settings, model.nq, place, 0.9 * number)
            sides = {
                name: functools.partial(_draw, renderer, shot)
                for name, renderer in renderers.items()
            }
            for renderer, times in paired(sides, 1).items():
                taken.setdefault((camera, renderer), []).extend(times)
    for opened in renderers.values():
        opened.close()
    rows: list[Row] = []
    for camera in CAMERAS:
        ours, other = (median(taken.get((camera, name), [math.nan])) for name in RENDERERS)
        known = not math.isnan(other)  # without OpenGL there are no figures
        compared = {"mujoco_ms": other if known else None, "ratio": other / ours if known else None}
        rows.append({"world": world, "camera": camera, "raster_ms": ours, **compared})
    return rows


def _draw(renderer: CameraRenderer, shot: Shot) -> float:
    """Return the milliseconds of the best of three drawings."""
    return min(timed(lambda: renderer.expose((shot,))) for _ in range(3)) / 1e6


def _shot(spec: CameraSpec, nq: int, place: Any, heading: float) -> Shot:
    """Return an exposure in a flight to the side, forward and up, turning (1.9 m/s, 1.8 rad/s)."""

    def state(seconds: float) -> Any:
        qpos = np.zeros(nq)
        turn = from_rpy(0.4 * seconds, 0.1 + 0.8 * seconds, heading + 1.5 * seconds)
        qpos[-7:] = pose_to_qpos(tuple(place + np.array([1.0, 1.5, -0.5]) * seconds), turn)
        return qpos

    if not spec.readout:
        return Shot(spec.name, 0, state(0.0))
    times = np.linspace(-READOUT / 2.0, READOUT / 2.0, 31)
    motion = Motion(times, np.array([state(float(seconds)) for seconds in times]))
    return Shot(spec.name, 0, state(0.0), motion=motion)


_FILE = """
[run]
name = "first"
[[nodes]]
name = "drone"
type = "Multirotor"
world = "{world}"
cameras = [{{ name = "camera", latency = "0ms" }}]
[[nodes]]
name = "firsts"
type = "bench.frame:Firsts"
"""


def measure_first_image(*, repeats: int = 5, progress: Progress = silent) -> list[Row]:
    """Measure whole processes, from their start to their first image and end; medians."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for world in ("hall", "yard"):
            path = Path(folder) / f"{world}.toml"
            path.write_text(_FILE.format(world=world), encoding="utf-8")
            taken = []
            for number in range(repeats + 1):
                progress(f"first image of {world}, {number} of {repeats}")
                taken.append(_start(path))
            rows.append({"world": world, "seconds": median(taken[1:])})  # textures drawn
    return rows


def _start(path: Path) -> float:
    """Return the seconds from a run's start to its first image, after its end."""
    begin, seconds = time.perf_counter(), math.nan
    command = [sys.executable, "-u", "-m", "runtime", "run", str(path)]
    with subprocess.Popen(
        command, cwd=path.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        for line in lines_of(process):
            if "first image" in line and math.isnan(seconds):
                seconds = time.perf_counter() - begin
    return seconds
