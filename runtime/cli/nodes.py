"""``nodes``: what there is to put into a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.tree import Tree

    from runtime.node import Node


def nodes(
    which: Annotated[
        str | None, typer.Argument(help='Only this one: "module:Class", or a part of its name.')
    ] = None,
) -> None:
    """List the nodes that come with the project: their ports and settings."""
    from rich.console import Console

    from runtime.cli.catalogue import find_nodes
    from runtime.errors import ConfigError, suggest

    found = find_nodes()
    shown = {
        name: cls for name, cls in found.items() if which is None or which.lower() in name.lower()
    }
    if not shown:
        raise ConfigError(
            f"expected the name of a node, found {which!r}"
            + suggest(str(which), [*found, *(name.partition(":")[2] for name in found)])
        )
    console = Console()
    for name, cls in shown.items():
        console.print(_describe(name, cls), highlight=False)


def _describe(name: str, cls: type[Node[Any]]) -> Tree:
    import inspect

    import msgspec
    from rich.markup import escape
    from rich.tree import Tree

    from runtime.graph import heard_types

    tree = Tree(f"[bold]{name}[/bold]  {(inspect.getdoc(cls) or '').splitlines()[0]}")
    for port, events in heard_types(cls).items():
        arrow = "handles" if port in cls.declared.handlers else "reads"
        tree.add(f"{arrow} {' or '.join(e.__name__ for e in events)} as {port}")
    for port, output in cls.declared.outputs.items():
        tree.add(f"sends {output.event.__name__} as {port}")
    for method, ticks in cls.declared.ticks.items():
        rate = f"{ticks.hz:g} Hz" if isinstance(ticks.hz, float | int) else f"the rate {ticks.hz!r}"
        tree.add(f"calls {method} at {rate}")
    for field in msgspec.structs.fields(cls.config_type):
        default = "required" if field.required else f"= {_default(field)}"
        tree.add(escape(f"setting {field.encode_name}: {_type_name(field.type)} {default}"))
    return tree


def _default(field: Any) -> str:
    import msgspec

    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _type_name(type_: Any) -> str:
    if getattr(type_, "__metadata__", None):
        return _type_name(type_.__origin__)
    if isinstance(type_, type) and not getattr(type_, "__args__", None):
        return type_.__name__
    return str(type_).replace("typing.", "")
