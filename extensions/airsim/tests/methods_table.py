"""The methods as a table for the page: ``python -m extensions.airsim.tests.methods_table``.

It stands below the heading `HEADING` of the page `PAGE`, in Markdown, to the page's end.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import visnav_airsim.server
from visnav_airsim.server.methods import Method, constant_methods, methods_of

PAGE = Path(__file__).parents[1] / "docs" / "methods.md"
HEADING = "## Methods\n"


class Row(NamedTuple):
    """A method in the documentation."""

    name: str
    arguments: str
    description: str


def methods() -> dict[str, Method]:
    """Return all methods by name: those of the classes in this package, and constant ones."""
    table = constant_methods()
    for module in pkgutil.iter_modules(visnav_airsim.server.__path__, "visnav_airsim.server."):
        for _, group in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            table |= methods_of(group)
    return table


def rows() -> Iterator[Row]:
    """Yield all methods, by name."""
    for name, method in sorted(methods().items(), key=lambda item: item[0].lower()):
        arguments = (
            f"{parameter}: {_type_name(hint)}" for parameter, hint in method.parameters.items()
        )
        yield Row(name, ", ".join(arguments), method.description)


def markdown() -> str:
    """Return the table."""
    lines = [
        f"| `{row.name}` | {f'`{row.arguments}`' if row.arguments else ''} | {row.description} |"
        for row in rows()
    ]
    return "\n".join(["| method | arguments | what it does here |", "|---|---|---|", *lines, ""])


def rewritten(page: str) -> str:
    """Return a page with the table as it should be.

    Raises:
        ValueError: It lacks the heading.
    """
    before, heading, _ = page.partition(HEADING)
    if not heading:
        raise ValueError(f"expected the heading {HEADING.strip()!r} in the page")
    return f"{before}{heading}\n{markdown()}"


def _type_name(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return _type_name(arguments[0])
    if origin is types.UnionType:
        return " or ".join(map(_type_name, arguments))
    if origin is not None:
        return f"{origin.__name__}[{', '.join(map(_type_name, arguments))}]"
    return "any" if hint is Any else "..." if hint is ... else getattr(hint, "__name__", str(hint))


if __name__ == "__main__":
    PAGE.write_text(rewritten(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
