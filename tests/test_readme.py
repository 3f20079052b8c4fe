"""The README is true: commands, file and class run, files exist, the table is the suite's."""

from __future__ import annotations

import platform
import re
import shlex
from pathlib import Path
from subprocess import CompletedProcess

import mujoco
import numpy as np
import pytest

from runtime.tools.cli.inspect import example_files
from tests.runtime.tools.samples_cli import command, command_here, summary

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SUITE = (ROOT / "bench" / "SUITE.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    python -m runtime (.*?)(?: +#.*)?$", README, re.MULTILINE)
FLIGHTS = [command for command in COMMANDS if command.startswith("run ")]
TARGETS = sorted(set(re.findall(r"(?:^    |`)make ([a-z -]+?)(?:`|  +#|$)", README, re.MULTILINE)))

SHORTER = {
    "run": [
        *("--set", "run.duration=2s", "--set", "report.figures=[]", "--quiet"),
        *("--set", "camera.width=128", "--set", "camera.height=128"),
        *("--set", "drone.camera_processes=1"),
    ],
    "sweep": ["--set", "run.duration=1s", "--set", "report.figures=[]"],
    "compare": ["--set", "run.duration=1s", "--set", "report.figures=[]", "--seeds", "1"],
    "selftest": ["--standing", "10s"],
    "bench": ["--help"],
}
"""What is added to a command so that it takes a second."""

A_RUN = "runs/tour"
"""The folder of the README's flight."""

MISSED = 1
"""The exit code of a run that missed a threshold, as one must that has not left the ground."""


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_the_demo_has_the_inputs_of_the_readme(tmp_path: Path) -> None:
    """A change of what is drawn or measured changes it: then it is written anew."""
    here = f"MuJoCo {mujoco.__version__} and NumPy {np.__version__}"
    if platform.machine() != "x86_64" or here not in README:
        pytest.skip("the README's digest is that of another architecture or other versions")
    options = ["--set", "report.figures=[]", "--quiet", "--out", str(tmp_path)]
    assert command("run", "config.toml", *options, folder=ROOT, limit=200).returncode == 0
    digest = summary(tmp_path)["inputs_digest"]
    assert re.findall(r"`([0-9a-f]{32})`", README) == [digest]


def test_there_are_commands_to_check() -> None:
    """The patterns above find what a reader sees."""
    assert len(COMMANDS) >= 7
    assert {"demo", "test"} <= set(TARGETS)


def done(words: str, tmp_path: Path, a_run: Path | None = None) -> CompletedProcess[str]:
    """Do what a reader would, but for what makes it short and for where it writes."""
    parts = shlex.split(words)
    parts = [str(tmp_path / part) if part.endswith(".png") else part for part in parts]
    parts = [str(a_run) if part == A_RUN else part for part in parts]
    parts += SHORTER.get(parts[0], [])
    if parts[0] in {"run", "sweep", "compare", "export", "selftest"}:
        parts += ["--out", str(tmp_path)]
    if parts[0] in {"run", "sweep", "compare", "selftest"}:
        return command(*parts, folder=ROOT, limit=500)
    return command_here(*parts, folder=ROOT)


@pytest.fixture(scope="module")
def a_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the run that the README starts."""
    out = tmp_path_factory.mktemp("run") / "tour"
    ended = done(FLIGHTS[0], out)
    assert ended.returncode in {0, MISSED}, ended.stderr
    return out


@pytest.mark.slow
def test_the_run_leaves_a_summary(a_run: Path) -> None:
    """The README's flight runs as written."""
    assert (a_run / "summary.json").is_file()


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(c, marks=[pytest.mark.slow, pytest.mark.timeout(600)])
        if c.startswith(("sweep", "compare", "selftest")) or c in FLIGHTS or A_RUN in c
        else c
        for c in COMMANDS
        if c != FLIGHTS[0]
    ],
)
def test_each_command_runs(words: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """As written, but for what makes it short and for where it writes."""
    ended = done(words, tmp_path, request.getfixturevalue("a_run") if A_RUN in words else None)
    assert ended.returncode in {0, MISSED}, ended.stderr


@pytest.mark.parametrize("targets", TARGETS)
def test_each_make_target_exists(targets: str) -> None:
    """The Makefile has what the README tells to make."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in targets.split():
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_it_is_short() -> None:
    """A stranger understands it in a minute; the rest is in the documentation."""
    assert len(README.splitlines()) <= 150


def test_each_example_and_linked_file_exists() -> None:
    """Files that the README names are there."""
    examples = set(re.findall(r"`(\w+\.toml)`", README.partition("## Examples")[2]))
    assert len(examples) > 10
    assert examples <= {path.name for path in example_files().values()}
    for link in re.findall(r"\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / link).is_file(), link


def shown(language: str) -> str:
    """Return the first block in this language."""
    return README.split(f"```{language}\n")[1].split("```")[0]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("mine", [False, True], ids=["its odometry", "its class"])
def test_the_file_flies_judges_and_ends(mine: bool, tmp_path: Path) -> None:
    """As it is, and with the class below it, whose tracker takes the camera to stand still."""
    file = shown("toml")
    if mine:
        stub = "class MySlam:\n    def __init__(self, matrix): pass\n"
        stub += "    def track(self, image, depth): return np.eye(4)\n"
        text = f"import numpy as np\n{shown('python')}\n{stub}"
        (tmp_path / "my_module.py").write_text(text, encoding="utf-8")
        file = file.replace('"VisualOdometry"', '"my_module:MyEstimator"')
    (tmp_path / "config.toml").write_text(file, encoding="utf-8")
    ended = command("run", "config.toml", "--out", "out", "--quiet", folder=tmp_path, limit=500)
    assert ended.returncode == (MISSED if mine else 0), ended.stderr
    assert summary(tmp_path / "out")["ended_by"] == "pilot"
    figures = summary(tmp_path / "out")["verdict"]["estimators"]["odometry"]
    assert figures["coverage_percent"] == 100.0
    assert figures["passed"] != mine


def test_the_table_is_the_suites() -> None:
    """Each estimator's errors, to two digits, who failed, and what exactness was worth."""
    rows = [row.strip("| ").split(" | ") for row in SUITE.splitlines() if row.startswith("| ")]
    rows = [[cell.strip() for cell in row] for row in rows if len(row) == 10][1:]
    assert len(rows) >= 12
    for name, reads, _, *cells, worth in rows:
        (line,) = (text for text in README.splitlines() if text.startswith(f"| {name} |"))
        here = line.strip("| ").split(" | ")
        assert here[1] == reads
        assert float(here[-1].split()[1]) == pytest.approx(float(worth.split()[1]), rel=0.05)
        for cell, short in zip(cells, here[2:-1], strict=True):
            assert ("failed" in cell) == ("**" in short), line
            if short == "**none**":  # nothing was said in any run
                assert cell.startswith("**failed**")
                continue
            assert float(short.strip("*")) == pytest.approx(float(cell.split()[0]), rel=0.05)
