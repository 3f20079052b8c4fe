"""Descriptions of nodes and settings from their declarations, for listings, pages and editors.

`describe` returns the `NodeDescription` of a class: its ports, ticks and settings, with their
types, ranges, defaults and docstrings. `describe_settings` does the same for any table of a file,
such as `RunConfig`. Both are pure; what they return holds text only, and `msgspec` can encode it.

`schema` returns a JSON schema of configuration files, for editors to complete and check TOML:

    #:schema https://…/config.schema.json     # or a path: the first line of a file

What only a run can tell (whether a file is there, whether a camera is announced) is in no schema;
``python -m runtime check`` says that.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple, get_args

import msgspec
from msgspec import inspect as types

from runtime.changeable import is_marked
from runtime.channels.links import LinkConfig
from runtime.config.model import NetworkConfig, OnError, RunConfig
from runtime.config.reading import by_name_alone, presets_in
from runtime.node import Node
from runtime.run.graph import input_types
from runtime.units import Duration, Latency, plain

Schema = dict[str, Any]

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
    settings = []
    for field in msgspec.structs.fields(table):
        kind = kind_of(types.type_info(field.type))
        inner = next(iter(kind.tables), None)
        settings.append(
            SettingDescription(
                name=field.encode_name,
                type=kind.text,
                default="" if inner else _default(field),
                required=field.required,
                constraint=kind.constraint,
                doc=docs.get(field.name, ""),
                changeable=is_marked(field.type),
                settings=describe_settings(inner) if inner and inner is not table else (),
            )
        )
    return tuple(settings)


def summary(described: type | Callable[..., Any]) -> str:
    """Return the first paragraph of a docstring as a single line."""
    return " ".join((inspect.getdoc(described) or "").split("\n\n")[0].split())


def attribute_docs(cls: type) -> dict[str, str]:
    """Return the docstring text of each attribute of a class and its bases, as a line."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        section = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")[2]
        section = re.split(r"\n(?=\S)", section)[0]
        for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*|\n)*)", section, re.MULTILINE):
            docs[name] = " ".join(text.split())
    return docs


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
        " or ".join(json.dumps(choice) for choice in get_args(OnError)),
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
    effect = {"error": "more is an error", "drop_oldest": "the oldest goes", "wait": "senders wait"}
    return f"up to {bound:,} wait; {effect[overflow]}"


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


class Kind(NamedTuple):
    """Type of a setting.

    Attributes:
        text: In words: ``list of 2 float``.
        constraint: Its range in words.
        schema: As a JSON schema.
        tables: The settings classes in it.
    """

    text: str
    constraint: str
    schema: Schema
    tables: tuple[type[msgspec.Struct], ...] = ()


_PLAIN = {
    types.StrType: ("string", "string"),
    types.BoolType: ("true or false", "boolean"),
    types.IntType: ("integer", "integer"),
    types.FloatType: ("float", "number"),
}
"""Types without parts, in words and in a schema."""

_DURATION = r"^\s*[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?\s*([nuµμm]?s|min|h)\s*$"


