"""Milliseconds of a drawn frame on one core, by world and lens, and seconds to a first image.

The project's rasteriser beside MuJoCo's renderer (OpenGL in software, one thread) in turns, without
noise: colour, depth and object numbers at 512 x 512 from places along each world's tour. A frame's
state is new each time; the best of three drawings counts, as another process may hold one up, and
of the places the median.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np

from bench.system import in_turns
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
from sims.cameras.lens import Lens
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


class FrameRow(msgspec.Struct, frozen=True, kw_only=True):
    """Cost of a frame: colour, depth and object numbers."""

    world: str
    camera: str
    raster_ms: float
    mujoco_ms: float | None  # None: there is no OpenGL here
    ratio: float | None  # of MuJoCo's to ours


class FirstImageRow(msgspec.Struct, frozen=True, kw_only=True):
    """Seconds from the start of ``python -m runtime run`` to its first image, median."""

    world: str
    seconds: float


class Firsts(Node):
    """Ends the run at the first image."""

    images = Input(Image)

    async def run(self) -> None:
        """Wait for it."""
        async for image in self.images:
            self.log.info("first image, of %d columns", image.data.shape[1])
            self.stop("it came")


def measure(*, places: int = 5, progress: Callable[[str], None] = lambda _: None) -> list[FrameRow]:
    """Measure at a number of places of each world, with both renderers in turns."""
    rows = []
    for world in WORLDS:
        progress(world)
        rows += _measure_world(world, places)
    return rows


def _measure_world(world: str, places: int) -> list[FrameRow]:
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
        for camera, each in CAMERAS.items():
            shot = _shot(each, model.nq, place, 0.9 * number)
            for _, name in in_turns(renderers, 1):
                times = []
                for _ in range(3):
                    start = time.perf_counter()
                    renderers[name].expose((shot,))
                    times.append(time.perf_counter() - start)
                taken.setdefault((camera, name), []).append(1e3 * min(times))
    for renderer in renderers.values():
        renderer.close()
    rows = []
    for camera in CAMERAS:
        ours, other = (median(taken.get((camera, name), [math.nan])) for name in RENDERERS)
        known = not math.isnan(other)
        rows.append(
            FrameRow(
                world=world,
                camera=camera,
                raster_ms=ours,
                mujoco_ms=other if known else None,
                ratio=other / ours if known else None,
            )
        )
    return rows


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


def measure_first_image(*, repeats: int = 5) -> list[FirstImageRow]:
    """Measure whole processes, from their start to their first image and end."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for world in ("hall", "yard"):
            path = Path(folder) / f"{world}.toml"
            path.write_text(_FILE.format(world=world), encoding="utf-8")
            taken = []
            for _ in range(repeats + 1):
                start = time.perf_counter()
                with subprocess.Popen(
                    [sys.executable, "-u", "-m", "runtime", "run", str(path)],
                    cwd=folder,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                ) as process:
                    assert process.stdout is not None
                    for line in process.stdout:
                        if "first image" in line:
                            taken.append(time.perf_counter() - start)
                            break
                    process.stdout.read()
            rows.append(FirstImageRow(world=world, seconds=median(taken[1:])))  # textures drawn
    return rows
