"""Check of the package `events`: this project's, and not another of the same name."""

from __future__ import annotations

import importlib
from pathlib import Path


def check_events() -> None:
    """Check where the package `events` comes from.

    Raises:
        ImportError: It is another project's; `name` is then ``runtime``, so that
            ``python -m runtime`` prints one line instead of a traceback.
    """
    expected = Path(__file__).resolve().parents[1] / "events" / "__init__.py"
    try:
        events = importlib.import_module("events")
        found = Path(events.__file__ or "?").resolve()
        ours = found == expected and hasattr(events, "PoseEstimate")
    except ModuleNotFoundError as error:
        if error.name != "events":
            raise
        found, ours = Path("none"), False
    if not ours:
        over = " installed over it" if found == expected else ""
        raise ImportError(
            f"expected the package events of visnav-runtime in {expected.parent}, found {found}"
            f"{over}: another package of this name stands in the way; remove or rename it",
            name="runtime",
        )


check_events()  # an import of the runtime reports it before anything else fails
