"""``report``: a run's folder as one page to read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    run: Annotated[Path, typer.Argument(help="The folder of a run: runs/<name>.")],
) -> None:
    """Write a run's report.html and its figures (plots/*) anew.

    A run that was killed, or that nobody evaluated, gives a page that says what is missing.
    """
    from nodes.judging.report.page import write_report
    from runtime.errors import ConfigError

    try:
        print(write_report(run))
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
