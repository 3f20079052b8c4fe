"""The stub of a library with the VIT interface, compiled once."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest


@cache
def stub() -> Path:
    """Return the compiled library; skip the test where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("expected a C compiler, found none")
    library = Path(tempfile.mkdtemp(prefix="vit_stub_")) / "libstub.so"
    source = str(Path(__file__).with_name("stub.c"))
    command = [compiler, "-O1", "-shared", "-fPIC", "-o", str(library), source, "-lm"]
    subprocess.run(command, check=True)
    return library


@cache
def stub_settings(words: str) -> dict[str, str]:
    """Return settings for the stub, which does what the words say."""
    config = Path(tempfile.mkdtemp(prefix="vit_stub_")) / "stub.conf"
    config.write_text(words)
    return {"library": str(stub()), "config": str(config)}
