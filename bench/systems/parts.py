"""What the modules of systems share: which packages are here, and what pings carry."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable
from typing import Any

from bench.system import Case, large_array


def needs(**packages: str) -> Callable[[], str | None]:
    """Return a `System.missing` that asks for some packages.

    Args:
        packages: Name of each module that must be there, and of the package that has it.
    """

    def missing() -> str | None:
        absent = [package for name, package in packages.items() if not _is_here(name)]
        if not absent:
            return None
        return f"not installed; `make peers`, or `pip install {' '.join(absent)}`"

    return missing


def versions(*packages: str) -> Callable[[], str]:
    """Return a `System.version` that names some packages."""

    def version() -> str:
        return ", ".join(f"{package} {importlib.metadata.version(package)}" for package in packages)

    return version


def payloads(case: Case) -> Callable[[], Any]:
    """Return what makes the payload of each ping: nothing, a fresh copy, or the same array."""
    if case.case == "small":
        return lambda: None
    array = large_array()
    return array.copy if case.case == "large" else lambda: array


def _is_here(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False
