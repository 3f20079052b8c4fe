"""Textures of built-in worlds: each is drawn once, and kept in ``~/.cache/visnav-runtime/worlds``.

Each has random numbers of its own, so that a world in which nobody sees is built without them, and
everything in it is where it is with them.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import logging
import os
import platform
import shutil
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from sims.worlds.materials import Canvas, Image, to_bytes

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
    found = hashlib.blake2b(digest_size=8)
    for part in (np.__version__, cv2.__version__, platform.machine()):
        found.update(part.encode())
    for source in sorted({Path(__file__).with_suffix(".py"), *_HERE.glob("*.py"), _TABLE}):
        found.update(source.read_bytes())
    return found.hexdigest()


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
        used = max((each.stat().st_atime for each in other.glob("*")), default=0.0)
        if other != here and time.time() - used > _UNUSED:
            shutil.rmtree(other, ignore_errors=True)
