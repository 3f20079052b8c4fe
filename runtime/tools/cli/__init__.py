"""The command line: ``python -m runtime run config.toml`` and its companions.

One module a command; what a command needs is imported when it runs, so that help comes at once.
Every error becomes one line on standard error and exit code 2.
"""

from __future__ import annotations

import io
import os
import sys
from typing import NoReturn

import typer

from runtime.errors import VisnavError
from runtime.tools.cli.bench import bench
from runtime.tools.cli.check import check
from runtime.tools.cli.example import demo, example
from runtime.tools.cli.export import export
from runtime.tools.cli.graph import graph
from runtime.tools.cli.nodes import nodes
from runtime.tools.cli.recover import recover
from runtime.tools.cli.report import report
from runtime.tools.cli.run import leave_behind, run
from runtime.tools.cli.schema import schema
from runtime.tools.cli.set import set_
from runtime.tools.cli.sweep import sweep
from runtime.tools.cli.top import top
from runtime.tools.cli.trace import trace
from runtime.tools.cli.vocabulary import vocabulary
from runtime.tools.cli.web import web

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Fly a simulated vehicle, feed a visual-navigation system, and measure it.",
)
app.command()(run)
app.command()(demo)
app.command()(example)
app.command()(check)
app.command()(graph)
app.command()(nodes)
app.command()(schema)
app.command()(sweep)
app.command()(report)
app.command()(export)
app.command()(recover)
app.command()(trace)
app.command()(top)
app.command()(web)
app.command("set")(set_)
app.command()(vocabulary)
app.command(  # the arguments, --help among them, are the benchmarks' own
    context_settings={
        "ignore_unknown_options": True,
        "allow_extra_args": True,
        "help_option_names": [],
    }
)(bench)


def main() -> None:
    """Run the command line; the process ends here."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")  # a terminal may lack an arrow
        app()
    except KeyboardInterrupt:
        interrupted()
    except SystemExit as end:
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            interrupted()  # typer has made it an exit without a word
        raise
    except BrokenPipeError:  # whoever reads what we print has heard enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
    except Exception as error:
        leave_behind(2, f"error: {_described(error)}")


def interrupted() -> NoReturn:
    """End the process after a Ctrl-C before or after a run."""
    print("error: interrupted", file=sys.stderr)
    sys.exit(130)


def _described(error: Exception) -> str:
    """Return an error as a line: one of ours says all; of others, type and place, too."""
    from runtime.node_runner import with_place, wrap

    if isinstance(error, VisnavError):
        return with_place(error)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    return with_place(wrap("runtime", error))