def kind_of(info: types.Type) -> Kind:
    """Return the kind of a type that a setting may have; of any other, its name."""
    match info:
        case types.Metadata():
            kind, presets = kind_of(info.type), [*presets_in(info.extra)]
            return kind._replace(text=_any(presets), schema={"enum": presets}) if presets else kind
        case types.StructType():
            table = {"$ref": f"#/$defs/{_key(info.cls)}"}
            if names := by_name_alone(info.cls):
                either = {"anyOf": [{"enum": names}, table]}
                return Kind("table or the name of a preset", "", either, (info.cls,))
            return Kind("table", "", table, (info.cls,))
        case types.CustomType() if issubclass(info.cls, Duration):
            unit = "; above 1 s with a unit" if issubclass(info.cls, Latency) else ""
            written = [{"type": "number", "minimum": 0}, {"type": "string", "pattern": _DURATION}]
            return Kind("duration", f"≥ 0 s{unit}", {"anyOf": written})
        case types.LiteralType():
            return Kind(_any(info.values), "", {"enum": list(info.values)})
        case types.UnionType():
            kinds = [kind_of(t) for t in info.types if not isinstance(t, types.NoneType)]
            schemas = [kind.schema for kind in kinds]
            return Kind(
                " or ".join(dict.fromkeys(kind.text for kind in kinds)),
                "; ".join(kind.constraint for kind in kinds if kind.constraint),
                schemas[0] if len(schemas) == 1 else {"anyOf": schemas},
                tuple(table for kind in kinds for table in kind.tables),
            )
        case types.TupleType():
            kinds = [kind_of(t) for t in info.item_types]
            texts = [kind.text for kind in kinds]
            limit = "; ".join(dict.fromkeys(kind.constraint for kind in kinds if kind.constraint))
            number = len(kinds)
            return Kind(
                f"list of {f'{number} {texts[0]}' if len({*texts}) == 1 else ', '.join(texts)}",
                f"each {limit}" if limit else "",
                {
                    "type": "array", "items": [kind.schema for kind in kinds],
                    "minItems": number, "maxItems": number,
                },
                tuple(table for kind in kinds for table in kind.tables),
            )  # fmt: skip
        case types.ListType() | types.VarTupleType() | types.FrozenSetType() | types.SetType():
            item, (words, bounds) = kind_of(info.item_type), _bounds(info, "Items", "items")
            words += [f"each {item.constraint}"] if item.constraint else []
            items = {"type": "array", "items": item.schema, **bounds}
            return Kind(f"list of {item.text}", ", ".join(words), items, item.tables)
        case types.DictType():
            value = kind_of(info.value_type)
            words, _ = _bounds(info, "Properties", "items")
            values = {"type": "object", "additionalProperties": value.schema}
            return Kind(f"table of {value.text}", ", ".join(words), values, value.tables)
    text, name = _PLAIN.get(type(info), (type(info).__name__.removesuffix("Type").lower(), ""))
    words, bounds = _bounds(info, "Length", "characters")
    return Kind(text, ", ".join(words), {"type": name} | bounds if name else {})


def _any(values: Iterable[Any]) -> str:
    return " or ".join(map(json.dumps, values))


def _key(cls: type[msgspec.Struct]) -> str:
    return f"{cls.__module__}.{cls.__name__}"


_BOUNDS = {
    "ge": ("≥", "minimum"), "gt": (">", "exclusiveMinimum"), "le": ("≤", "maximum"),
    "lt": ("<", "exclusiveMaximum"), "multiple_of": ("multiple of", "multipleOf"),
    "min_length": ("at least", "min"), "max_length": ("at most", "max"),
    "pattern": ("matches", "pattern"),
}  # fmt: skip
"""Bounds of msgspec's, in words and in a schema."""


def _bounds(info: types.Type, noun: str, unit: str) -> tuple[list[str], Schema]:
    """Return the bounds of a type in words and in a schema, for lengths with what they count."""
    texts: list[str] = []
    bounds: Schema = {}
    for name, (sign, key) in _BOUNDS.items():
        value = getattr(info, name, None)
        if value is None:
            continue
        if name.endswith("_length"):
            texts.append(f"{sign} {value} {unit}")
            bounds[key + noun] = value
        else:
            texts.append(f"{sign} {value}" if name == "pattern" else f"{sign} {value:g}")
            bounds[key] = value
    return texts, bounds


_NAME = {"type": "string", "pattern": r"^[A-Za-z_][\w-]*$", "not": {"enum": ["run", "network"]}}
_TYPE = {"type": "string", "pattern": r"^\w+(\.\w+)*:\w+$"}


