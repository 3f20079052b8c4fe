"""Declarations of a node's class: inputs, outputs, bundles, handlers and ticks."""

from __future__ import annotations

import inspect
from typing import Any

import msgspec

from runtime.channels.bundles import Bundle
from runtime.channels.ports import Handles, Input, Output, Ticks
from runtime.errors import DeclarationError


class Declared(msgspec.Struct):
    """Declarations of a node's class by attribute name, in the order of the class body."""

    inputs: dict[str, Input[Any]]
    bundles: dict[str, Bundle[Any]]
    outputs: dict[str, Output[Any]]
    handlers: dict[str, Handles]
    ticks: dict[str, Ticks]
    listening: list[str]
    """Inputs, bundles and handlers, in the order of delivery."""

    def bundle_fields(self) -> list[str]:
        """Return ``bundle.field`` for all fields of all bundles."""
        return [f"{name}.{field}" for name, b in self.bundles.items() for field in b.fields]

    def optional_fields(self) -> list[str]:
        """Return ``bundle.field`` for the optional fields of all bundles."""
        return [
            f"{name}.{field}"
            for name, bundle in self.bundles.items()
            for field, member in bundle.fields.items()
            if member.kind == "maybe"
        ]


def read_declarations(cls: type[Any], base: type[Any]) -> Declared:
    """Return the declarations of a node's class and its bases.

    Args:
        base: The base of all nodes, whose attributes are no names for ports.

    Raises:
        DeclarationError: A port has a reserved name, or a phase is of the wrong kind.
    """
    _check_phases(cls, base)
    reserved = {*vars(base), *base.__annotations__}
    declared = Declared({}, {}, {}, {}, {}, [])
    names = dict.fromkeys(name for base in reversed(cls.__mro__) for name in vars(base))
    for name in names:
        value = getattr(cls, name, None)
        if isinstance(value, Input | Bundle | Output) and name in reserved:
            raise DeclarationError(
                f"{cls.__name__}.{name}: every node has an attribute of this name; "
                "call the port something else"
            )
        if isinstance(value, Input):
            declared.inputs[name] = value
        elif isinstance(value, Bundle):
            declared.bundles[name] = value
        elif isinstance(value, Output):
            declared.outputs[name] = value
        if handles := getattr(value, "__handles__", None):
            declared.handlers[name] = handles
        if ticks := getattr(value, "__ticks__", None):
            declared.ticks[name] = ticks
        if name in declared.inputs or name in declared.bundles or name in declared.handlers:
            declared.listening.append(name)
    return declared


def _check_phases(cls: type[Any], base: type[Any]) -> None:
    for phase, method in vars(cls).items():
        meant = vars(base).get(phase)
        if not inspect.isfunction(method) or not inspect.isfunction(meant):
            continue
        awaited = inspect.iscoroutinefunction(meant)
        if inspect.iscoroutinefunction(inspect.unwrap(method)) != awaited:
            expected, actual = f"async def {phase}", f"def {phase}"
            if inspect.isasyncgenfunction(method):
                actual = f"async def {phase} with a yield in it"
            if not awaited:
                expected, actual = f"def {phase}", f"async def {phase}"
            raise DeclarationError(
                f"{cls.__name__}.{phase}: expected `{expected}`, found `{actual}`"
            )
