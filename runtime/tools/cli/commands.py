"""Commands of installed packages, their shared arguments, and outcomes of runs as JSON and JUnit.

Help needs no imports: it takes the first sentence of a command's docstring from its source, so
that it comes at once however much the packages import.

Outcomes have one vocabulary: ``crashed`` came to no end of its own, ``failed`` missed a threshold,
``passed`` met them all, and ``not judged`` was asked for none. The XML is that of pytest and
Jenkins: a test suite, with a test case for each run and estimator; ``crashed`` is an error, ``not
judged`` skipped.
"""

from __future__ import annotations

import ast
import contextlib
import math
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import typer
from typer.core import TyperCommand, TyperGroup

from runtime.errors import CommandError, ConfigError, expect_known
from runtime.extras import COMMANDS, Offer, is_ours, missing_extension, offers

if TYPE_CHECKING:
    from runtime.summary import Verdict
    from runtime.tools.paper.typeset import Format
    from runtime.tools.sweep import Row


ConfigFile = Annotated[Path, typer.Argument(help="The file that says what to run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NODE.KEY=VALUE",
        help="Change a setting of a node, or of the run (run.seed=3). May be repeated.",
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress bar, and at the end only why it failed.")
]


def warn(warning: str) -> None:
    """Print a warning, as a line of its own."""
    print(f"warning: {warning}", file=sys.stderr)


class Commands(TyperGroup):
    """All commands, by the name of their entry points."""

    # Contexts and commands are of click's, which Typer brings along under a name of its own.

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """Return the names of all commands: this project's first, then other packages'."""
        return list(_commands())

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """Return a command's stub for the help, not callable."""
        if cmd_name not in _commands():
            return None
        offer = _chosen(cmd_name)
        panel = None if is_ours(offer.package) else f"Commands of {offer.package}"
        return TyperCommand(cmd_name, help=_help(offer), rich_help_panel=panel)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ARG002
        """Import and return the command named by the arguments.

        Raises:
            ConfigError: There is no such command.
            CommandError: It cannot be imported.
        """
        name, *arguments = args
        listed = ", ".join(_commands())
        if name not in _commands() and (extension := missing_extension(name)):
            raise ConfigError(f"{name} is a command of {extension}")
        expect_known(name, _commands(), f"expected a command ({listed}), found {name!r}")
        return name, load(_chosen(name)), arguments

    def make_context(self, *args: Any, **options: Any) -> Any:
        """Read the arguments before the command."""
        with _plain_errors():
            return super().make_context(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        """Parse the command's arguments, and call the command."""
        with _plain_errors():
            return super().invoke(ctx)


_USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
"""Click's base class of usage errors, shown in a box by Typer."""


@contextlib.contextmanager
def _plain_errors() -> Iterator[None]:
    try:
        yield
    except _USAGE_ERROR as error:
        usage: Any = error
        if type(error).__name__ == "NoArgsIsHelpError":  # prints the help, and is meant
            raise
        message = " ".join(usage.format_message().split()).replace("Value error, ", "").rstrip(".")
        path = getattr(getattr(usage, "ctx", None), "command_path", "python -m runtime")
        raise ConfigError(
            f"{message[:1].lower()}{message[1:]}; `{path} --help` says what it takes"
        ) from None


def load(offer: Offer) -> Any:
    """Import a command, or raise `CommandError`."""
    command = offer.load()
    if not isinstance(command, typer.Typer):
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command(offer.name)(command)
        command = app
    try:
        return typer.main.get_command(command)
    except Exception as error:  # Typer raises various types
        raise CommandError(
            f"{offer.name} of the package {offer.package}: expected {offer.value!r} to be a "
            f"function as Typer takes it, found: {error}"
        ) from error


@cache
def _commands() -> dict[str, list[Offer]]:
    by_name: dict[str, list[Offer]] = {}
    for offer in offers(COMMANDS):
        by_name.setdefault(offer.name, []).append(offer)
    return by_name


def _chosen(name: str) -> Offer:
    used, *unused = _commands()[name]
    for offer in unused:
        warn(
            f"the packages {used.package} and {offer.package} both offer the command {name}; "
            f"that of {used.package} is used"
        )
    return used


def _help(offer: Offer) -> str:
    module, _, name = offer.value.partition(":")
    source = _source(module)
    if source is not None:
        for node in ast.parse(source.read_bytes()).body:
            if isinstance(node, ast.FunctionDef) and node.name == name:
                return ast.get_docstring(node) or ""
    try:
        app = offer.load()
        return str(app.info.help if isinstance(app, typer.Typer) else load(offer).help or "")
    except CommandError as error:
        return f"(cannot be used: {error})"


def _source(module: str) -> Path | None:
    search: Any = None
    spec = None
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        specs = (finder.find_spec(name, search) for finder in sys.meta_path)
        spec = next((candidate for candidate in specs if candidate is not None), None)
        if spec is None:
            return None
        search = spec.submodule_search_locations
    origin = Path(spec.origin) if spec and spec.origin else None
    return origin if origin and origin.suffix == ".py" and origin.is_file() else None


JUnit = Annotated[
    Path | None, typer.Option(help="Write who passed as JUnit's XML, for continuous integration.")
]
Json = Annotated[
    Path | None, typer.Option("--json", help="Write who passed, with all figures, as JSON.")
]

Latex = Annotated[
    bool,
    typer.Option("--latex", help="Print the table in LaTeX (booktabs), and nothing else."),
]
Markdown = Annotated[
    bool, typer.Option("--markdown", help="Print the table in Markdown, and nothing else.")
]
Csv = Annotated[
    bool, typer.Option("--csv", help="Print the table in CSV, with all digits, and nothing else.")
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--figure",
        metavar="FIGURE",
        help="Column of that table, as ate_percent; the main figures if not given. May be "
        "repeated.",
    ),
]


def chosen_format(
    *, latex: bool, markdown: bool, csv: bool, figures: Sequence[str] | None = None
) -> Format | None:
    """Return the format of a table that is printed instead of all else; `None` if none is.

    Raises:
        CommandError: Several are given, or figures without any.
    """
    options = {"latex": latex, "markdown": markdown, "csv": csv}
    formats: list[Any] = [name for name, is_set in options.items() if is_set]
    if len(formats) > 1:
        raise CommandError(f"expected one format of the table, found --{' and --'.join(formats)}")
    if figures and not formats:
        raise CommandError("--figure: expected --latex, --markdown or --csv beside it, found none")
    return formats[0] if formats else None


State = Literal["passed", "failed", "crashed", "not judged"]

_STATES: dict[bool | None, State] = {True: "passed", False: "failed", None: "not judged"}


NOBODY = "thresholds were given, and no estimator announced itself or sent a pose"
"""Reason for the failure of a run without estimators."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a run for one of its estimators, or of a flight of which something was asked.

    Attributes:
        estimator: Its source, or ``flight of`` a vehicle; empty for a run without any.
        reasons: Sentences on a failure or crash.
        seconds: Real time of the whole run.
        figures: All figures, as in ``evaluation/verdict.json``.
    """

    run: str
    estimator: str = ""
    state: State
    reasons: list[str] = []
    seconds: float | None = None
    figures: dict[str, Any] = {}


def of_verdict(run: str, verdict: Verdict | None, seconds: float | None = None) -> list[Outcome]:
    """Return the outcomes of a run that came to an end."""
    judged = dict(verdict.estimators) if verdict else {}
    for vehicle, figures in (verdict.flights if verdict else {}).items():
        if figures["passed"] is not None:
            judged[f"flight of {vehicle}"] = figures
    if verdict is None or not judged:
        state = _STATES[verdict.passed if verdict else None]
        reasons = [NOBODY] if state == "failed" else []
        return [Outcome(run=run, state=state, reasons=reasons, seconds=seconds)]
    return [
        Outcome(
            run=run,
            estimator=name,
            state=_STATES[figures["passed"]],
            reasons=[str(reason) for reason in figures.get("failed", ())],
            seconds=seconds,
            figures=figures,
        )
        for name, figures in judged.items()
    ]


def of_rows(names: Iterable[str], rows: Iterable[Row]) -> list[Outcome]:
    """Return the outcomes of a sweep's runs."""
    from runtime.summary import Verdict

    outcomes: list[Outcome] = []
    for name, row in zip(names, rows, strict=True):
        if row["error"]:
            crashed = Outcome(
                run=name, state="crashed", reasons=[row["error"]], seconds=row["wall_seconds"]
            )
            outcomes.append(crashed)
        else:
            verdict = Verdict(row["passed"], row["estimators"], row.get("flights", {}))
            outcomes += of_verdict(name, verdict, row["wall_seconds"])
    return outcomes


@contextlib.contextmanager
def writing(name: str, junit: Path | None, json: Path | None) -> Iterator[list[Outcome]]:
    """Yield a list for outcomes, written at the end as a test suite; an exception is one of them.

    Raises:
        OSError: A file cannot be written.
    """
    outcomes: list[Outcome] = []
    try:
        yield outcomes
    except Exception as error:
        outcomes.append(Outcome(run=name, state="crashed", reasons=[str(error)]))
        raise
    finally:
        if junit is not None:
            _write(junit, to_junit(name, outcomes))
        if json is not None:
            _write(json, msgspec.json.format(msgspec.json.encode(outcomes), indent=2) + b"\n")


def to_junit(name: str, outcomes: Sequence[Outcome]) -> bytes:
    """Return JUnit's XML (github.com/testmoapp/junitxml describes it)."""
    from xml.etree import ElementTree as ET

    number = Counter(outcome.state for outcome in outcomes)
    total = {
        "name": _printable(name),
        "tests": str(len(outcomes)),
        "failures": str(number["failed"]),
        "errors": str(number["crashed"]),
        "skipped": str(number["not judged"]),
        "time": f"{math.fsum(outcome.seconds or 0.0 for outcome in outcomes):.3f}",
    }
    suites = ET.Element("testsuites")
    suite = ET.SubElement(suites, "testsuite", total)
    elements = {"failed": "failure", "crashed": "error", "not judged": "skipped"}
    for outcome in outcomes:
        case = ET.SubElement(
            suite,
            "testcase",
            {
                "classname": _printable(outcome.run),
                "name": _printable(outcome.estimator or "run"),
                "time": f"{outcome.seconds or 0.0:.3f}",
            },
        )
        if outcome.state != "passed":
            reasons = [_printable(reason) for reason in outcome.reasons] or [outcome.state]
            problem = ET.SubElement(case, elements[outcome.state], {"message": reasons[0]})
            problem.text = "\n".join(reasons)
    ET.indent(suites)
    return bytes(ET.tostring(suites, encoding="utf-8", xml_declaration=True)) + b"\n"


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() or c in "\n\t" else "�" for c in text)


def _write(path: Path, content: bytes) -> None:
    from runtime.run import results

    path.parent.mkdir(parents=True, exist_ok=True)
    results.write(path, content)
