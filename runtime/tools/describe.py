"""Descriptions of nodes and settings from their declarations, for listings and reference pages.

`describe` returns the `NodeDescription` of a class: its ports, ticks and settings, with their
types, ranges, defaults and docstrings. `describe_settings` does the same for any table of a file,
such as `RunConfig`. Both are pure; what they return holds text only, and `msgspec` can encode it.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from typing import Any, Literal, get_args

import msgspec
from msgspec import inspect as types

from runtime.config.model import OnError
from runtime.config.parameters import is_marked
from runtime.config.reading import by_name_alone, presets_in
from runtime.node import Node
from runtime.run.graph import input_types
from runtime.units import Duration, Latency, plain

TYPE_DOC = "The class of the node: its name if a package lists it, else module:Class."


class PortDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A port of a node.

    Attributes:
        name: As in ``inputs`` and ``links`` of the file; ``bundle.field`` for a part of a bundle.
        kind: ``input`` and ``bundle`` are read by a coroutine, a ``handler`` is called inside the
            sender's `send`, an ``output`` sends.
        delivery: What an input may skip, or how a field of a bundle is matched; empty for others.
    """

    name: str
    kind: Literal["input", "bundle", "handler", "output"]
    events: tuple[str, ...]
    delivery: str
    doc: str


class TickDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A method called at a rate.

    Attributes:
        rate: ``400 Hz``, or the setting that holds the rate.
    """

    name: str
    rate: str
    doc: str


class SettingDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A setting of a TOML file.

    Attributes:
        type: ``float``, ``duration``, ``list of string``, ``"lockstep" or "real"``, ``table``…
        default: As in TOML; empty if it is required, or not set by default.
        constraint: The range of numbers, the lengths of lists and texts; empty if there is none.
    """

    name: str
    type: str
    default: str
    required: bool
    constraint: str
    doc: str
    changeable: bool
    settings: tuple[SettingDescription, ...] = ()


class NodeDescription(msgspec.Struct, frozen=True, kw_only=True):
    """A node from the user's point of view."""

    type: str
    doc: str
    inputs: tuple[PortDescription, ...]
    outputs: tuple[PortDescription, ...]
    ticks: tuple[TickDescription, ...]
    settings: tuple[SettingDescription, ...]


def describe(cls: type[Node[Any]], type_name: str = "") -> NodeDescription:
    """Describe a class of node; files name it by `type_name`, or ``module:Class``."""
    declared, docs = cls.declared, attribute_docs(cls)
    inputs = tuple(_inputs(cls, docs))
    outputs = tuple(
        PortDescription(
            name=name,
            kind="output",
            events=(output.event.__name__,),
            delivery="",
            doc=docs.get(name) or summary(output.event),
        )
        for name, output in declared.outputs.items()
    )
    ticks = tuple(
        TickDescription(
            name=name,
            rate=f"the setting {t.hz}" if isinstance(t.hz, str) else f"{t.hz:g} Hz",
            doc=summary(getattr(cls, name)),
        )
        for name, t in declared.ticks.items()
    )
    return NodeDescription(
        type=type_name or f"{cls.__module__}:{cls.__name__}",
        doc=inspect.getdoc(cls) or "",
        inputs=inputs,
        outputs=outputs,
        ticks=ticks,
        settings=describe_settings(cls.config_type),
    )


def describe_settings(table: type[msgspec.Struct]) -> tuple[SettingDescription, ...]:
    """Describe the settings of a table of the file, including nested tables."""
    docs = attribute_docs(table)
    found = []
    for field in msgspec.structs.fields(table):
        info = types.type_info(field.type)
        inner = next(_structs(info), None)
        found.append(
            SettingDescription(
                name=field.encode_name,
                type=_type(info),
                default="" if inner else _default(field),
                required=field.required,
                constraint=_constraint(info),
                doc=docs.get(field.name, ""),
                changeable=is_marked(field.type),
                settings=describe_settings(inner) if inner and inner is not table else (),
            )
        )
    return tuple(found)


def summary(described: type | Callable[..., Any]) -> str:
    """Return the first paragraph of a docstring as a single line."""
    return " ".join((inspect.getdoc(described) or "").split("\n\n")[0].split())


def attribute_docs(cls: type) -> dict[str, str]:
    """Return the docstring text of each attribute of a class and its bases, as a line."""
    found: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        section = inspect.cleandoc(each.__doc__ or "").partition("Attributes:\n")[2]
        section = re.split(r"\n(?=\S)", section)[0]
        for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*|\n)*)", section, re.MULTILINE):
            found[name] = " ".join(text.split())
    return found


def _head(name: str, type_: str, doc: str, default: str = "") -> SettingDescription:
    return SettingDescription(
        name=name, type=type_, doc=doc, default=default, required=name in {"name", "type"},
        constraint="", changeable=False,
    )  # fmt: skip


