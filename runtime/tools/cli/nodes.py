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
    """List nodes with their ports and settings: those that installed packages offer."""
    from rich.console import Console

    from runtime.config.reading import find_node
    from runtime.errors import ConfigError, suggest
    from runtime.tools.cli.common import warn
    from runtime.tools.plugins import find_nodes

    found = find_nodes(warn)
    shown = {
        name: cls for name, cls in found.items() if which is None or which.lower() in name.lower()
    }
    if not shown and which is not None and ":" in which:
        shown = {which: find_node(which, "nodes")}
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
    _add_settings(tree, cls.config_type)
    return tree


def _add_settings(tree: Tree, config: type[Any]) -> None:
    """Add a line a setting, and below it the settings of a table or of a list of tables."""
    import msgspec
    from rich.markup import escape

    from runtime.config.parameters import is_marked

    for field in msgspec.structs.fields(config):
        inner = _struct(field.type)
        default = "required" if field.required else "" if inner else f"= {_default(field)}"
        line = f"setting {field.encode_name}: {_type_name(field.type)} {default}".rstrip()
        if is_marked(field.type):
            line += "  (can change in a run)"
        branch = tree.add(escape(line))
        if inner is not None:
            _add_settings(branch, inner)


def _struct(type_: Any) -> type[Any] | None:
    """Return the struct that a type is or holds."""
    if hasattr(type_, "__struct_fields__"):
        return type_  # type: ignore[no-any-return]
    return next((s for a in getattr(type_, "__args__", ()) if (s := _struct(a))), None)


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
    inner = ", ".join("…" if a is ... else _type_name(a) for a in getattr(type_, "__args__", ()))
    name = {"tuple": "list of ", "Literal": "one of ", "Union": "", "UnionType": ""}.get(
        getattr(getattr(type_, "__origin__", type_), "__name__", type(type_).__name__)
    )
    return f"{name}{inner}" if name is not None else repr(type_)
