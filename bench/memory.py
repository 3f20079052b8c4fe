"""Memory of a run in a large scan: all of its processes together, and seconds to its first image.

A million triangles in 250 objects with four images of 4096 x 4096 texels, in which a vehicle flies
with two cameras and two camera processes. The memory is the proportional set size (``Pss`` of
``smaps_rollup``): a page that several processes map counts once in all. The run is started twice:
the first start reads the file and prepares it, the second takes what was kept.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.benchmarks import Progress, Row
from bench.harness import lines_of, silent
from bench.rays import CELLS, PATCHES, room
from events import Image
from runtime import Input, Node

Array = npt.NDArray[Any]

IMAGES, SIDE = 4, 4096
PERIOD = 0.05  # seconds between two looks at the processes
FLOWN = 10  # images of each camera, by which all that is needed is in memory


class Flown(Node):
    """Log of a run's first image, and of the time from which all cameras have sent some."""

    images = Input(Image)

    async def run(self) -> None:
        """Count the images."""
        counts: dict[str, int] = {}
        async for image in self.images:
            if not counts:
                self.log.info("first image")
            counts[image.source] = counts.get(image.source, 0) + 1
            if counts[image.source] == FLOWN == min(counts.values()):
                self.log.info("in flight")


_FILE = """
[run]
name = "memory"
clock = "lockstep"
duration = "{seconds}s"
[[nodes]]
name = "drone"
type = "Multirotor"
world = "scan.glb"
renderer = "{renderer}"
position = [3.8, -3.1]
height = 0.205
camera_processes = 2
[[nodes.cameras]]
name = "left"
images = ["rgb", "depth"]
[[nodes.cameras]]
name = "right"
images = ["rgb", "depth"]
orientation = [0.0, 0.0, 60.0]
[[nodes]]
name = "pilot"
type = "WaypointFollower"
waypoints = [[3.8, -3.1, -1.85], [4.2, -3.6, -1.85], [3.8, -3.1, -1.85]]
[[nodes]]
name = "flown"
type = "bench.memory:Flown"
"""


def measure(*, seconds: float = 3.0, progress: Progress = silent) -> list[Row]:
    """Measure a flight of so many simulated seconds, cold and from what was kept."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("making a scan of a million triangles")
        triangles = write_scan(folder / "scan.glb", CELLS[1_000_000], SIDE)
        file = _FILE.format(seconds=seconds, renderer="raster")
        (folder / "run.toml").write_text(file, encoding="utf-8")
        rows: list[Row] = []
        for start in ("cold", "kept"):
            progress(f"flying in it, {start}")
            rows.append({"start": start, "triangles": triangles, **fly(folder)})
    return rows


def fly(folder: Path) -> dict[str, float]:
    """Run a folder's ``run.toml``; return seconds to its first image, and bytes of memory.

    Returns:
        `seconds`; the most memory of all processes together (`peak`), also from the tenth image of
        each camera on (`flight`); and then that of the run's own process (`main`).
    """
    begin, seen = time.perf_counter(), math.inf
    figures = {"seconds": math.nan, "peak": 0.0, "flight": 0.0, "main": 0.0}
    command = [sys.executable, "-u", "-m", "runtime", "run", "run.toml"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
    with subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    ) as process:  # fmt: skip
        flies, ended = threading.Event(), threading.Event()

        def look() -> None:
            while not ended.wait(PERIOD):
                taken = [memory_of(pid) for pid in family(process.pid)]
                figures["peak"] = max(figures["peak"], sum(taken))
                if flies.is_set() and sum(taken) > figures["flight"]:
                    figures["flight"], figures["main"] = sum(taken), taken[0]

        looker = threading.Thread(target=look)
        looker.start()
        said = []
        for line in lines_of(process):
            said.append(line)
            if "first image" in line and seen is math.inf:
                figures["seconds"] = seen = time.perf_counter() - begin
            if "in flight" in line:
                flies.set()
        ended.set()
        looker.join()
    if process.returncode or not figures["flight"]:
        raise RuntimeError(f"expected a flight with images, found {''.join(said[-20:])}")
    return figures


def family(root: int) -> list[int]:
    """Return a process and all that it has started, and these, and so on."""
    parents: dict[int, list[int]] = {}
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            with contextlib.suppress(OSError):  # it has ended
                after_name = (place / "stat").read_text().rpartition(")")[2].split()
                parents.setdefault(int(after_name[1]), []).append(int(place.name))
    members = [root]
    for member in members:
        members += parents.get(member, [])
    return members


def memory_of(pid: int) -> int:
    """Return the proportional set size of a process, bytes; 0 if it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) << 10
    return 0


def write_scan(path: Path, cells: int, side: int) -> int:
    """Write a bumpy room with bodies in it as GLB, and return how many triangles it has."""
    random = np.random.default_rng(0)
    patches = room(cells)
    data = bytearray()
    views: list[Any] = []
    accessors: list[Any] = []

    def view(part: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part)})
        data.extend(part + bytes(-len(part) % 4))
        return len(views) - 1

    def accessor(values: Array, kind: str, component: int, **more: Any) -> int:
        accessors.append(
            {
                "bufferView": view(values.tobytes()), "componentType": component,
                "count": len(values), "type": kind, **more,
            }
        )  # fmt: skip
        return len(accessors) - 1

    images = []
    for _ in range(IMAGES):
        coarse = random.integers(0, 256, (side // 16, side // 16, 3), np.uint8)
        image = cv2.resize(coarse, (side, side), interpolation=cv2.INTER_LINEAR)
        packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
        images.append({"bufferView": view(packed), "mimeType": "image/jpeg"})
    grid = np.mgrid[: cells + 1, : cells + 1].reshape(2, -1).T / cells
    meshes = []
    for number, (points, corners) in enumerate(patches):
        turned = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=-1)  # y up
        surface, patch = divmod(number, PATCHES * PATCHES)
        places = ((grid + divmod(patch, PATCHES)) / PATCHES).astype(np.float32)
        bounds = {"min": turned.min(axis=0).tolist(), "max": turned.max(axis=0).tolist()}
        attributes = {
            "POSITION": accessor(turned, "VEC3", 5126, **bounds),
            "TEXCOORD_0": accessor(places, "VEC2", 5126),
        }
        indices = accessor(corners.astype(np.uint32).reshape(-1), "SCALAR", 5125)
        primitive = {
            "attributes": attributes, "indices": indices, "material": surface % IMAGES,
        }  # fmt: skip
        meshes.append({"name": f"patch{number}", "primitives": [primitive]})
    head = json.dumps(
        {
            "asset": {"version": "2.0"}, "scene": 0,
            "extensionsUsed": ["KHR_materials_unlit"],
            "scenes": [{"nodes": list(range(len(meshes)))}],
            "nodes": [{"mesh": number} for number in range(len(meshes))],
            "meshes": meshes, "images": images,
            "textures": [{"source": number} for number in range(IMAGES)],
            "materials": [
                {
                    "extensions": {"KHR_materials_unlit": {}}, "doubleSided": True,
                    "pbrMetallicRoughness": {"baseColorTexture": {"index": number}},
                }
                for number in range(IMAGES)
            ],
            "buffers": [{"byteLength": len(data)}], "bufferViews": views,
            "accessors": accessors,
        }
    ).encode()  # fmt: skip
    head += b" " * (-len(head) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(head) + len(data)))
        file.write(struct.pack("<I4s", len(head), b"JSON") + head)
        file.write(struct.pack("<I4s", len(data), b"BIN\0"))
        file.write(data)
    return sum(len(corners) for _, corners in patches)
