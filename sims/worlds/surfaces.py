"""Surfaces of built-in worlds: their shapes, and their textures, each drawn once and kept.

A surface is a grid of points seen from outside: rows run down, columns to the right; z up, metres.

Textures are kept in ``~/.cache/visnav-runtime/worlds``. Each has random numbers of its own, so that
a world in which nobody sees is built without them, and everything in it is where it is with them.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import logging
import math
import os
import platform
import shutil
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds.materials import Canvas, Image, to_bytes

Array = npt.NDArray[np.float64]
Window = tuple[float, float, float, float]
"""A part of a texture: left, top, right, bottom, in 0..1, rows counted from the top."""

STEP = 1.0  # surfaces are cut at least this fine (metres): MuJoCo lights vertices, not pixels


class Surface(NamedTuple):
    """Triangle mesh for MuJoCo."""

    points: Array  # metres, shape (n, 3)
    normals: Array  # outward unit vectors, shape (n, 3)
    texture: Array  # texture coordinates, shape (n, 2)
    faces: npt.NDArray[np.int32]  # indices, anticlockwise from outside, shape (m, 3)


def grid(points: Array, texture: Array) -> Surface:
    """Return the surface through points (rows, columns, 3), with texture coordinates (…, 2)."""
    rows, columns = points.shape[:2]
    right = np.gradient(points, axis=1)
    up = -np.gradient(points, axis=0)
    normals = np.cross(right, up)
    # Where a grid closes in a point (a pole) the neighbours' normal serves.
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    return Surface(points.reshape(-1, 3), normals.reshape(-1, 3), texture.reshape(-1, 2), faces)


def _stacked(*coordinates: Array) -> Array:
    return np.stack(np.broadcast_arrays(*coordinates), axis=2)


def join(surfaces: list[Surface]) -> Surface:
    """Return several surfaces joined."""
    starts = np.cumsum([0] + [len(surface.points) for surface in surfaces[:-1]])
    *arrays, faces = zip(*surfaces, strict=True)
    moved = [corners + start for corners, start in zip(faces, starts, strict=True)]
    points, normals, texture = map(np.concatenate, arrays)
    return Surface(points, normals, texture, np.concatenate(moved).astype(np.int32))


def quad(corner: Array, right: Array, down: Array, window: Window, step: float = STEP) -> Surface:
    """Return a flat rectangle: its top left corner, and its two edges, metres."""
    columns = max(1, math.ceil(float(np.linalg.norm(right)) / step))
    rows = max(1, math.ceil(float(np.linalg.norm(down)) / step))
    across = np.linspace(0.0, 1.0, columns + 1)[None, :, None]
    along = np.linspace(0.0, 1.0, rows + 1)[:, None, None]
    left, top, far_right, bottom = window
    places = left + (far_right - left) * across, top + (bottom - top) * along
    texture = np.concatenate(np.broadcast_arrays(*places), axis=2)
    return grid(corner + right * across + down * along, texture)


FACES: dict[str, tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]] = {
    "front": ((-1, 1, 1), (0, -1, 0), (0, 0, -1)),
    "left": ((1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    "back": ((1, -1, 1), (0, 1, 0), (0, 0, -1)),
    "right": ((-1, -1, 1), (1, 0, 0), (0, 0, -1)),
    "top": ((-1, -1, 1), (0, 1, 0), (1, 0, 0)),
    "bottom": ((-1, 1, -1), (0, -1, 0), (1, 0, 0)),
}
"""A box's faces: the sign of the top left corner, the way to the right, the way down. The front
looks to -x: it is what a vehicle that flies north sees."""


def face_size(name: str, size: tuple[float, float, float]) -> tuple[float, float]:
    """Return the width and the height of a box's face, metres."""
    _, right, down = FACES[name]
    return float(np.abs(right) @ np.asarray(size)), float(np.abs(down) @ np.asarray(size))


def box(size: tuple[float, float, float], windows: dict[str, Window]) -> Surface:
    """Return a box about the origin, with the faces named by `windows`."""
    extent = np.asarray(size)
    surfaces = []
    for name, window in windows.items():
        corner, right, down = (np.array(sign) * extent for sign in FACES[name])
        surfaces.append(quad(corner / 2.0, right, down, window))
    return join(surfaces)


