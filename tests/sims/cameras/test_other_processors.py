"""Other processors draw the same bytes and meet the same triangles, in an emulator."""

from __future__ import annotations

import ctypes
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sims.cameras.layouts import GEOM, LIGHT, POSE, VIEW
from sims.cameras.raster import Raster
from sims.compiled import libraries
from tests.sims.cameras.scenes import fresh
from tests.sims.cameras.test_raster import SPECS, compiled, drawn, places
from tests.sims.test_ray_casting import directions, torus
from tests.sims.triangles import meet

HERE = Path(__file__).parent
SOURCES = HERE.parents[2] / "sims" / "cameras" / "rasteriser"
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
FLAGS = ["-std=c++17", "-O2", "-static", "-pthread", "-ffp-contract=off", "-fno-math-errno"]


class Recorder:
    """The compiled library, which also writes down all calls, for ``replay.cpp``."""

    def __init__(self, library: Any) -> None:
        self._library = library
        self.calls = bytearray()

    def _note(self, *values: Any) -> None:
        """Add whole numbers, or addresses with how many bytes are there."""
        for value in values:
            if isinstance(value, tuple):
                address, count = value
                count = count if address.value else 0
                self.calls += struct.pack("i", count)
                self.calls += ctypes.string_at(address, count) if count else b""
            else:
                self.calls += struct.pack("i", value)

    def raster_new(self) -> Any:
        return self._library.raster_new()

    def raster_free(self, world: Any) -> None:
        self._library.raster_free(world)

    def raster_texel_count(self, width: int, height: int, cube: int) -> int:
        return int(self._library.raster_texel_count(width, height, cube))

    def raster_fill(
        self, to: Any, width: int, height: int, channels: int, data: Any, cube: int
    ) -> None:
        self._note(0, width, height, channels, cube, (data, width * height * channels))
        self._library.raster_fill(to, width, height, channels, data, cube)

    def raster_texels(self, world: Any, texels: Any) -> None:
        self._library.raster_texels(world, texels)

    def raster_texture(self, world: Any, *numbers: int) -> int:
        self._note(7, *numbers)
        return int(self._library.raster_texture(world, *numbers))

    def raster_cluster_count(self, triangles: int) -> int:
        return int(self._library.raster_cluster_count(triangles))

    def raster_find(self, *args: Any) -> int:
        return int(self._library.raster_find(*args))

    def raster_mesh(
        self,
        world: Any,
        vertices: int,
        points: Any,
        normals: Any,
        at: Any,
        colours: Any,
        count: int,
        corners: Any,
        *rest: Any,
    ) -> int:
        arrays = (points, 12 * vertices), (normals, 12 * vertices), (at, 8 * vertices)
        self._note(1, vertices, count, *arrays, (colours, 16 * vertices), (corners, 12 * count))
        mesh = vertices, points, normals, at, colours, count, corners, *rest
        return int(self._library.raster_mesh(world, *mesh))

    def raster_lens(self, world: Any, width: int, height: int, x: Any, y: Any, z: Any) -> int:
        pixels = width * height if z.value else 0
        arrays = (x, 4 * (pixels or width)), (y, 4 * (pixels or height)), (z, 4 * pixels)
        self._note(2, width, height, *arrays)
        return int(self._library.raster_lens(world, width, height, x, y, z))

    def raster_draw(self, world: Any, lens: int, view: Any, eyes: Any, *rest: Any) -> None:
        geoms, geom, poses, lights, light, *_ = rest
        frame = np.frombuffer(ctypes.string_at(view, VIEW.itemsize), VIEW)[0]
        count = int(frame["poses"])
        self._note(3, lens, geoms, lights, int(frame["width"] * (frame["last"] - frame["first"])))
        self._note((view, VIEW.itemsize), (eyes, count * POSE.itemsize))
        self._note((geom, geoms * GEOM.itemsize), (poses, count * geoms * POSE.itemsize))
        self._note((light, lights * LIGHT.itemsize))
        self._library.raster_draw(world, lens, view, eyes, *rest)

    def rays_new(self) -> Any:
        return self._library.rays_new()

    def rays_free(self, trees: Any) -> None:
        self._library.rays_free(trees)

    def rays_mesh(self, trees: Any, vertices: int, points: Any, count: int, corners: Any) -> None:
        self._note(4, vertices, count, (points, 12 * vertices), (corners, 12 * count))
        self._library.rays_mesh(trees, vertices, points, count, corners)

    def rays_build(self, trees: Any, geoms: int, *arrays: Any) -> None:
        sizes = (4, 4, 1, 24, 72)
        self._note(5, geoms, *((at, n * geoms) for at, n in zip(arrays, sizes, strict=True)))
        self._geoms = geoms
        self._library.rays_build(trees, geoms, *arrays)

    def rays_cast(self, trees: Any, *arrays: Any) -> None:
        positions, turns, wanted, origin, rays, directions, distances, geoms, *_ = arrays
        self._note(6, rays, (positions, 24 * self._geoms), (turns, 72 * self._geoms))
        self._note((wanted, self._geoms), (origin, 24), (directions, 24 * rays))
        self._note((distances, 8 * rays), (geoms, 4 * rays))
        self._library.rays_cast(trees, *arrays)


def replayed(calls: bytes, folder: Path) -> bytes:
    """Return what a program for a 64-bit ARM writes that makes the calls."""
    if shutil.which(COMPILER) is None or shutil.which(EMULATOR) is None:
        pytest.skip("needs apt-get install g++-aarch64-linux-gnu qemu-user")
    program = folder / "replay"
    sources = [HERE / "replay.cpp", *SOURCES.glob("*.cpp")]
    subprocess.run([COMPILER, *FLAGS, *map(str, sources), "-o", str(program)], check=True)
    return subprocess.run(
        [EMULATOR, str(program)], input=calls, capture_output=True, check=True
    ).stdout


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_64_bit_arm_meets_the_same(tmp_path: Path) -> None:
    recorder, random = Recorder(next(iter(libraries().values()))), np.random.default_rng(4)
    points, corners = torus(40, 20)
    turns = np.linalg.qr(random.standard_normal((30, 3, 3)))[0]
    places = random.uniform(-4.0, 4.0, (30, 3))
    ways = directions(random, points, corners, places[0], 2000)
    met = meet(recorder, points, corners, np.zeros(3), ways, places, turns, moves=10)
    assert (met.geoms >= 0).sum() > 1000
    assert replayed(bytes(recorder.calls), tmp_path) == b"".join(part.tobytes() for part in met)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("world", ["hall", "forest"])
def test_a_64_bit_arm_draws_the_same(
    world: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pinhole and a fisheye, colour, depth and numbers, in a static program under qemu."""
    recorder = Recorder(next(iter(libraries().values())))
    monkeypatch.setattr("sims.cameras.raster.libraries", lambda: {"recorder": recorder})
    raster, expected = Raster(compiled(fresh(world))), b""
    for place, turn in list(places(world))[:2]:
        for spec in SPECS:
            for image in drawn(raster, spec, place, turn):
                assert image is not None
                expected += image.tobytes()
    raster.close()
    images = replayed(bytes(recorder.calls), tmp_path)
    assert len(images) == len(expected)
    assert images == expected
