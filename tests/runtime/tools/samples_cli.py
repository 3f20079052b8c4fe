"""Starting the command line in a process of its own, as a user would, or in this one, quickly."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from runtime.tools.cli import main

ROOT = Path(__file__).parents[3]


def config_file(folder: Path, *nodes: str, run: str = "", settings: str = "") -> Path:
    """Write a file with nodes of `tests.runtime.samples`, named like their classes."""
    lines = [f"[run]\nname = 'sample'\n{run}"]
    lines += [f"[[nodes]]\nname = '{n.lower()}'\ntype = 'tests.runtime.samples:{n}'" for n in nodes]
    path = folder / "sample.toml"
    path.write_text("\n".join([*lines, settings]) + "\n", encoding="utf-8")
    return path


def start(arguments: Sequence[str | Path], folder: Path) -> subprocess.Popen[str]:
    """Start `python -m runtime` in a folder."""
    return subprocess.Popen(
        [sys.executable, "-m", "runtime", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def command(
    *arguments: str | Path, folder: Path, limit: float = 100
) -> subprocess.CompletedProcess[str]:
    """Run `python -m runtime` to its end."""
    with start(arguments, folder) as process:
        try:
            out, err = process.communicate(timeout=limit)
        finally:
            process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def command_here(*arguments: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Do what `command` does in this process: where that a process ends, or how, is no matter."""
    words = ["runtime", *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", words),
        mock.patch.object(sys, "path", [*sys.path]),
        mock.patch.object(os, "_exit", sys.exit),
        mock.patch.dict(os.environ, {"COLUMNS": "200", "NO_COLOR": "1"}),
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def results(folder: Path) -> Path:
    """Return the folder of the newest run in ``runs``, also of a start that failed."""
    return max((folder / "runs").glob("*/[0-9]*"))


def summary(folder: Path) -> Any:
    """Read the summary of a run whose results are in `folder`."""
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))
