"""Additions to the wheel: its commit, its name, and for `visnav demo` the examples."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).parents[1]
INSIDE = "runtime/tools/example_files"
"""Where the commands `demo` and `example` look for them once they are installed."""


def write_commit(tree: Path) -> None:
    """Write the commit into a tree of packages; ours need not be importable."""
    path = ROOT / "runtime" / "commit.py"
    spec = importlib.util.spec_from_file_location("commit", path)
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.write_commit(tree / "runtime")


class ArchiveWithCommit(sdist):
    """Source archive with a note of its commit, since there is no repository in it."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, then add the note."""
        super().make_release_tree(base_dir, files)
        write_commit(Path(base_dir))


class BuildWithExamples(build_py):
    """Build step with examples and commit written into the packages, except in a checkout."""

    def run(self) -> None:
        """Build the packages, then add the rest."""
        super().run()
        if self.editable_mode:
            return
        write_commit(Path(self.build_lib))
        target = Path(self.build_lib) / INSIDE
        target.mkdir(parents=True, exist_ok=True)
        examples = ROOT / "examples"
        for file in [ROOT / "config.toml", *sorted(examples.rglob("*.*"))]:
            copy = target / file.relative_to(examples if examples in file.parents else ROOT)
            if file.suffix != ".pyc":
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(file, copy)


class PlatformWheel(bdist_wheel):
    """Wheel for a platform and every Python: the compiled rasteriser is called by ctypes."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of Python, ABI and platform."""
        return "py3", "none", super().get_tag()[2]
