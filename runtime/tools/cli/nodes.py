"""``nodes``: what there is to put into a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.tree import Tree

    from runtime.tools.describe import NodeDescription, SettingDescription


def nodes(
    which: Annotated[
        str | None, typer.Argument(help='Only this one: a part of its name, or "module:Class".')
    ] = None,
) -> None:
    """Describe nodes: their ports, and their settings with meaning, range and default.

    Without an argument these are all that installed packages offer. Settings that every file may
    have, whatever its nodes, are listed by "python -m runtime settings".
    """
    from rich.console import Console

    from runtime.config.reading import find_modules_in, find_node, find_nodes
    from runtime.errors import ConfigError, suggest
    from runtime.tools.cli.common import warn
    from runtime.tools.describe import describe

    found = find_nodes(warn)
    shown = {
        name: cls
        for name, cls in found.items()
        if which is None or which.lower() in f"{name} {cls.__module__}".lower()
    }
    if not shown and which is not None and ":" in which:
        find_modules_in(Path.cwd())
        shown = {which: find_node(which, "nodes")}
    if not shown:
        raise ConfigError(
            f"expected the name of a node, found {which!r}" + suggest(str(which), found)
        )
    console = Console()
    for name, cls in shown.items():
        console.print(_tree(describe(cls, name)), highlight=False)


def _tree(node: NodeDescription) -> Tree:
    """Return a node as a tree: what it is, its ports, ticks and settings."""
    from rich.markup import escape
    from rich.tree import Tree

    tree = Tree(f"[bold]{node.type}[/bold]\n{escape(node.doc)}")
    for title, ports in (("listens to", node.inputs), ("sends", node.outputs)):
        branch = _branch(tree, title, ports)
        for port in ports:
            details = ", ".join(filter(None, [port.kind, port.delivery]))
            events = " or ".join(port.events)
            line = f"[bold]{port.name}[/bold]  {events} ({details})"
            branch.add(f"{line}\n{escape(port.doc)}".rstrip())
    branch = _branch(tree, "is called", node.ticks)
    for tick in node.ticks:
        branch.add(f"[bold]{tick.name}[/bold]  at {tick.rate}\n{escape(tick.doc)}")
    add_settings(_branch(tree, "settings", node.settings), node.settings)
    return tree


def _branch(tree: Tree, title: str, content: Sequence[object]) -> Tree:
    return tree.add(title) if content else tree


def add_settings(tree: Tree, settings: Iterable[SettingDescription]) -> None:
    """Add settings to a tree, and below each table those in it."""
    from rich.markup import escape

    for setting in settings:
        default = f"= {setting.default}" if setting.default else ""
        if len(default) > 60:
            default = default[:57] + "…"
        required = "required" if setting.required else ""
        changeable = "can change in a run" if setting.changeable else ""
        details = [setting.type, setting.constraint, required, changeable]
        line = " ".join(filter(None, [default, f"({', '.join(filter(None, details))})"]))
        line = f"[bold]{setting.name}[/bold]  {escape(line)}"
        add_settings(tree.add(f"{line}\n{escape(setting.doc)}".rstrip()), setting.settings)
