"""Entry points of installed packages: commands, nodes, and readers of configurations.

A package names them in its ``pyproject.toml``; this project does the same for its own:

    [project.entry-points."visnav.commands"]
    fly = "my_package.fly:fly"            # a function as Typer takes it, or a typer.Typer

    [project.entry-points."visnav.nodes"]
    MyNode = "my_package.nodes:MyNode"

    [project.entry-points."visnav.configurations"]
    json = "my_package.settings:read"     # read(text, path, warn): the table of a TOML file of ours

A file names a node that is listed here by its name, ``type = "MyNode"``, and any other as
``module:Class``.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, NamedTuple

from runtime.errors import CommandError

COMMANDS = "visnav.commands"
NODES = "visnav.nodes"
CONFIGURATIONS = "visnav.configurations"
OURS = "visnav-runtime"
_PROJECT = Path(__file__).parents[2] / "pyproject.toml"
"""Of a checkout; an installed wheel has none."""


class Offer(NamedTuple):
    """Entry point offered by a package.

    Attributes:
        name: The name of the command, or of the node's class.
        value: ``module:attribute``.
    """

    package: str
    name: str
    value: str

    def load(self) -> Any:
        """Import the module and return the object of the entry point, or raise `CommandError`."""
        try:
            return EntryPoint(self.name, self.value, "").load()
        except Exception as error:  # whatever a package does when it is imported
            raise CommandError(
                f"{self.name} of the package {self.package}: expected {self.value!r} to be "
                f"something to import, found {type(error).__name__}: {error}"
            ) from error


@cache
def offers(group: str) -> tuple[Offer, ...]:
    """Return the entry points of a group: this project's first, then other packages' by name.

    In a checkout this project's come from its ``pyproject.toml``, because the metadata of an
    editable installation is as old as the installation.

    Raises:
        CommandError: There are none of this project: it is not installed.
    """
    found = [
        Offer(point.dist.name if point.dist else "?", point.name, point.value)
        for point in entry_points(group=group)
    ]
    found.sort(key=lambda offer: (offer.package != OURS, offer.package))
    ours = _declared(group) or [offer for offer in found if offer.package == OURS]
    if not ours:
        raise CommandError(
            f"expected the package {OURS} to be installed, found no {group} of it: "
            '"pip install ." in its folder installs it'
        )
    return (*ours, *(offer for offer in found if offer.package != OURS))


def _declared(group: str) -> list[Offer]:
    """Return the entry points of this checkout's ``pyproject.toml``; empty without the file."""
    import tomllib

    if not _PROJECT.is_file():
        return []
    project = tomllib.loads(_PROJECT.read_text(encoding="utf-8")).get("project", {})
    if project.get("name") != OURS:
        return []
    declared = project.get("entry-points", {}).get(group, {})
    return [Offer(OURS, name, value) for name, value in declared.items()]
