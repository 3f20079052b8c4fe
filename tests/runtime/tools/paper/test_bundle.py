"""A run as an archive: what is in it, that it repeats, and that no archive writes elsewhere."""

from __future__ import annotations

import json
import re
import shutil
import stat
import sys
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest

from events import Announcement, EstimatorAnnouncement, PoseEstimate
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.config.reading import load
from runtime.errors import ResultsError
from runtime.node import CommandLine
from runtime.paths import InputPath
from runtime.summary import Summary
from runtime.tools.paper.bundle import Manifest, inputs_of, sha256, write_bundle
from runtime.tools.paper.repeat import Bundle, compare_runs, configuration, read_bundle
from tests.runtime.tools.samples_cli import command_here


class GuessConfig(NodeConfig):
    """A file of data, and a rate whose default is an int."""

    data: InputPath = ""
    rate: float = 20


class Announced(Announcement):
    """Says the rate as it stands in the settings."""

    rate: float


class Guess(Node[GuessConfig]):
    """Estimates poses at random, as long as its file is large."""

    estimates = Output(PoseEstimate)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method="guess")
        yield Announced(stamp=0, source=self.name, rate=self.config.rate)

    @every(hz=20)
    def guess(self, tick: Tick) -> None:
        x = self.rng.random() + len(Path(self.config.data).read_bytes())
        self.estimates.send(
            PoseEstimate(
                stamp=tick.stamp, source=self.name, frame_id="map", position=(x, 0.0, 0.0),
                orientation=(1.0, 0.0, 0.0, 0.0),
            )
        )  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Leave out the parts of a run, which are hashes of all code that there is."""
    with mock.patch("runtime.tools.paper.bundle.made_from", return_value={"numpy": "1"}):
        yield


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``data.bin`` and a run of it in ``run``."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "data.bin").write_bytes(b"12345")
    (folder / "a.toml").write_text(
        "[run]\nname = 'guessed'\nseed = 7\nduration = 0.5\n[[nodes]]\nname = 'vo'\n"
        f"type = '{__name__}:Guess'\ndata = 'data.bin'\n"
    )
    done = command_here("run", "a.toml", "-q", "--out", "run", folder=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def copied(flown: Path, tmp_path: Path) -> Path:
    shutil.copytree(flown, tmp_path / "copied")
    return tmp_path / "copied"


def bundled(folder: Path, **options: Any) -> tuple[Path, Manifest]:
    out = folder / "a.zip"
    return out, write_bundle(folder / "run", out, **options)


def test_a_bundle_has_settings_digests_versions_and_hashes(flown: Path) -> None:
    out, manifest = bundled(flown)
    summary = json.loads((flown / "run" / "summary.json").read_text())
    with zipfile.ZipFile(out) as archive:
        names = archive.namelist()
        assert msgspec.json.decode(archive.read("bundle.json"), type=Manifest) == manifest
        readme = archive.read("README.txt").decode()
    assert {"config.toml", "summary.json", "README.txt", "bundle.json"} <= {*names}
    assert {*names} == {*manifest.files, "bundle.json"}
    assert not any(name.startswith(("inputs/", "code/")) for name in names)
    assert (manifest.seed, manifest.digest) == (7, summary["digest"])
    assert manifest.environment["numpy"] == summary["environment"]["numpy"]
    assert manifest.estimators["vo"].code == summary["code"]["vo"]
    (data,) = manifest.inputs
    assert (data.setting, data.size, data.archived) == ("vo.data", 5, "")
    assert data.sha256 == sha256(b"12345")
    assert [file.path for file in manifest.left_out] == ["log.txt"]
    assert manifest.repeat == "python -m runtime run --from a.zip"
    for text in (manifest.repeat, summary["digest"], data.sha256, "seed 7"):
        assert text in readme


def test_what_is_not_in_it_and_what_has_changed_is_said(copied: Path) -> None:
    (copied / "data.bin").write_bytes(b"123456")
    _, manifest = bundled(copied)
    text = "\n".join(manifest.notes)
    # The run's settings name the file of the folder from which this one was copied.
    assert "inputs are not in it, only their hashes: data.bin (5 bytes)" in text
    assert "files of the run are not in it, only their hashes: log.txt" in text
    assert "it has no plots" in text
    path = copied / "run" / "config.toml"
    path.write_text(re.sub('"[^"]*data.bin"', f'"{copied / "data.bin"}"', path.read_text()))
    summary = json.loads((copied / "run" / "summary.json").read_text())
    summary["code"]["vo"] = "another"
    summary["environment"]["commit"] = "1234-dirty"
    (copied / "run" / "summary.json").write_text(json.dumps(summary))
    _, manifest = bundled(copied)
    text = "\n".join(manifest.notes)
    assert f"vo.data: {copied / 'data.bin'} was changed after the run" in text
    assert "the code of vo is not what it was in the run" in text
    assert "now, the run was of 1234-dirty" in text
    (copied / "data.bin").unlink()
    assert "is not there any more" in "\n".join(bundled(copied)[1].notes)


def test_equal_folders_give_equal_archives(flown: Path) -> None:
    out, _ = bundled(flown, with_inputs=True)
    first = out.read_bytes()
    (flown / "run" / "config.toml").touch()
    assert bundled(flown, with_inputs=True)[0].read_bytes() == first
    with zipfile.ZipFile(out) as archive:
        assert archive.namelist() == sorted(archive.namelist())
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_a_repeated_run_agrees_to_the_digest(flown: Path) -> None:
    bundled(flown)
    done = command_here("run", "--from", "a.zip", "--out", "again", folder=flown)
    assert done.returncode == 0, done.stderr
    digest = json.loads((flown / "run" / "summary.json").read_text())["digest"]
    assert f"outputs agree: digest {digest}" in done.stdout
    done = command_here("run", "--from", "a.zip", "--out", "o", "--set", "run.seed=8", folder=flown)
    assert done.returncode == 1
    assert "outputs differ of the estimator vo (vo.estimates)" in done.stdout


def test_inputs_in_a_bundle_are_used_where_there_are_no_others(copied: Path) -> None:
    out, manifest = bundled(copied, with_inputs=True)
    (data,) = manifest.inputs
    with zipfile.ZipFile(out) as archive:
        assert archive.read(data.archived) == b"12345"
        code = f"code/{__name__.replace('.', '/')}.py"
        assert archive.read(code) == Path(__file__).read_bytes()
    assert not any("inputs are not in it" in note for note in manifest.notes)
    bundle = read_bundle(out)
    config, notes = configuration(bundle)
    ((_, (path,)),) = inputs_of(config)
    assert path == copied / "a" / data.archived
    assert (path.read_bytes(), notes) == (b"12345", [])
    path.write_bytes(b"edited")  # and is put right again
    read_bundle(out)
    assert path.read_bytes() == b"12345"


def test_an_input_that_is_missing_or_another_one_is_named(copied: Path) -> None:
    text = (copied / "run" / "config.toml").read_text()
    text = re.sub('"[^"]*data.bin"', f'"{copied / "data.bin"}"', text)
    (copied / "run" / "config.toml").write_text(text)
    bundle = read_bundle(bundled(copied)[0])
    other = copied / "other.bin"
    (copied / "data.bin").rename(other)
    message = (
        r"vo\.data: expected .*data\.bin \(5 bytes, sha256 .*found none: .* --set vo\.data=PATH"
    )
    with pytest.raises(ResultsError, match=message):
        configuration(bundle)
    assert configuration(bundle, [f"vo.data={other}"])[1] == []
    other.write_bytes(b"1")
    (note,) = configuration(bundle, [f"vo.data={other}"])[1]
    assert "is not that of the bundle: expected 5 bytes" in note


def test_whole_numbers_of_the_settings_stay_what_they_were(flown: Path) -> None:
    config, _ = configuration(read_bundle(bundled(flown)[0]))
    assert type(config.nodes[0].config.rate) is int  # type: ignore[attr-defined]
    assert config == load(flown / "a.toml")


def test_programs_are_known_by_their_hash_and_models_have_their_meshes(copied: Path) -> None:
    model = copied / "models" / "world.xml"
    mesh = copied / "models" / "meshes" / "rock.obj"
    mesh.parent.mkdir(parents=True)
    mesh.write_text("v 0 0 0")
    model.write_text('<mujoco><compiler meshdir="meshes"/><mesh file="rock.obj"/></mujoco>')
    path = copied / "run" / "config.toml"
    path.write_text(re.sub('"[^"]*data.bin"', f'"{model}"', path.read_text()))
    program = CommandLine(words=("$VISNAV_PYTHON", "slam.py"), folder=str(copied))
    lost = CommandLine(words=("./no_such_program",), folder=str(copied))
    sources = [program, lost, copied / "data.bin"]
    with mock.patch.object(Guess, "made_from", return_value=sources):
        out, manifest = bundled(copied, with_inputs=True)
        names = [(file.setting, file.archived) for file in manifest.inputs]
        assert names == [
            ("vo.data", "inputs/0-models/world.xml"),
            ("vo.data", "inputs/0-models/meshes/rock.obj"),
            ("vo", f"inputs/1-{copied.name}/data.bin"),
        ]
        config, notes = configuration(read_bundle(out))
        ((_, files), _) = inputs_of(config)
    assert (len(files), notes) == (2, [])
    assert all(file.is_relative_to(copied / "a") and file.is_file() for file in files)
    python, missing = manifest.programs
    assert python.sha256 == sha256(Path(sys.executable))
    assert (missing.sha256, missing.path) == ("", "")
    assert "the program of vo is not in it, only its hash: $VISNAV_PYTHON" in manifest.notes
    assert "the program of vo is not in it, it was not found: ./no_such_program" in manifest.notes


def bundle_of(summary: Summary, **manifest: Any) -> Bundle:
    base: dict[str, Any] = {
        "format": 1, "name": "", "seed": 0, "digest": "", "inputs_digest": "", "repeat": "",
        "command": "", "commit": "", "environment": {}, "estimators": {}, "inputs": (),
        "programs": (), "made_from": {}, "files": {}, "left_out": (), "notes": (),
    }  # fmt: skip
    return Bundle(Path("a.zip"), Manifest(**base | manifest), summary, {}, None)


def test_who_differs_is_named_with_figures_and_reasons(flown: Path) -> None:
    summary = msgspec.json.decode((flown / "run" / "summary.json").read_bytes(), type=Summary)
    verdict = {"passed": True, "estimators": {"vo": {"passed": True, "ate_percent": 1.0}}}
    environment = summary.environment | {"numpy": "1.0"}
    before = msgspec.structs.replace(
        summary, verdict=msgspec.convert(verdict, Any), environment=environment,
        code={"vo": "old", "same": "x"}, inputs={"drone.imu": "1"},
        digests={"vo.estimates": "1", "same.estimates": "2", "pilot.setpoints": "3"},
        not_deterministic=["vo"],
    )  # fmt: skip
    before = msgspec.convert(msgspec.to_builtins(before), Summary)
    now = msgspec.structs.replace(
        before, code={"vo": "new", "same": "x"}, inputs={"drone.imu": "2"},
        digests={"vo.estimates": "9", "same.estimates": "2", "pilot.setpoints": "8"},
    )  # fmt: skip
    now.verdict.estimators["vo"] = {"passed": True, "ate_percent": 2.0}  # type: ignore[union-attr]
    before = msgspec.structs.replace(before, verdict=msgspec.convert(verdict, type(now.verdict)))
    agreement = compare_runs(bundle_of(before), now)
    assert not agreement.agrees
    assert [*agreement.lines][:3] == [
        "inputs differ: drone.imu",
        "outputs differ of the node pilot (pilot.setpoints)",
        "outputs differ of the estimator vo (vo.estimates): ate_percent 1 in the bundle, 2 here",
    ]
    reasons = agreement.lines[3:]
    assert "the bundle does not promise that it repeats, because of vo" in reasons
    assert "the code of vo is not that of the bundle" in reasons
    assert f"numpy is {summary.environment['numpy']} here, 1.0 in the bundle" in reasons
    assert compare_runs(bundle_of(before), before).agrees
    off = msgspec.structs.replace(before, digest=None)
    assert compare_runs(bundle_of(off), now).lines == ("not compared: the bundle has no digest",)


def rewritten(path: Path, name: str, content: bytes = b"x", **info: Any) -> Path:
    """Return a copy of an archive with one more member."""
    out = path.with_name("evil.zip")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        for member in old.infolist():
            if member.filename != name:
                new.writestr(member, old.read(member))
        added = zipfile.ZipInfo(name)
        for key, value in info.items():
            setattr(added, key, value)
        new.writestr(added, content)
    return out


@pytest.mark.parametrize(
    "name",
    ["../out", "/tmp/out", "inputs/../../out", "inputs/./out", "inputs\\..\\out", "inputs/folder/"],
)
def test_an_archive_that_leads_elsewhere_is_refused(name: str, copied: Path) -> None:
    path = rewritten(bundled(copied)[0], name)
    before = {*copied.parent.rglob("*")}
    with pytest.raises(ResultsError, match="expected files with names inside a folder, found "):
        read_bundle(path)
    assert {*copied.parent.rglob("*")} == before


def test_links_in_and_around_an_archive_are_refused(copied: Path) -> None:
    out, _ = bundled(copied, with_inputs=True)
    link = rewritten(out, "inputs/link", b"/etc", external_attr=(stat.S_IFLNK | 0o777) << 16)
    with pytest.raises(ResultsError, match="expected files with names inside"):
        read_bundle(link)
    (copied / "elsewhere").mkdir()
    (copied / "a").mkdir()
    (copied / "a" / "inputs").symlink_to(copied / "elsewhere")
    with pytest.raises(ResultsError, match="found a link that leads out"):
        read_bundle(out)
    assert [*(copied / "elsewhere").rglob("*.bin")] == []


def test_a_damaged_bundle_is_named(copied: Path) -> None:
    out, manifest = bundled(copied, with_inputs=True)
    (data,) = manifest.inputs
    with pytest.raises(ResultsError, match=r"data\.bin: expected the hash in bundle\.json"):
        read_bundle(rewritten(out, data.archived, b"54321"))
    with pytest.raises(ResultsError, match=r"config\.toml: expected the hash"):
        read_bundle(rewritten(out, "config.toml", b"[run]"))
    text = msgspec.json.encode(msgspec.structs.replace(manifest, format=2))
    with pytest.raises(ResultsError, match=r"bundle\.json: expected format 1, found 2"):
        read_bundle(rewritten(out, "bundle.json", text))
    with zipfile.ZipFile(copied / "no.zip", "w") as archive:
        archive.writestr("config.toml", "")
    with pytest.raises(ResultsError, match=r"expected bundle\.json in a bundle, found none"):
        read_bundle(copied / "no.zip")
    with pytest.raises(ResultsError, match="expected a bundle, a ZIP archive, found"):
        read_bundle(copied / "data.bin")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["bundle", "run", "--out", "a.tar"], "--out a.tar: expected a file .zip, found '.tar'"),
        (
            ["bundle", "run", "--out", "no/a.zip"],
            "--out no/a.zip: expected a folder no",
        ),
        (["bundle", "."], "expected the folder of a run"),
        (["run", "--from", "no.zip"], "no.zip: expected a bundle, found: No such file"),
        (["run", "a.toml", "--from", "a.zip"], "found a file and --from"),
        (["run", "--from", "a.zip", "--only", "vo"], "found --from and --only"),
    ],
)
def test_what_is_wrong_is_said(words: list[str], message: str, flown: Path) -> None:
    done = command_here(*words, folder=flown)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr
