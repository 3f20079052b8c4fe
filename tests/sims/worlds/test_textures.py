"""Textures are drawn once, when somebody sees them, and are and move nothing else than before."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sims.worlds import WORLDS, load_world, surfaces
from sims.worlds.builder import Builder
from sims.worlds.materials import Canvas, Image
from tests.opencv import drawn_by_5

SAVED: dict[str, dict[str, str]] = json.loads(
    Path(__file__).with_name("textures.json").read_text(encoding="utf-8")
)
"""Hashes of each world's textures, and of its model, as they were with one generator for all."""

QUICK = ("hall", "corridor", "office", "mocap")
EACH = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in WORLDS]


def hash_of(array: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def hashes(model: Any) -> dict[str, str]:
    """Return hashes of each texture, and of all else but where MuJoCo keeps these."""
    digests = {}
    for number in range(model.ntex):
        begin = int(model.tex_adr[number])
        size = int(model.tex_height[number] * model.tex_width[number]) * 3
        digests[model.tex(number).name] = hash_of(model.tex_data[begin : begin + size])
    return digests | {"model": hash_of(np.concatenate(places(model)))}


def places(model: Any) -> list[Any]:
    """Return where everything is and how large."""
    names = ("geom_pos", "geom_quat", "geom_size", "geom_type", "mesh_vert", "mesh_face")
    return [getattr(model, name).astype(np.float64).round(6).ravel() + 0.0 for name in names]


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in SAVED],
)
@drawn_by_5
def test_neither_pixels_nor_places_have_changed(name: str) -> None:
    """Nor are things elsewhere where nobody sees."""
    model, bare = (load_world(name, bare=bare).compile() for bare in (False, True))
    assert hashes(model) == SAVED[name]
    assert set(SAVED) == set(WORLDS)
    for actual, expected in zip(places(bare), places(model), strict=True):
        np.testing.assert_array_equal(actual, expected)


class Drawings:
    """Counts what is drawn."""

    def __init__(self) -> None:
        self.count = 0

    def draw(self, on: Canvas) -> Image:
        self.count += 1
        return on.random.uniform(size=(*on.shape, 3)).astype(np.float32)

    def world(self, seed: int = 0, name: str = "mine", bare: bool = False) -> bytes:
        model = Builder(name, seed, bare)
        model.material("stone", self.draw, (5, 7), 1.0)
        return bytes(model.spec.texture("stone").data)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_each_is_drawn_once(home: Path) -> None:
    drawings = Drawings()
    first = drawings.world()
    assert drawings.world() == first
    assert drawings.count == 1
    assert [file.name for file in surfaces.folder().iterdir()] == ["mine-0-stone"]
    assert len({first, drawings.world(seed=1), drawings.world(name="other")}) == 3


def test_none_is_drawn_where_nobody_sees(home: Path) -> None:
    drawings = Drawings()
    drawings.world(bare=True)
    assert not drawings.count
    assert not home.exists()


@pytest.mark.parametrize("spoil", [b"", b"short", b"x" * 500, None])
def test_what_is_not_whole_is_drawn_anew(home: Path, spoil: bytes | None) -> None:
    drawings = Drawings()
    first = drawings.world()
    (file,) = surfaces.folder().iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] if spoil is None else spoil)
    assert drawings.world() == first
    assert drawings.count == 2
    assert file.read_bytes() == whole


def test_another_version_has_its_own(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawings = Drawings()
    drawings.world()
    monkeypatch.setattr(surfaces, "_version", lambda: "later")
    drawings.world()
    assert drawings.count == 2
    monkeypatch.setattr(surfaces, "_UNUSED", -1.0)
    monkeypatch.setattr(surfaces, "_version", lambda: "latest")
    drawings.world()
    assert [version.name for version in surfaces.folder().parent.iterdir()] == ["latest"]


def test_it_works_without_a_cache(home: Path) -> None:
    home.write_text("in the way")
    drawings = Drawings()
    assert drawings.world() == drawings.world()
    assert drawings.count == 2