def cylinder(
    radius: float, height: float, side: Window, top: Window | None, sides: int = 24
) -> Surface:
    """Return an upright cylinder about the origin, its top closed if `top` is given."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)[None, :]  # outside: to the right
    levels = np.linspace(0.5, -0.5, max(1, math.ceil(height / STEP)) + 1)[:, None]
    points = _stacked(radius * np.cos(angle), radius * np.sin(angle), height * levels)
    u = side[0] + (side[2] - side[0]) * np.linspace(0, 1, sides + 1)[None, :]
    v = side[1] + (side[3] - side[1]) * (0.5 - levels)
    parts = [grid(points, _stacked(u, v))]
    if top is not None:
        parts.append(disc(radius, height / 2.0, top))
    return join(parts)


def disc(radius: float, level: float, window: Window) -> Surface:
    """Return a flat round lid facing up, at height `level`."""
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([[[0.0, 0.0]], rim])
    centre = np.array([window[0] + window[2], window[1] + window[3]]) / 2.0
    scale = np.array([window[2] - window[0], window[3] - window[1]]) / 2.0
    faces = np.array([[0, i, i + 1] for i in range(1, 25)], np.int32)
    solid = np.concatenate([points * radius, np.full((26, 1), level)], axis=1)
    return Surface(solid, np.tile([0.0, 0.0, 1.0], (26, 1)), centre + points * scale, faces)


def blob(radii: tuple[float, float, float], bumps: Array, window: Window) -> Surface:
    """Return an ellipsoid about the origin whose radius `bumps` (rows, columns) multiplies."""
    rows, columns = bumps.shape
    polar = np.linspace(0.0, np.pi, rows)[:, None]
    angle = np.linspace(0.0, 2.0 * np.pi, columns)[None, :]
    bumps = bumps.copy()
    bumps[:, -1] = bumps[:, 0]
    bumps[0], bumps[-1] = bumps[0, 0], bumps[-1, 0]
    points = _stacked(
        radii[0] * bumps * np.sin(polar) * np.cos(angle),
        radii[1] * bumps * np.sin(polar) * np.sin(angle),
        radii[2] * bumps * np.cos(polar),
    )
    u = np.linspace(window[0], window[2], columns)[None, :]
    v = np.linspace(window[1], window[3], rows)[:, None]
    return grid(points, _stacked(u, v))


def arch(
    inner: float, outer: float, depth: float, angles: int, per_metre: tuple[float, float]
) -> Surface:
    """Return a half ring on its feet, open along x, with texture coordinates of a metre."""
    turn = np.linspace(np.pi, 0.0, angles + 1)
    rims = {radius: np.stack([np.cos(turn), np.sin(turn)], 1) * radius for radius in (inner, outer)}
    around = turn[::-1] * (inner + outer) / 2.0 * per_metre[0]
    half, parts = depth / 2.0, []
    # The front looks to -x, and there the left is +y; then the back, the outside, the inside.
    for upper, lower, sign, height in (
        ((-half, outer), (-half, inner), 1.0, outer - inner),
        ((half, outer), (half, inner), -1.0, outer - inner),
        ((half, outer), (-half, outer), 1.0, depth),
        ((-half, inner), (half, inner), 1.0, depth),
    ):
        y, z = (np.stack([rims[radius][:, k] for _, radius in (upper, lower)]) for k in (0, 1))
        points = _stacked(np.array([[upper[0]], [lower[0]]]), -sign * y, z)
        parts.append(grid(points, _stacked(around, np.array([[0.0], [height * per_metre[1]]]))))
    return join(parts)


Draw = Callable[..., Image]
"""Returns an image, shape (h, w, 3), on a `Canvas`, and with further arguments if it has some."""

_LOG = logging.getLogger("visnav.worlds")
_HERE = Path(__file__).parent
_TABLE = _HERE / "leaps.toml"
_LEAPS: dict[str, dict[str, tuple[int, int]]] = tomllib.loads(_TABLE.read_text(encoding="utf-8"))
_DIGEST, _SIZE = 16, 4
_UNUSED = 14 * 86400.0  # age at removal of another version's unused textures, seconds


def own_generator(
    world: str, seed: int, name: str, random: np.random.Generator
) -> np.random.Generator:
    """Return a texture's own generator, and advance the world's past its draws."""
    leap = _LEAPS.get(world, {}).get(name)
    if leap is None:
        return np.random.default_rng([seed, *f"{world}/{name}".encode()])
    own = copy.deepcopy(random)
    steps, half = leap
    bits = random.bit_generator
    bits.advance(steps)  # type: ignore[attr-defined]
    if half >= 0:
        bits.state = {**bits.state, "has_uint32": 1, "uinteger": half}
    return own


def texture(world: str, seed: int, name: str, draw: Draw, canvas: Canvas) -> npt.NDArray[np.uint8]:
    """Return a texture (h, w, 3), RGB, from a readable cache or drawn."""
    file = f"{world}-{seed}-{name}"
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        return _read(folder() / file)
    _say_once(world)
    drawn = to_bytes(draw(canvas))
    try:
        _write(folder() / file, drawn)
    except (OSError, RuntimeError) as error:
        _LOG.debug("expected a folder for textures, found: %s", error)
    return drawn


@functools.cache
def _say_once(world: str) -> None:
    _LOG.info("drawing the textures of %s, to be kept for the next runs", world)


def folder() -> Path:
    """Return the folder of this version's textures.

    Raises:
        OSError: The source of the drawing code is missing, so its version is unknown.
        RuntimeError: The user has no home.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    return base / "visnav-runtime" / "worlds" / _version()


@functools.cache
def _version() -> str:
    digest = hashlib.blake2b(digest_size=8)
    for part in (np.__version__, cv2.__version__, platform.machine()):
        digest.update(part.encode())
    for source in sorted({Path(__file__).with_suffix(".py"), *_HERE.glob("*.py"), _TABLE}):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _digest(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST).digest()


def _read(path: Path) -> npt.NDArray[np.uint8]:
    content = path.read_bytes()
    if content[:_DIGEST] != _digest(memoryview(content)[_DIGEST:]):
        raise ValueError(f"{path}: expected a whole texture")
    rows = int.from_bytes(content[_DIGEST : _DIGEST + _SIZE])
    return np.frombuffer(content, np.uint8, offset=_DIGEST + _SIZE).reshape(rows, -1, 3)


def _write(path: Path, image: npt.NDArray[np.uint8]) -> None:
    """Write a texture as a whole, whoever else does so at the same time."""
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        _tidy(path.parent)
    content = len(image).to_bytes(_SIZE) + image.tobytes()
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as unfinished:
        file = Path(unfinished) / "texture"
        file.write_bytes(_digest(content) + content)
        file.replace(path)


def _tidy(here: Path) -> None:
    for other in here.parent.iterdir():
        used = max((file.stat().st_atime for file in other.glob("*")), default=0.0)
        if other != here and time.time() - used > _UNUSED:
            shutil.rmtree(other, ignore_errors=True)
