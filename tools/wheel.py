"""What a wheel holds besides the packages: `config.toml` and the examples, for `visnav demo`."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools.command.build_py import build_py

ROOT = Path(__file__).parents[1]
INSIDE = "runtime/tools/example_files"
"""Where the commands `demo` and `example` look for them once they are installed."""


class BuildWithExamples(build_py):
    """Copies the examples into the package; a checkout is used as it is."""

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
