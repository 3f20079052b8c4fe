"""The command line: ``python -m runtime run config.toml`` and its companions.

The commands are the entry points of all installed packages (`runtime.extras`): those about
running nodes are modules of this package, others stand beside what they use. Every error becomes
one line on standard error and exit code 2.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import sys
from pathlib import Path
from typing import NoReturn

import typer

from runtime.errors import CommandError, VisnavError
from runtime.paths import not_utf8
from runtime.tools.cli.commands import Commands

app = typer.Typer(
    cls=Commands, add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False
)


@app.callback()
def _all() -> None:
    """Fly a simulated vehicle, to feed and to measure a visual-navigation system."""


def main() -> None:
    """Run the command line; the process ends here."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")  # a terminal may lack an arrow
        for argument in sys.argv[1:]:
            if why := not_utf8(argument):  # before any library sees it
                raise CommandError(f"command line: {why}")
        app()
    except KeyboardInterrupt:
        interrupted()
    except SystemExit as end:
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            interrupted()  # typer has made it an exit without a word
        if isinstance(
            end.__context__, BrokenPipeError
        ):  # this, too, with a code that means "failed"
            _unheard()
        raise
    except BrokenPipeError:
        _unheard()
    except Exception as error:
        from runtime.tools.cli.run import leave_behind

        leave_behind(2, f"error: {_described(error)}")


def _unheard() -> NoReturn:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(2)


def program() -> None:
    """Run the command line, and end the process even while Zenoh's threads still run.

    Python stops threads that call it while it ends, and one that it stops in Zenoh's code aborts
    the process.
    """
    try:
        main()
    except SystemExit as end:
        if "zenoh" not in sys.modules or not isinstance(end.code, int | None):
            raise
        atexit._run_exitfuncs()
        with contextlib.suppress(OSError, ValueError):  # a closed pipe
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(end.code or 0)


def interrupted() -> NoReturn:
    """End the process after a Ctrl-C before or after a run."""
    print("error: interrupted", file=sys.stderr)
    sys.exit(130)


def _described(error: Exception) -> str:
    from runtime.run.node_runner import with_place, wrap

    if isinstance(error, VisnavError):
        return with_place(error)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return with_place(wrap("runtime", error))
