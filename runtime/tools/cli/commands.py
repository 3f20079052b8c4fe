"""Commands of installed packages, each imported on use, and shared arguments.

Help needs no imports: it takes the first sentence of a command's docstring from its source, so
that it comes at once however much the packages import.
"""

from __future__ import annotations

import ast
import contextlib
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from runtime.config.plugins import COMMANDS, OURS, Offer, offers
from runtime.errors import CommandError, ConfigError, expect_known

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
        panel = None if offer.package == OURS else f"Commands of {offer.package}"
        return TyperCommand(cmd_name, help=_help(offer), rich_help_panel=panel)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ARG002
        """Import and return the command named by the arguments.

        Raises:
            ConfigError: There is no such command.
            CommandError: It cannot be imported.
        """
        name, *rest = args
        listed = ", ".join(_commands())
        expect_known(name, _commands(), f"expected a command ({listed}), found {name!r}")
        return name, load(_chosen(name)), rest

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
        found: Any = error
        if type(error).__name__ == "NoArgsIsHelpError":  # prints the help, and is meant
            raise
        message = " ".join(found.format_message().split()).replace("Value error, ", "").rstrip(".")
        path = getattr(getattr(found, "ctx", None), "command_path", "python -m runtime")
        raise ConfigError(
            f"{message[:1].lower()}{message[1:]}; `{path} --help` says what it takes"
        ) from None


def load(offer: Offer) -> Any:
    """Import a command, or raise `CommandError`."""
    found = offer.load()
    if not isinstance(found, typer.Typer):
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command(offer.name)(found)
        found = app
    try:
        return typer.main.get_command(found)
    except Exception as error:  # whatever Typer does not like
        raise CommandError(
            f"{offer.name} of the package {offer.package}: expected {offer.value!r} to be a "
            f"function as Typer takes it, found: {error}"
        ) from error


@cache
def _commands() -> dict[str, list[Offer]]:
    found: dict[str, list[Offer]] = {}
    for offer in offers(COMMANDS):
        found.setdefault(offer.name, []).append(offer)
    return found


def _chosen(name: str) -> Offer:
    used, *others = _commands()[name]
    for other in others:
        warn(
            f"the packages {used.package} and {other.package} both offer the command {name}; "
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
        found = offer.load()
        return str(found.info.help if isinstance(found, typer.Typer) else load(offer).help or "")
    except CommandError as error:
        return f"(cannot be used: {error})"


def _source(module: str) -> Path | None:
    search: Any = None
    spec = None
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        found = (finder.find_spec(name, search) for finder in sys.meta_path)
        spec = next((each for each in found if each is not None), None)
        if spec is None:
            return None
        search = spec.submodule_search_locations
    origin = Path(spec.origin) if spec and spec.origin else None
    return origin if origin and origin.suffix == ".py" and origin.is_file() else None
