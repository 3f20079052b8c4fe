"""A JSON schema of configuration files, for editors to complete and check TOML.

    #:schema https://…/config.schema.json     # or a path: the first line of a file

It is made from what the runtime itself reads: the types of `[run]`, `[network]` and links, and
each listed node's settings and ports. What only a run can tell (whether a file is there, whether
a camera is announced) is in no schema; ``python -m runtime check`` says that.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import msgspec
from msgspec import inspect as types

from runtime.channels.links import LinkConfig
from runtime.config.model import NetworkConfig, OnError, RunConfig
from runtime.config.parameters import is_marked
from runtime.config.reading import by_name_alone, presets_in
from runtime.node import Node
from runtime.tools.describe import TYPE_DOC, attribute_docs, summary
from runtime.units import Duration, plain

Schema = dict[str, Any]

_NAME = {"type": "string", "pattern": r"^[A-Za-z_][\w-]*$", "not": {"enum": ["run", "network"]}}
_TYPE = {"type": "string", "pattern": r"^\w+(\.\w+)*:\w+$"}
_DURATION = r"^\s*[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?\s*([nuµμm]?s|min|h)\s*$"
_BOUNDS = {
    "ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum",
    "multiple_of": "multipleOf", "min_length": "min", "max_length": "max", "pattern": "pattern",
}  # fmt: skip


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
        "properties": {**_head(), "type": {"anyOf": [{"enum": list(nodes)}, _TYPE]}},
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


def _head() -> Schema:
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
        own = self._properties(cls.config_type)
        ports = [*cls.declared.listening, *cls.declared.bundle_fields()]
        link = self.struct(LinkConfig)
        head = _head()
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
            **own,
            "description": summary(cls),
            "properties": {**head, **own["properties"]},
            "required": ["name", "type", *own.get("required", [])],
        }
        return key

    def struct(self, cls: type[msgspec.Struct]) -> Schema:
        """Define a struct; return its reference."""
        key = f"{cls.__module__}.{cls.__name__}"
        if key not in self.definitions:
            self.definitions[key] = {}  # it may hold itself
            self.definitions[key] = {"description": summary(cls), **self._properties(cls)}
        return {"$ref": f"#/$defs/{key}"}

    def _properties(self, cls: type[msgspec.Struct]) -> Schema:
        documented = attribute_docs(cls)
        properties, required = {}, []
        for field in msgspec.structs.fields(cls):
            found = self._of(types.type_info(field.type))
            text = documented.get(field.name, "")
            if is_marked(field.type):
                text = f"{text} It can be changed in a run.".strip()
            if field.required:
                required.append(field.encode_name)
            elif _may_stand(field.default):
                default = msgspec.to_builtins(field.default, enc_hook=plain)
                found = _beside(found, "default", default)
            properties[field.encode_name] = _beside(found, "description", text) if text else found
        made: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
        return made | ({"required": required} if required else {})

    def _of(self, info: types.Type) -> Schema:
        match info:
            case types.Metadata():
                names = list(presets_in(info.extra))
                return {"enum": names} if names else self._of(info.type)
            case types.StructType():
                names, table = by_name_alone(info.cls), self.struct(info.cls)
                return {"anyOf": [{"enum": names}, table]} if names else table
            case types.CustomType() if issubclass(info.cls, Duration):
                return {"anyOf": [{"type": "number", "minimum": 0}, _text(_DURATION)]}
            case types.UnionType():
                kinds = [self._of(t) for t in info.types if not isinstance(t, types.NoneType)]
                return kinds[0] if len(kinds) == 1 else {"anyOf": kinds}
            case types.LiteralType():
                return {"enum": list(info.values)}
            case types.TupleType():
                items = [self._of(each) for each in info.item_types]
                return {
                    "type": "array", "items": items, "minItems": len(items),
                    "maxItems": len(items),
                }  # fmt: skip
            case types.ListType() | types.VarTupleType() | types.FrozenSetType() | types.SetType():
                return {"type": "array", "items": self._of(info.item_type)} | _bounds(info, "Items")
            case types.DictType():
                return {"type": "object", "additionalProperties": self._of(info.value_type)}
            case types.StrType():
                return {"type": "string"} | _bounds(info, "Length")
            case types.BoolType():
                return {"type": "boolean"}
            case types.IntType():
                return {"type": "integer"} | _bounds(info)
            case types.FloatType():
                return {"type": "number"} | _bounds(info)
        raise TypeError(f"expected a type that a setting may have, found {info}")


def _text(pattern: str) -> Schema:
    return {"type": "string", "pattern": pattern}


def _beside(found: Schema, key: str, value: Any) -> Schema:
    """Add a key; references go into ``allOf``: draft 7 ignores all keys beside them."""
    return {"allOf": [found], key: value} if "$ref" in found else {**found, key: value}


def _bounds(info: Any, of: Literal["", "Items", "Length"] = "") -> Schema:
    found = {name: getattr(info, name, None) for name in _BOUNDS}
    return {
        _BOUNDS[name] + (of if name.endswith("_length") else ""): value
        for name, value in found.items()
        if value is not None
    }


def _may_stand(default: Any) -> bool:
    """Tell whether a default may stand in a file; a table's are those of its settings."""
    return default not in (None, msgspec.NODEFAULT) and not isinstance(default, msgspec.Struct)
