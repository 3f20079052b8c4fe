"""Prepared meshes, kept in ``~/.cache/visnav-runtime/scans`` so that the next run starts at once.

An entry is found by the file's content and settings, and holds for as long as the other files that
were read with it (images, materials, parts of a Gazebo world) are unchanged.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import logging
import os
import struct
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import Material
from sims.scans.preparing import Part, Prepared
from sims.scans.settings import MeshSpec

_LOG = logging.getLogger("visnav.world")
_ARRAYS = ("points", "corners", "normals", "places", "colours")
MOST_ENTRIES = 20  # the oldest go
SEARCHED = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH")  # environment that finds models


def kept(
    path: Path, spec: MeshSpec, make: Callable[[], tuple[Prepared, Sequence[Path]]]
) -> Prepared:
    """Return what is kept of a file and its settings; else make it, and keep it.

    Args:
        make: Gives also all files that were read.
    """
    try:
        entry = folder() / f"{_key(path, spec)}.npz"
    except (OSError, RuntimeError):  # without a home
        return make()[0]
    with contextlib.suppress(OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError):
        prepared = _read(entry)
        os.utime(entry)
        return prepared
    _LOG.info("preparing %s, to be kept for the next runs", path.name)
    prepared, files = make()
    if any("not found" in note for note in prepared.notes):  # it may be there the next time
        return prepared
    try:
        _write(entry, prepared, [file for file in files if file != path])
    except OSError as error:
        _LOG.debug("expected a folder for prepared meshes, found: %s", error)
    return prepared


def folder() -> Path:
    """Return the folder of prepared meshes; `RuntimeError` if the user has no home."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    return base / "visnav-runtime" / "scans"


def _key(path: Path, spec: MeshSpec) -> str:
    digest = hashlib.blake2b(_version().encode(), digest_size=16)
    digest.update(str(path.resolve()).encode())  # its images are found from there
    digest.update(msgspec.json.encode(spec))
    digest.update("\0".join(os.environ.get(name, "") for name in SEARCHED).encode())
    digest.update(path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _version() -> str:
    digest = hashlib.blake2b(f"{np.__version__} {cv2.__version__}".encode(), digest_size=16)
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _write(entry: Path, prepared: Prepared, files: Sequence[Path]) -> None:
    arrays: dict[str, Any] = {"boxes": prepared.boxes, "extent": prepared.extent}
    parts: dict[str, list[Any]] = {}
    for group in ("parts", "hulls"):
        parts[group] = []
        for number, part in enumerate(getattr(prepared, group)):
            parts[group].append((part.name, part.material))
            for field in _ARRAYS:
                if (values := getattr(part, field)) is not None:
                    arrays[f"{group}.{number}.{field}"] = values
    images = {id(m.image): m.image for m in prepared.materials if m.image is not None}
    arrays |= {f"image.{number}": image for number, image in enumerate(images.values())}
    places = {image: number for number, image in enumerate(images)}
    numbers = [places.get(id(material.image), -1) for material in prepared.materials]
    about = {
        "files": {str(path): _digest(path) for path in files},
        "floor": prepared.floor,
        "baked": prepared.baked,
        "notes": prepared.notes,
        "images": numbers,
        "materials": [material._replace(image=None) for material in prepared.materials],
        **parts,
    }
    arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    entry.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=entry.parent) as unfinished:
        file = Path(unfinished) / "entry.npz"
        np.savez(file, **arrays)
        file.replace(entry)
    entries = sorted(entry.parent.glob("*.npz"), key=lambda other: other.stat().st_mtime)
    for old in entries[:-MOST_ENTRIES]:
        old.unlink(missing_ok=True)


def _mapped(entry: Path, name: str) -> npt.NDArray[np.uint8]:
    """Return an array of an entry in the file, read only; it takes memory only when it is used."""
    with entry.open("rb") as file, zipfile.ZipFile(file) as archive:
        with archive.open(f"{name}.npy") as member:
            while member.read(1 << 20):  # which checks it
                pass
        file.seek(archive.getinfo(f"{name}.npy").header_offset + 26)
        file.seek(sum(struct.unpack("<HH", file.read(4))), os.SEEK_CUR)
        np.lib.format.read_magic(file)
        shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
        return np.memmap(file, dtype, "r", file.tell(), shape, "F" if by_columns else "C")


def _read(entry: Path) -> Prepared:
    with entry.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        about = json.loads(arrays["about"].tobytes())
        for name, digest in about["files"].items():
            if _digest(Path(name)) != digest:
                raise ValueError(f"{entry}: {name} has changed")
        groups = {}
        for group in ("parts", "hulls"):
            groups[group] = tuple(
                Part(name, material, *(  # type: ignore[arg-type]
                    arrays[key] if (key := f"{group}.{number}.{field}") in arrays else None
                    for field in _ARRAYS
                ))
                for number, (name, material) in enumerate(about[group])
            )  # fmt: skip
        materials = []
        images = [_mapped(entry, f"image.{k}") for k in range(max(about["images"], default=-1) + 1)]
        for number, row in zip(about["images"], about["materials"], strict=True):
            material = Material(*row)
            r, g, b, a = material.colour  # a list
            image = images[number] if number >= 0 else None
            materials.append(material._replace(colour=(r, g, b, a), image=image))
        return Prepared(
            groups["parts"], tuple(materials), groups["hulls"], arrays["boxes"], about["floor"],
            about["baked"], arrays["extent"], tuple(about["notes"]),
        )  # fmt: skip
