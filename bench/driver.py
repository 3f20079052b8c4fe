"""Runs measurements in processes of their own, shuffled and repeated, and sums them up.

Every (system, mode, N) is measured once a round; each round has an order of its own, so that a
busy minute of the machine falls on all systems alike. Samples of all rounds are pooled; the
medians of the rounds are kept, because their spread is the noise that a comparison must exceed.

``python -m bench.driver MODULE NAME CASE.json OUT.npy`` is one measurement.
"""

from __future__ import annotations

import gc
import importlib
import pkgutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
import numpy as np

import bench.systems
from bench.benchmarks import Progress, Row
from bench.harness import in_turns, silent
from bench.system import Case, CaseName, Mode, Samples, System

_LIMIT = 120.0  # time limit of a measurement, seconds


class Outcome(msgspec.Struct, frozen=True):
    """Result of a whole benchmark.

    Attributes:
        missing: System to the reason for its absence.
        versions: System to its version.
    """

    rows: list[Row]
    missing: dict[str, str]
    versions: dict[str, str]


def systems() -> dict[str, tuple[System, ...]]:
    """Return all systems by module, ours first."""
    modules = ["bench.ours"]
    modules += [
        f"bench.systems.{module.name}" for module in pkgutil.iter_modules(bench.systems.__path__)
    ]
    measured = {name: getattr(importlib.import_module(name), "SYSTEMS", ()) for name in modules}
    return {name: entries for name, entries in measured.items() if entries}


def measure_all(
    case: CaseName,
    *,
    nodes: Sequence[int],
    samples: int,
    warm_up: int,
    repeats: int,
    only: Iterable[str] = (),
    budget: float = 1.0,
    progress: Progress = silent,
) -> Outcome:
    """Measure a case with all installed systems.

    Args:
        samples: Round trips of each measurement, fewer for slow systems: see `budget`.
        warm_up: Round trips left out before them.
        only: Parts of names; systems whose name has none of them are left out. Empty: all.
        budget: About how many seconds of round trips one measurement may take.
    """
    wanted = tuple(part.lower() for part in only)
    missing: dict[str, str] = {}
    versions: dict[str, str] = {}
    jobs: list[tuple[str, System, Mode, int]] = []
    known = systems()
    for module, entries in known.items():
        for system in entries:
            if wanted and not any(part in system.name.lower() for part in wanted):
                continue
            if case not in system.cases:
                continue
            if reason := system.missing():
                missing[system.name] = reason
                continue
            versions[system.name] = system.version()
            jobs += [
                (module, system, mode, n)
                for mode in system.modes
                for n in nodes
                if n <= system.max_nodes
            ]
    taken: dict[tuple[str, Mode, int], list[Samples]] = {}
    for number, (_, (module, system, mode, n)) in enumerate(in_turns(jobs, repeats)):
        progress(f"{system.name}, {mode}, {n} nodes", number / (len(jobs) * repeats))
        count = _affordable(samples, system, case, n, budget)
        asked = Case(
            case=case, mode=mode, nodes=n, samples=count, warm_up=min(warm_up, count // 5 + 1)
        )
        try:
            samples_of_it = _measure(module, system.name, asked)
            taken.setdefault((system.name, mode, n), []).append(samples_of_it)
        except (subprocess.SubprocessError, OSError) as error:
            missing[f"{system.name}, {mode}, {n} nodes"] = _reason(error)
    places = {s.name: s.place for entries in known.values() for s in entries}
    rows = [_row(case, *key, places[key[0]], runs) for key, runs in taken.items()]
    rows.sort(key=lambda r: (r["mode"], r["nodes"], r["median_us"]))
    return Outcome(rows, missing, versions)


def _affordable(samples: int, system: System, case: str, nodes: int, budget: float) -> int:
    round_trip = system.slowness * 1e-6 * max(nodes / 2, 1.0)
    if case == "large":
        round_trip += 2e-3
    return max(min(samples, int(budget / round_trip)), 30)


def _measure(module: str, name: str, case: Case) -> Samples:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "samples.npy"
        encoded = msgspec.json.encode(case).decode()
        subprocess.run(
            [sys.executable, "-m", "bench.driver", module, name, encoded, str(out)],
            check=True,
            capture_output=True,
            timeout=_LIMIT,
        )
        samples: Samples = np.load(out)
    return samples


def _reason(error: Exception) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        lines = error.stderr.decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {error.returncode}"
    return f"no result within {_LIMIT:g} s"


def _row(case: str, system: str, mode: str, nodes: int, place: str, runs: Sequence[Samples]) -> Row:
    """Return the figures of all rounds' pooled samples; ``rounds_us`` are each round's medians."""
    pooled = np.concatenate(runs) / 1e3
    q1, median, q3, p99 = np.percentile(pooled, [25, 50, 75, 99]).tolist()
    figures = {"median_us": median, "mean_us": pooled.mean(), "q1_us": q1, "q3_us": q3}
    figures |= {"p99_us": p99, "max_us": pooled.max()}
    which = {"case": case, "system": system, "mode": mode, "nodes": nodes, "place": place}
    rounds = [float(np.median(run)) / 1e3 for run in runs]
    numbers = {key: float(value) for key, value in figures.items()}
    return {**which, "samples": len(pooled), **numbers, "rounds_us": rounds}


def find(module: str, name: str) -> System:
    """Return a system by its module and name."""
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
