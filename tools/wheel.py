"""Additions to the wheel: `config.toml` and the examples, for `visnav demo`, and its name."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parents[1]
INSIDE = "runtime/tools/example_files"
"""Where the commands `demo` and `example` look for them once they are installed."""


class BuildWithExamples(build_py):
    """Build step with the examples copied into the package, except in a checkout."""

    def run(self) -> None:
        """Build the packages, then add the examples."""
        super().run()
        if self.editable_mode:
            return
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
