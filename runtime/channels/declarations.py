"""Reading what a class of nodes declares: its ports, handlers, ticks and phases."""

from __future__ import annotations

import inspect
from typing import Any

import msgspec

from runtime.channels.bundles import Bundle
from runtime.channels.ports import Handles, Input, Output, Ticks
from runtime.errors import DeclarationError


class Declared(msgspec.Struct):
    """What a node's class declares, by attribute name, in the order of the class body."""

    inputs: dict[str, Input[Any]]
    bundles: dict[str, Bundle[Any]]
    outputs: dict[str, Output[Any]]
    handlers: dict[str, Handles]
    ticks: dict[str, Ticks]
    listening: list[str]
    """Inputs, bundles and handlers, in the order in which they receive an event."""

    def bundle_fields(self) -> list[str]:
        """Return ``bundle.field`` for all fields of all bundles."""
        return [f"{name}.{field}" for name, b in self.bundles.items() for field in b.fields]

    def optional_fields(self) -> list[str]:
        """Return ``bundle.field`` for the fields that a set can do without."""
        return [
            f"{name}.{field}"
            for name, bundle in self.bundles.items()
            for field, each in bundle.fields.items()
            if each.kind == "maybe"
        ]


def read_declarations(cls: type[Any], base: type[Any]) -> Declared:
    """Return what a class of nodes and its bases declare.

    Args:
        cls: The class.
        base: The base of all nodes, whose attributes are no names for ports.

    Raises:
        DeclarationError: A port has a reserved name, or a phase is of the wrong kind.
    """
    _check_phases(cls, base)
    reserved = {*vars(base), *base.__annotations__}
    found = Declared({}, {}, {}, {}, {}, [])
    names = dict.fromkeys(name for each in reversed(cls.__mro__) for name in vars(each))
    for name in names:
        value = getattr(cls, name, None)
        if isinstance(value, Input | Bundle | Output) and name in reserved:
            raise DeclarationError(
                f"{cls.__name__}.{name}: every node has an attribute of this name; "
                "call the port something else"
            )
        if isinstance(value, Input):
            found.inputs[name] = value
        elif isinstance(value, Bundle):
            found.bundles[name] = value
        elif isinstance(value, Output):
            found.outputs[name] = value
        if handles := getattr(value, "__handles__", None):
            found.handlers[name] = handles
        if ticks := getattr(value, "__ticks__", None):
            found.ticks[name] = ticks
        if name in found.inputs or name in found.bundles or name in found.handlers:
            found.listening.append(name)
    return found


def _check_phases(cls: type[Any], base: type[Any]) -> None:
    """Raise `DeclarationError` for a phase that is a coroutine function and should not, or not."""
    for phase, method in vars(cls).items():
        meant = vars(base).get(phase)
        if not inspect.isfunction(method) or not inspect.isfunction(meant):
            continue
        awaited = inspect.iscoroutinefunction(meant)
        if inspect.iscoroutinefunction(inspect.unwrap(method)) != awaited:
            expected, found = f"async def {phase}", f"def {phase}"
            if inspect.isasyncgenfunction(method):
                found = f"async def {phase} with a yield in it"
            if not awaited:
                expected, found = f"def {phase}", f"async def {phase}"
            raise DeclarationError(
                f"{cls.__name__}.{phase}: expected `{expected}`, found `{found}`"
            )
