"""`systems`: other people's systems judged by the native interface, where they are installed.

What is tested without them: that the files belong together, and that a missing program is said.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from nodes.outside.process.launch import ProcessConfig
from runtime.config.reading import load
from tests.examples.test_examples import ROOT, run
from tests.nodes.outside.process.killing import SIGNALS, kill
from tests.runs.test_check import check

FOLDER = ROOT / "examples" / "systems"
SYSTEMS = ("openvins", "basalt", "dso", "ekf2")


def process(name: str) -> ProcessConfig:
    """Return the settings of a system's program."""
    (node,) = (spec for spec in load(FOLDER / f"{name}.toml").nodes if spec.name == name)
    assert isinstance(node.config, ProcessConfig)
    return node.config


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_has_a_file_a_program_and_a_target(name: str) -> None:
    assert process(name).command[0] == f"build/systems/{name}"
    assert "visnav::Link link(" in (FOLDER / f"{name}.cpp").read_text()
    assert f"add_system({name} " in (FOLDER / "CMakeLists.txt").read_text()


def test_a_program_that_was_not_built_is_said_in_a_line(tmp_path: Path) -> None:
    text = (FOLDER / "openvins.toml").read_text()
    path = tmp_path / "openvins.toml"
    path.write_text(text.replace('folder = "../.."', 'folder = "."'))
    code, (line,) = check(path)
    assert code == 2
    assert line.startswith("error: openvins.toml: openvins: command: expected a program")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Build what is installed (CMAKE_PREFIX_PATH); return its folder, and a line of each system."""
    if shutil.which("cmake") is None:
        pytest.skip("there is no cmake")
    folder = tmp_path_factory.mktemp("systems")
    configure = ["cmake", "-S", str(FOLDER), "-B", str(folder)]
    done = subprocess.run(configure, capture_output=True, text=True, check=True)
    lines = (line.removeprefix("-- ").partition(": ") for line in done.stdout.splitlines())
    reports = {name: text for name, _, text in lines if name in SYSTEMS}
    subprocess.run(["cmake", "--build", str(folder)], check=True)
    return folder, reports


def command(name: str, built: tuple[Path, dict[str, str]]) -> str:
    """Return the setting of a system's program; skip the test if that was left out."""
    folder, reports = built
    if reports[name].startswith("left out"):
        assert not (folder / name).exists()
        pytest.skip(reports[name])
    return f"{name}.command={json.dumps([str(folder / name), *process(name).command[1:]])}"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SYSTEMS)
def test_it_passes_its_thresholds(
    name: str, built: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    changes = (command(name, built), "run.startup_limit=300s", "report.figures=[]")
    summary = run(f"systems/{name}", tmp_path, *changes)
    assert summary["outside"][name]["reproducible"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: number.name)
@pytest.mark.parametrize("name", SYSTEMS)
def test_killed_at_a_random_frame_it_is_one_error(
    name: str, number: signal.Signals, built: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    text = (FOLDER / f"{name}.toml").read_text()
    kill(text, f"/{name}", name, number, tmp_path / "killed", command(name, built))
