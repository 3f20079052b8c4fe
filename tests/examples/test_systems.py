"""`systems`: other people's systems judged by the native interface, where they are installed.

What is tested without them: that the files belong together, and that a missing program is said.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from nodes.outside.process.launch import ProcessConfig
from runtime.config.reading import load
from tests.examples.test_examples import ROOT, run
from tests.runs.test_check import check

FOLDER = ROOT / "examples" / "systems"
PROGRAMS = ROOT / "build" / "systems"
SYSTEMS = ("openvins", "basalt", "ekf2")


@pytest.mark.parametrize("name", SYSTEMS)
def test_each_has_a_file_a_program_and_a_target(name: str) -> None:
    (node,) = (each for each in load(FOLDER / f"{name}.toml").nodes if each.name == name)
    assert isinstance(node.config, ProcessConfig)
    assert node.config.command[0] == f"build/systems/{name}"
    assert "visnav::Link link(" in (FOLDER / f"{name}.cpp").read_text()
    assert f"add_system({name} " in (FOLDER / "CMakeLists.txt").read_text()


def test_a_program_that_was_not_built_is_said_in_a_line(tmp_path: Path) -> None:
    text = (FOLDER / "openvins.toml").read_text()
    path = tmp_path / "openvins.toml"
    path.write_text(text.replace('folder = "../.."', 'folder = "."'))
    code, (line,) = check(path)
    assert code == 2
    assert line.startswith("error: openvins.toml: openvins: command: expected a program")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SYSTEMS)
def test_it_passes_its_thresholds(name: str, tmp_path: Path) -> None:
    if not (PROGRAMS / name).exists():
        pytest.skip(f"{name} is not built: docs/how-to/systems.md says what it needs")
    summary = run(f"systems/{name}", tmp_path, "run.startup_limit=300s", "report.figures=[]")
    assert summary["outside"][name]["reproducible"]