NODE_SETTINGS = (
    _head("name", "string", "Letters, digits, _ and -, unique in the file; events bear it."),
    _head("type", "string", TYPE_DOC),
    _head(
        "on_error",
        " or ".join(json.dumps(each) for each in get_args(OnError)),
        "What an exception in the node does: end the run, bring the node up again (after a "
        "growing pause), or go on without it.",
        '"stop"',
    ),
    _head(
        "inputs",
        "table of string",
        "A port, handler or bundle to the one source that it is to listen to: a node, or a node "
        "and what of it (drone/front).",
    ),
    _head("links", "table of table", "A port, handler or bundle to what delays events to it."),
)
"""Settings of every ``[[nodes]]`` table, beside the node's own."""


def _inputs(cls: type[Node[Any]], docs: dict[str, str]) -> Iterator[PortDescription]:
    declared = cls.declared
    for name, events in input_types(cls).items():
        bundle, _, part = name.partition(".")
        kind: Literal["input", "bundle", "handler"]
        if name in declared.handlers:
            kind, delivery, doc = "handler", "", summary(getattr(cls, name))
        elif part:
            how = {"one": "required", "maybe": "optional", "all": "all since the last set"}
            kind, delivery = "bundle", how[declared.bundles[bundle].fields[part].kind]
            doc = docs.get(name) or docs.get(bundle, "")
        else:
            port = declared.inputs[name]
            kind, delivery = "input", _delivery(port.bound, port.overflow, port.keep)
            doc = docs.get(name, "")
        yield PortDescription(
            name=name,
            kind=kind,
            events=tuple(event.__name__ for event in events),
            delivery=delivery,
            doc=doc or summary(events[0]),
        )


def _delivery(bound: int, overflow: str, keep: str) -> str:
    if keep == "latest":
        return "only the newest is kept"
    beyond = {"error": "more is an error", "drop_oldest": "the oldest goes", "wait": "senders wait"}
    return f"up to {bound:,} wait; {beyond[overflow]}"


def _structs(info: types.Type) -> Iterator[type[msgspec.Struct]]:
    match info:
        case types.StructType():
            yield info.cls
        case types.Metadata():
            yield from _structs(info.type)
        case types.UnionType():
            for each in info.types:
                yield from _structs(each)
        case types.ListType() | types.VarTupleType():
            yield from _structs(info.item_type)
        case types.TupleType():
            for each in info.item_types:
                yield from _structs(each)
        case types.DictType():
            yield from _structs(info.value_type)


def _default(field: Any) -> str:
    """Return a default as in TOML; JSON writes such values in the same way."""
    if field.required:
        return ""
    default = field.default
    if default is msgspec.NODEFAULT:
        default = field.default_factory()
    if default is None:
        return ""
    return json.dumps(msgspec.to_builtins(default, enc_hook=plain), ensure_ascii=False)


def _type(info: types.Type) -> str:
    match info:
        case types.Metadata():
            names = presets_in(info.extra)
            return " or ".join(map(json.dumps, names)) if names else _type(info.type)
        case types.StructType():
            return "table or the name of a preset" if by_name_alone(info.cls) else "table"
        case types.CustomType() if issubclass(info.cls, Duration):
            return "duration"
        case types.UnionType():
            kinds = [_type(t) for t in info.types if not isinstance(t, types.NoneType)]
            return " or ".join(dict.fromkeys(kinds))
        case types.LiteralType():
            return " or ".join(json.dumps(value) for value in info.values)
        case types.TupleType():
            items = [_type(each) for each in info.item_types]
            same = len(set(items)) == 1
            return f"list of {len(items)} {items[0]}" if same else f"list of {', '.join(items)}"
        case types.ListType() | types.VarTupleType() | types.FrozenSetType() | types.SetType():
            return f"list of {_type(info.item_type)}"
        case types.DictType():
            return f"table of {_type(info.value_type)}"
        case types.StrType():
            return "string"
        case types.BoolType():
            return "true or false"
        case types.IntType():
            return "integer"
        case types.FloatType():
            return "float"
    return type(info).__name__.removesuffix("Type").lower()


_RANGES = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<", "multiple_of": "multiple of"}
_LENGTHS = {"min_length": "at least", "max_length": "at most"}


def _constraint(info: types.Type) -> str:
    match info:
        case types.Metadata():
            return _constraint(info.type)
        case types.UnionType():
            return "; ".join(filter(None, map(_constraint, info.types)))
        case types.CustomType() if issubclass(info.cls, Duration):
            unit = "; above 1 s with a unit" if issubclass(info.cls, Latency) else ""
            return f"≥ 0 s{unit}"
    found = [
        f"{sign} {value:g}"
        for name, sign in _RANGES.items()
        if (value := getattr(info, name, None)) is not None
    ]
    of = "characters" if isinstance(info, types.StrType) else "items"
    found += [
        f"{words} {value} {of}"
        for name, words in _LENGTHS.items()
        if (value := getattr(info, name, None)) is not None
    ]
    if pattern := getattr(info, "pattern", None):
        found.append(f"matches {pattern}")
    if isinstance(info, types.ListType | types.VarTupleType):
        each = _constraint(info.item_type)
        found += [f"each {each}"] if each else []
    elif isinstance(info, types.TupleType):
        each = "; ".join(dict.fromkeys(filter(None, map(_constraint, info.item_types))))
        found += [f"each {each}"] if each else []
    return ", ".join(found)
