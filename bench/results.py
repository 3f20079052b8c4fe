"""Results: all benchmarks in a single run, result files, and the changes between two of them."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from bench.benchmarks import BENCHMARKS, ROUND_TRIPS, Progress, Row
from bench.driver import measure_all
from bench.harness import silent
from bench.system import large_array
from runtime.commit import commit
from runtime.errors import ConfigError
from runtime.run.summarise import environment as versions

QUICK_SYSTEMS = ("visnav", "plain", "asyncio.queue", "pyee", "thesis")
"""Parts of the names of the systems in a quick run: systems quick to start."""


def measure_everything(*, quick: bool, progress: Progress = silent) -> dict[str, Any]:
    """Run all benchmarks, and return the content of ``results.json``.

    Args:
        quick: Measure less: under two minutes.
    """
    outcomes = [
        measure_all(
            case.name,
            nodes=case.quick_nodes if quick else case.nodes,
            samples=case.samples,
            warm_up=case.warm_up,
            repeats=2 if quick else case.repeats,
            only=QUICK_SYSTEMS if quick else (),
            budget=0.3 if quick else 0.5,
            progress=progress,
        )
        for case in ROUND_TRIPS
    ]
    measured: dict[str, Any] = {}
    for benchmark in BENCHMARKS:
        progress(benchmark.name.replace("_", " "))
        options = {option.name: option.in_all(quick=quick) for option in benchmark.options}
        rows = benchmark.run(options, progress)
        measured[benchmark.name] = rows[0] if benchmark.single else rows
    return {
        "environment": environment(),
        "quick": quick,
        "rows": [row for outcome in outcomes for row in outcome.rows],
        **measured,
        "missing": {k: v for outcome in outcomes for k, v in outcome.missing.items()},
        "versions": {k: v for outcome in outcomes for k, v in outcome.versions.items()},
    }


def environment() -> dict[str, str]:
    """Return machine, how quick that was at the end, versions and commit."""
    speed = f"{_copy() * 1e6:.0f} µs for a copy of 4.67 MB"
    revision = commit() or "unknown"
    return {**versions(), "cpu": _cpu(), "memory": speed, "commit": revision}


def write_json(path: Path, rows: list[Row], **more: Any) -> None:
    """Write ``environment``, ``rows`` and whatever else, indented."""
    content = {"environment": environment(), "rows": rows, **more}
    path.write_bytes(encode(content, indent=2))


def encode(content: Mapping[str, Any], indent: int) -> bytes:
    """Return a result file's bytes; some of the figures are NumPy's."""
    return msgspec.json.format(msgspec.json.encode(content, enc_hook=float), indent=indent) + b"\n"


def _copy() -> float:
    """Return the seconds of a large message's copy: shared machines differ most in this."""
    array, times = large_array(), []
    for _ in range(200):
        begin = time.perf_counter()
        array.copy()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown"
    return next((x.partition(":")[2].strip() for x in lines if x.startswith("model name")), "?")


def compare(before: Path, after: Path) -> list[Row]:
    """Return the changes of all figures common to both files, largest first.

    A change is ``real`` if its ratio exceeds the ``noise``: the product of both files' spreads
    between rounds.
    """
    old, new = _rows(before), _rows(after)
    changes: list[Row] = []
    for what in old.keys() & new.keys():
        there, here = old[what]["median_us"], new[what]["median_us"]
        change = {"what": what, "before_us": there, "after_us": here, "ratio": here / there}
        noise = _spread(old[what]) * _spread(new[what])
        real = abs(math.log(here / there)) > math.log(noise)
        changes.append({**change, "noise": noise, "real": real})
    return sorted(changes, key=lambda change: -abs(math.log(change["ratio"])))


def _rows(path: Path) -> dict[str, Row]:
    """Return a file's latency rows by case, system, mode and nodes; or raise `ConfigError`."""
    try:
        rows = msgspec.json.decode(path.read_bytes())["rows"]
        return {
            f"{r['case']}, {r['system']}, {r['mode']}, {r['nodes']} nodes": r
            for r in rows
            if "median_us" in r
        }
    except OSError as error:
        raise ConfigError(f"{path}: expected a result file, found: {error.strerror}") from None
    except (msgspec.DecodeError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: expected a result file of bench, found: {error!r}") from None


def _spread(row: Row) -> float:
    """Return largest to smallest round median, at least 1.02; 1.1 for a single round."""
    rounds = row.get("rounds_us") or [1.0]
    return max(max(rounds) / min(rounds), 1.02) if len(rounds) > 1 else 1.1
