"""What every benchmark's JSON file has: where and with what it was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

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
