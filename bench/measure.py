"""Measures one case of one system in this process: what the driver starts, over and over.

``python -m bench.measure MODULE NAME CASE.json OUT.npy``
"""

from __future__ import annotations

import gc
import importlib
import sys
from pathlib import Path

import msgspec
import numpy as np

from bench.system import Case, System


def find(module: str, name: str) -> System:
    """Return a system by the module that has it and its name.

    Raises:
        LookupError: The module has no such system.
    """
    systems: tuple[System, ...] = importlib.import_module(module).SYSTEMS
    for system in systems:
        if system.name == name:
            return system
    raise LookupError(f"{module}: expected one of {[s.name for s in systems]}, found {name!r}")


def main(module: str, name: str, case: str, out: str) -> None:
    """Measure, and write the samples."""
    system = find(module, name)
    gc.collect()
    gc.freeze()
    samples = system.measure(msgspec.json.decode(case, type=Case))
    np.save(Path(out), samples)


if __name__ == "__main__":
    main(*sys.argv[1:])
