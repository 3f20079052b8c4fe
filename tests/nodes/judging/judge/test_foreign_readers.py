"""Readers of other packages: asked first, and none of them can break the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodes.judging.judgement import JudgeConfig, judge_all
from nodes.judging.readers import Axes, Collected, Options, Reader, Source, complaints, read, table
from nodes.judging.readers.source import Start
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.errors import CommandError
from runtime.extras import READERS, Offer, offers
from tests.nodes.trajectory.samples import walk


class Package(Offer):
    """Entry point of another package, whose object is at hand."""

    loaded: Any = None

    def load(self) -> Any:
        if isinstance(self.loaded, Exception):
            raise CommandError(f"{self.name}: {self.loaded}")
        return self.loaded


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Package]]:
    """Yield a list for other packages' entry points."""
    ours, others = offers(READERS), list[Package]()
    monkeypatch.setattr("nodes.judging.readers.table.offers", lambda _: (*ours, *others))
    monkeypatch.setattr(table, "_complaints", {})
    table._loaded.cache_clear()
    yield others
    table._loaded.cache_clear()


def package(name: str, loaded: Any) -> Package:
    offer = Package("theirs", name, "theirs:READERS")
    offer.loaded = loaded
    return offer


def reader(**changes: Any) -> Reader:
    def read_npy(path: Path, options: Options) -> Source:
        collected = Collected(str(path))
        for t, *row in np.load(path).tolist():
            collected.add(round(t * 1e9), row[:3], row[3:])
        return collected.source(axes=Axes("ned", "frd"))

    def matches(path: Path, start: Start | None) -> bool:
        return path.suffix == ".npy"

    fields = {"name": "numpy", "recognized": "`.npy`", "columns": "t x y z qw qx qy qz"}
    fields |= {"stamps": "s", "axes": "`ned`"}
    return Reader(**{**fields, "matches": matches, "read": read_npy, **changes})


def fail(*_: Any) -> Any:
    raise RuntimeError("not today")


def files(folder: Path) -> tuple[Path, Path, Trajectory]:
    poses = walk(20)
    rows = np.c_[poses.stamps / 1e9, poses.positions, poses.orientations]
    np.save(folder / "t.npy", rows)
    write_tum(folder / "t.tum", poses)
    return folder / "t.npy", folder / "t.tum", poses


def test_a_packages_reader_is_in_the_table(offered: list[Package], tmp_path: Path) -> None:
    array, tum, poses = files(tmp_path)
    with pytest.raises(ValueError, match="expected a trajectory"):
        read(str(array))
    table._loaded.cache_clear()
    offered.append(package("numpy", reader()))
    for path in (array, tum):
        assert read(str(path)).poses.positions == pytest.approx(poses.positions, abs=1e-8)
    assert read(str(array)).axes == Axes("ned", "frd")
    assert "numpy" in [row.name for row in table.readers()]


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        (ImportError("no such thing"), r"reader left out: broken: no such thing"),
        (7, r"reader left out: broken of the package theirs: expected a Reader or several, fou"),
        ([7], r"reader left out: broken of the package theirs: expected a Reader or several"),
        (reader(matches=fail), r"reader left out: numpy of the package theirs: not today"),
    ],
)
def test_a_broken_one_is_named_once_and_left_out(
    loaded: Any, message: str, offered: list[Package], tmp_path: Path
) -> None:
    _, tum, poses = files(tmp_path)
    offered += [package("broken", loaded)]
    first, second = read(str(tum)), read(f"b={tum}")
    assert (first.poses.stamps == poses.stamps).all()
    assert len(complaints()) == 1
    assert message.partition(" expected")[0] in complaints()[0]
    _, _, _, notes = judge_all(first, [second], None, JudgeConfig())
    assert notes == complaints()


def test_one_that_fails_on_its_own_file_is_an_error(offered: list[Package], tmp_path: Path) -> None:
    array, _, _ = files(tmp_path)
    offered.append(package("numpy", reader(read=fail)))
    with pytest.raises(
        ValueError, match=r"t\.npy: reader left out: numpy of the package theirs: not"
    ):
        read(str(array))
