"""Prepared meshes are kept, and are made anew when a file or a setting changes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sims.scans.kept import MOST_ENTRIES, folder, kept
from sims.scans.mesh_file import Material, MeshFile, Piece
from sims.scans.preparing import Prepared, prepare
from sims.scans.settings import MeshSpec
from tests.sims.scans.test_preparing import NORMALS, PLACES, QUAD, quad


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder()


def whole() -> Prepared:
    """Return a mesh with all that there may be."""
    colours = np.arange(16, dtype=np.uint8).reshape(4, 4)
    piece = quad(normals=NORMALS, places=PLACES, colours=colours)
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    paint = Material("paint", (0.5, 0.25, 1.0, 0.5), image, 0.0, True, True, True)
    materials = (paint, Material(image=image), Material("plain"))
    table = Piece("table", 1, piece.points + np.array((0.0, 0.0, 1.0)), QUAD, places=PLACES)
    return prepare(
        MeshFile((piece, table), materials, left_out=("a note",)), MeshSpec(solid="hulls")
    )


class Counted:
    """Maker that counts its calls."""

    def __init__(self, *files: Path) -> None:
        self.calls, self.files = 0, files

    def __call__(self) -> tuple[Prepared, tuple[Path, ...]]:
        self.calls += 1
        return whole(), self.files


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and bool((a == b).all())
    if isinstance(a, tuple) and isinstance(b, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return a == b


def test_what_is_read_back_is_what_was_made(tmp_path: Path) -> None:
    file, make = tmp_path / "a.glb", Counted()
    file.write_bytes(b"1")
    first = kept(file, MeshSpec(), make)
    assert same(kept(file, MeshSpec(), make), first)
    assert make.calls == 1
    assert same(first, whole())
    again = kept(file, MeshSpec(), make)
    assert again.materials[0].image is again.materials[1].image


def test_it_is_made_anew_for_other_content_settings_and_files(tmp_path: Path, cache: Path) -> None:
    file, image = tmp_path / "a.obj", tmp_path / "a.png"
    file.write_bytes(b"1")
    image.write_bytes(b"1")
    make, spec = Counted(image), MeshSpec()

    def makes_anew() -> bool:
        before = make.calls
        kept(file, spec, make)
        return make.calls > before

    assert makes_anew()
    assert not makes_anew()
    file.write_bytes(b"2")
    assert makes_anew()
    image.write_bytes(b"2")
    assert makes_anew()
    assert not makes_anew()
    image.unlink()
    make.files = ()
    assert makes_anew()
    spec = MeshSpec(voxel=0.2)
    assert makes_anew()
    for entry in cache.glob("*.npz"):
        entry.write_bytes(entry.read_bytes()[:-100])
    assert makes_anew()


def test_a_mesh_of_which_a_file_is_missing_is_not_kept(tmp_path: Path, cache: Path) -> None:
    file = tmp_path / "a.obj"
    file.write_bytes(b"1")
    part = whole()._replace(notes=("image 'a.png' (1): not found",))
    for _ in range(2):
        assert kept(file, MeshSpec(), lambda: (part, ())) is part
    assert not list(cache.glob("*.npz"))


def test_the_oldest_entries_go(tmp_path: Path, cache: Path) -> None:
    for number in range(MOST_ENTRIES + 2):
        file = tmp_path / f"{number}.glb"
        file.write_bytes(b"%d" % number)
        kept(file, MeshSpec(), Counted())
    assert len(list(cache.glob("*.npz"))) == MOST_ENTRIES


def test_a_cache_that_cannot_be_written_does_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    file, make = tmp_path / "a.glb", Counted()
    file.write_bytes(b"1")
    kept(file, MeshSpec(), make)
    assert make.calls == 1
