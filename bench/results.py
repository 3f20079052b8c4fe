"""Result files: environment and versions of the measurements, and changes between two files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from runtime.errors import ConfigError
from runtime.run.summarise import commit
from runtime.run.summarise import environment as versions


def environment() -> dict[str, str]:
    """Return machine, versions and commit."""
    return {**versions(), "cpu": _cpu(), "commit": commit(Path(__file__).parent) or "unknown"}


def write_json(path: Path, rows: list[Any], **more: Any) -> None:
    """Write ``environment``, ``rows`` and whatever else, indented."""
    content = {"environment": environment(), "rows": rows, **more}
    path.write_bytes(msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n")


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return "unknown"
    return next((x.partition(":")[2].strip() for x in lines if x.startswith("model name")), "?")


class Change(msgspec.Struct, frozen=True):
    """Change of a figure between two files.

    Attributes:
        what: Case, system, mode, nodes.
        noise: Ratio that noise explains: the product of both files' spreads between rounds.
    """

    what: str
    before_us: float
    after_us: float
    ratio: float
    noise: float

    @property
    def real(self) -> bool:
        """Whether the change exceeds the noise."""
        return abs(math.log(self.ratio)) > math.log(self.noise)


def read_rows(path: Path) -> dict[str, dict[str, Any]]:
    """Return a file's latency rows by case, system, mode and nodes; or raise `ConfigError`."""
    try:
        content = msgspec.json.decode(path.read_bytes())
        rows = content["rows"]
        return {
            f"{r['case']}, {r['system']}, {r['mode']}, {r['nodes']} nodes": r
            for r in rows
            if "median_us" in r
        }
    except OSError as error:
        raise ConfigError(f"{path}: expected a result file, found: {error.strerror}") from None
    except (msgspec.DecodeError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: expected a result file of bench, found: {error!r}") from None


def compare(before: Path, after: Path) -> list[Change]:
    """Return the changes of all figures common to both files, largest first."""
    old, new = read_rows(before), read_rows(after)
    changes = [
        Change(
            what,
            old[what]["median_us"],
            new[what]["median_us"],
            new[what]["median_us"] / old[what]["median_us"],
            _spread(old[what]) * _spread(new[what]),
        )
        for what in old.keys() & new.keys()
    ]
    return sorted(changes, key=lambda c: -abs(math.log(c.ratio)))


def _spread(row: dict[str, Any]) -> float:
    """Return largest to smallest round median, at least 1.02; 1.1 for a single round."""
    rounds = row.get("rounds_us") or [1.0]
    return max(max(rounds) / min(rounds), 1.02) if len(rounds) > 1 else 1.1
