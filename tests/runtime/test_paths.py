"""Where a relative path of a file starts, and that what was resolved runs anywhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from runtime import Changeable, Node, NodeConfig
from runtime.config.model import to_builtins
from runtime.config.reading import load
from runtime.paths import InputPath, NameOrPath, OutputPath, file_names, resolve, written
from runtime.source_files import source_file, source_of


class Part(msgspec.Struct):
    """A table with paths inside."""

    file: InputPath = ""
    note: str = ""


class ReadingConfig(NodeConfig):
    """Every place at which a path may stand."""

    file: InputPath = ""
    maybe: InputPath | None = None
    changing: Changeable[InputPath] = ""
    files: tuple[InputPath, ...] = ()
    named: dict[str, InputPath] = msgspec.field(default_factory=dict)
    parts: tuple[Part, ...] = ()
    world: NameOrPath = "hall"
    plot: OutputPath = "plot.png"
    word: str = ""


class Reading(Node[ReadingConfig]):
    """Reads files."""


TEXT = """
[network]
zenoh = "net/zenoh.json5"
secret = "file:net/secret"

[[nodes]]
name = "reading"
type = "tests.runtime.test_paths:Reading"
"""
SETTINGS = """
file = "a.txt"
maybe = "b.txt"
changing = "../c.txt"
files = ["/d.txt", "e/f.txt"]
named = { g = "g.txt" }
parts = [{ file = "h.txt", note = "h.txt" }]
world = "worlds/room.xml"
word = "a.txt"
"""


def write(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "c.toml"
    path.write_text(text, encoding="utf-8")
    return path


def settings(path: Path, *changes: str) -> ReadingConfig:
    config = load(path, changes).nodes[0].config
    assert isinstance(config, ReadingConfig)
    return config


def test_paths_start_at_the_file_wherever_the_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "files"
    path = write(folder, TEXT + SETTINGS)
    for place in (tmp_path, folder):
        monkeypatch.chdir(place)
        config = settings(path.relative_to(place))
        assert config.file == str(folder / "a.txt")
        assert config.maybe == str(folder / "b.txt")
        assert config.changing == str(folder / "../c.txt")
        assert config.files == ("/d.txt", str(folder / "e/f.txt"))
        assert config.named == {"g": str(folder / "g.txt")}
        assert config.parts == (Part(str(folder / "h.txt"), "h.txt"),)
        assert config.world == str(folder / "worlds/room.xml")
        assert (config.plot, config.word) == ("plot.png", "a.txt")
        network = load(path).network
        assert network.zenoh == str(folder / "net/zenoh.json5")
        assert network.secret == f"file:{folder / 'net/secret'}"


def test_paths_of_the_command_line_start_where_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "files", TEXT)
    monkeypatch.chdir(tmp_path)
    for change in ("reading.file=a.txt", 'reading.file="a.txt"'):
        assert settings(path, change).file == str(tmp_path / "a.txt")
    assert settings(path, "reading.file=~/a.txt").file == str(Path("~/a.txt").expanduser())
    assert settings(path, "reading.file=").file == ""
    assert settings(path, "reading.word=a.txt").word == "a.txt"
    assert settings(path, "reading.world=yard").world == "yard"
    for secret, resolved in (
        ("file:s", f"file:{tmp_path / 's'}"),
        ("file:/s", "file:/s"),
        ("env:S", "env:S"),
        ("sixteen letters/.", "sixteen letters/."),
        ("file:", "file:"),
    ):
        assert load(path, [f"network.secret={secret}"]).network.secret == resolved


def test_what_a_run_writes_down_reads_the_same_files_from_anywhere(tmp_path: Path) -> None:
    before = load(write(tmp_path / "files", TEXT + SETTINGS))
    again = load(write(tmp_path / "runs" / "x", tomli_w.dumps(to_builtins(before))))
    assert again == before


def test_two_machines_compare_names_of_files_and_not_folders(tmp_path: Path) -> None:
    one, other = (settings(write(tmp_path / where, TEXT + SETTINGS)) for where in ("a", "b/c"))
    assert one != other
    tables = [file_names(msgspec.to_builtins(config), ReadingConfig) for config in (one, other)]
    assert tables[0] == tables[1]
    assert tables[0]["files"] == ["d.txt", "f.txt"]


def test_what_is_written_is_what_the_settings_name(tmp_path: Path) -> None:
    assert list(written(settings(write(tmp_path, TEXT + SETTINGS)))) == ["plot.png"]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner)
        | st.dictionaries(st.sampled_from(ReadingConfig.__struct_fields__) | st.text(), inner)
    ),
)


@pytest.mark.slow
@given(JSON)
def test_whatever_stands_there_is_for_the_check_of_types_to_refuse(table: Any) -> None:
    """Resolving changes texts only, and what is absolute stays as it is."""
    once = resolve(table, ReadingConfig, Path("/folder"))
    assert repr(resolve(once, ReadingConfig, Path("/elsewhere"))) == repr(once)


@given(st.lists(st.text() | st.text("a/b_.~+%tTé\n"), unique=True))
def test_each_source_has_files_of_its_own_and_is_known_by_them(sources: list[str]) -> None:
    names = [source_file(source) for source in [*sources, "truth", "plan"]]
    assert [source_of(name) for name in names] == [*sources, "truth", "plan"]
    assert len(set(names)) == len({*sources, "truth", "plan"})
    assert not {"truth", "plan"} & {*names}
    assert all(re.fullmatch(r"[\w+~-]*", name, re.ASCII) for name in names)


def test_usual_names_stay_as_they_are() -> None:
    assert [source_file(name) for name in ("orb-slam_3", "drone/slam", "a_b", "v1.2")] == [
        *("orb-slam_3", "drone+slam", "a_b", "v1~2E2")
    ]