def schema(nodes: Mapping[str, type[Node[Any]]]) -> Schema:
    """Return the schema of a configuration file, with settings of these nodes, by name.

    Those of nodes that a file names as ``module:Class`` may be any.
    """
    maker = _Maker()
    by_type = [
        {
            "if": {"properties": {"type": {"const": name}}, "required": ["type"]},
            "then": {"$ref": f"#/$defs/{maker.node(name, cls)}"},
        }
        for name, cls in nodes.items()
    ]
    entry = {
        "type": "object",
        "required": ["name", "type"],
        "properties": {**_schema_head(), "type": {"anyOf": [{"enum": list(nodes)}, _TYPE]}},
        "allOf": by_type,
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "A run of visnav-runtime",
        "type": "object",
        "additionalProperties": False,
        "required": ["nodes"],
        "properties": {
            "run": maker.struct(RunConfig),
            "network": maker.struct(NetworkConfig),
            "nodes": {"type": "array", "minItems": 1, "items": entry},
        },
        "$defs": dict(sorted(maker.definitions.items())),
    }


def _schema_head() -> Schema:
    return {
        "name": {**_NAME, "description": "Unique in the file."},
        "type": {"type": "string", "description": TYPE_DOC},
        "on_error": {
            "enum": list(get_args(OnError)),
            "default": "stop",
            "description": "What an exception in the node does to the run.",
        },
        "inputs": {"type": "object", "additionalProperties": {"type": "string"}},
        "links": {"type": "object"},
    }


class _Maker:
    def __init__(self) -> None:
        self.definitions: dict[str, Schema] = {}

    def node(self, name: str, cls: type[Node[Any]]) -> str:
        """Define the table of a node; return the name of the definition."""
        key = name.replace(":", ".")
        settings = self._properties(cls.config_type)
        ports = [*cls.declared.listening, *cls.declared.bundle_fields()]
        link = self.struct(LinkConfig)
        head = _schema_head()
        head["inputs"] = {
            "type": "object",
            "description": "A port to the source to which it is narrowed.",
            "properties": {port: {"type": "string"} for port in ports},
            "additionalProperties": False,
        }
        head["links"] = {
            "type": "object",
            "description": "A port to what the way there does to events.",
            "properties": dict.fromkeys(ports, link),
            "additionalProperties": False,
        }
        self.definitions[key] = {
            **settings,
            "description": summary(cls),
            "properties": {**head, **settings["properties"]},
            "required": ["name", "type", *settings.get("required", [])],
        }
        return key

    def struct(self, cls: type[msgspec.Struct]) -> Schema:
        """Define a struct; return its reference."""
        key = _key(cls)
        if key not in self.definitions:
            self.definitions[key] = {}  # it may hold itself
            self.definitions[key] = {"description": summary(cls), **self._properties(cls)}
        return {"$ref": f"#/$defs/{key}"}

    def _properties(self, cls: type[msgspec.Struct]) -> Schema:
        documented = attribute_docs(cls)
        properties, required = {}, []
        for field in msgspec.structs.fields(cls):
            kind = kind_of(types.type_info(field.type))
            schema = kind.schema
            for table in kind.tables:
                self.struct(table)
            text = documented.get(field.name, "")
            if is_marked(field.type):
                text = f"{text} It can be changed in a run.".strip()
            if field.required:
                required.append(field.encode_name)
            elif _may_stand(field.default):
                default = msgspec.to_builtins(field.default, enc_hook=plain)
                schema = _beside(schema, "default", default)
            properties[field.encode_name] = _beside(schema, "description", text) if text else schema
        made: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
        return made | ({"required": required} if required else {})


def _beside(schema: Schema, key: str, value: Any) -> Schema:
    """Add a key; references go into ``allOf``: draft 7 ignores all keys beside them."""
    return {"allOf": [schema], key: value} if "$ref" in schema else {**schema, key: value}


def _may_stand(default: Any) -> bool:
    """Return whether a default may stand in a file; a table's are those of its settings."""
    return default not in (None, msgspec.NODEFAULT) and not isinstance(default, msgspec.Struct)
