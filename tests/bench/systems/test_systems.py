"""Every peer can be imported without being there, and measures what it says where it is."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

import bench.systems
from bench.system import Case, System

ROOT = Path(__file__).parents[3]
MODULES = sorted(
    f"bench.systems.{module.name}" for module in pkgutil.iter_modules(bench.systems.__path__)
)
SYSTEMS: list[tuple[str, System]] = [
    (module, system)
    for module in MODULES
    for system in getattr(importlib.import_module(module), "SYSTEMS", ())
]
NAMES = [system.name for _, system in SYSTEMS]

# The names of the third-party modules that importing modules brings in, as a script.
IMPORTED = """
import importlib, sys
import bench.system, uvloop, subprocess, multiprocessing
known = {"bench", "events", *sys.stdlib_module_names, *sys.modules}
for module in sys.argv[1:]:
    importlib.import_module(module)
    if new := {name.partition(".")[0] for name in sys.modules} - known:
        print(module, *sorted(new))
"""


def test_names_are_unique() -> None:
    assert len(set(NAMES)) == len(NAMES)


@pytest.mark.slow
def test_importing_a_module_does_not_import_its_system() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, *MODULES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == ""


@pytest.mark.parametrize(("module", "system"), SYSTEMS, ids=NAMES)
def test_a_system_says_what_it_is_or_what_it_misses(module: str, system: System) -> None:
    missing = system.missing()
    assert missing is None or missing.strip()
    if missing is None:
        assert isinstance(system.version(), str)
    assert system.modes
    assert system.cases
    assert system.max_nodes >= 2
    assert system.slowness > 0


@pytest.mark.slow
@pytest.mark.timeout(150)
@pytest.mark.parametrize("nodes", [2, 3])
@pytest.mark.parametrize(("module", "system"), SYSTEMS, ids=NAMES)
def test_a_system_measures_small(module: str, system: System, nodes: int, tmp_path: Path) -> None:
    for mode in system.modes:
        _measure(module, system, Case(mode=mode, nodes=nodes, samples=30, warm_up=5), tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(150)
@pytest.mark.parametrize(("module", "system"), SYSTEMS, ids=NAMES)
def test_a_system_measures_large(module: str, system: System, tmp_path: Path) -> None:
    for name in system.cases:
        if name != "small":
            case = Case(case=name, mode=system.modes[0], samples=10, warm_up=2)
            _measure(module, system, case, tmp_path)


def _measure(module: str, system: System, case: Case, directory: Path) -> None:
    if (missing := system.missing()) is not None:
        pytest.skip(missing)
    if case.nodes > system.max_nodes:
        pytest.skip(f"{system.name} is not measured with {case.nodes} nodes")
    out = directory / "samples.npy"
    encoded = msgspec.json.encode(case).decode()
    subprocess.run(
        [sys.executable, "-m", "bench.driver", module, system.name, encoded, str(out)],
        cwd=ROOT,
        check=True,
        timeout=120,
    )
    samples = np.load(out)
    assert samples.shape == (case.samples,)
    assert samples.dtype == np.int64
    assert (samples > 0).all()
