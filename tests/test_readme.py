"""The README is true: its commands run, its files exist, its node is the one in `examples/`."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    python -m runtime (.*?)(?: +#.*)?$", README, re.MULTILINE)
TARGETS = sorted(set(re.findall(r"(?:^    |`)make ([a-z -]+?)(?:`|  +#|$)", README, re.MULTILINE)))

SHORTER = {
    "run": ["--set", "run.duration=1s", "--set", "evaluation.report=false", "--quiet"],
    "sweep": ["--set", "run.duration=1s", "--set", "evaluation.report=false"],
    "bench": ["--help"],
}
"""What is added to a command so that it takes a second."""

MISSED = 1
"""The exit code of a run that missed a threshold, as one must that has not left the ground."""


def test_there_are_commands_to_check() -> None:
    """The patterns above find what a reader sees."""
    assert len(COMMANDS) >= 8
    assert {"demo", "test"} <= set(TARGETS)


@pytest.fixture(scope="session")
def a_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short run."""
    out = tmp_path_factory.mktemp("run") / "tour"
    changes = ["--set", "run.duration=3s", "--set", "evaluation.report=false"]
    command = [sys.executable, "-m", "runtime", "run", "config.toml", *changes, "--out", str(out)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    return out


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(c, marks=[pytest.mark.slow, pytest.mark.timeout(300)])
        if c.startswith("sweep")
        else c
        for c in COMMANDS
    ],
)
def test_each_command_runs(command: str, tmp_path: Path, a_run: Path) -> None:
    """As written, but for what makes it short and for where it writes."""
    words = shlex.split(command)
    words = [str(tmp_path / word) if word.endswith(".png") else word for word in words]
    words = [str(a_run) if word == "runs/tour" else word for word in words]
    words += SHORTER.get(words[0], [])
    if words[0] in {"run", "sweep", "export"}:
        words += ["--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-m", "runtime", *words], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode in {0, MISSED}, done.stderr


@pytest.mark.parametrize("targets", TARGETS)
def test_each_make_target_exists(targets: str) -> None:
    """The Makefile has what the README tells to make."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in targets.split():
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_each_example_and_picture_exists() -> None:
    """Files that the README names are there."""
    listed = re.findall(r"^\| `(\w+\.toml)` \|", README, re.MULTILINE)
    examples = {name for name in listed if name != "config.toml"}
    assert examples == {path.name for path in (ROOT / "examples").glob("*.toml")}
    for link in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / link).is_file(), link


def test_the_node_is_the_one_of_the_examples() -> None:
    """But for docstrings, which the README says it leaves out."""

    def without_docstrings(text: str) -> str:
        (node,) = [n for n in ast.parse(text).body if isinstance(n, ast.ClassDef)]
        for inner in ast.walk(node):
            if isinstance(inner, ast.ClassDef | ast.AsyncFunctionDef) and ast.get_docstring(inner):
                inner.body = inner.body[1:]
        return ast.dump(node)

    shown = README.split("```python\n")[1].split("```")[0]
    example = (ROOT / "examples" / "brightness.py").read_text(encoding="utf-8")
    assert without_docstrings(shown) == without_docstrings(example)
