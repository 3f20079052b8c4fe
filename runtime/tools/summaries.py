"""Summaries of finished runs, read back."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from runtime.errors import ResultsError

S = TypeVar("S", bound=msgspec.Struct)


def read_summary(folder: Path, type_: type[S]) -> S:
    """Read the summary in a run's folder, or a part of it; else raise `ResultsError`."""
    file = folder / "summary.json"
    try:
        return msgspec.json.decode(file.read_bytes(), type=type_)
    except OSError as error:
        raise ResultsError(f"{file}: expected a run's summary, found: {error.strerror}") from None
    except msgspec.MsgspecError as error:
        raise ResultsError(f"{file}: expected a run's summary, found: {error}") from None
