"""Explanations of msgspec's errors in a configuration, and types of its settings."""

from __future__ import annotations

import functools
import re
from typing import Any, Literal, get_args, get_origin

import msgspec

from runtime.errors import suggest

_LONGEST_TEXT = 300  # most characters of a text shown in a message

_NAMES = {
    "float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false",
    "array": "a list", "object": "a table",
}  # fmt: skip


def explain(message: str, value: Any, type_: type[msgspec.Struct], where: str) -> str:
    """Rewrite a message of msgspec as place, expected, found."""
    text, _, path = message.partition(" - at `$")
    path = path.rstrip("`")
    place = where + path if not where.endswith(")") or not path else f"{where}: {path[1:]}"
    if match := re.fullmatch(r"Object contains unknown field `(.*)`", text):
        known = _fields_at(type_, path)
        problem = f"found unknown key {match[1]!r}" + suggest(match[1], known)
        return f"{place}: {problem}; expected one of {', '.join(known) or 'no settings'}"
    if match := re.fullmatch(r"Object missing required field `(.*)`", text):
        return f"{place}: expected a setting {show(match[1])}, found none"
    if "found" in text:  # a check of our own, which has said it all
        return f"{place}: {text}"
    if text.startswith("Invalid enum value"):
        text = "expected " + " or ".join(_choices(_type_at(type_, path)))
    expected = re.sub(r", got .*", "", text)
    expected = re.sub(r"`([\w| ]+)`", lambda match: _translate(match[1]), expected)
    expected = re.sub(r"(\d)\.0\b", r"\1", expected)
    expected = expected.replace("matching regex '", "that matches '")
    expected = expected[0].lower() + expected[1:]
    return f"{place}: {expected}, found {show(_at(value, path))}"


def _translate(types: str) -> str:
    return " or ".join(_NAMES.get(name, name) for name in types.split(" | ") if name != "null")


def _choices(type_: Any) -> list[str]:
    if get_origin(type_) is Literal:
        return [show(value) for value in get_args(type_)]
    if get_args(type_):
        return [choice for inner in get_args(type_) for choice in _choices(inner)]
    name = getattr(type_, "__name__", "")
    return [_NAMES[name]] if name in _NAMES else []


def _at(value: Any, path: str) -> Any:
    """Return the value at a path such as ``.cameras[0].rate``."""
    for name, index in re.findall(r"\.([\w-]+)|\[(\d+)\]", path):
        try:
            value = value[name] if name else value[int(index)]
        except (KeyError, IndexError, TypeError):
            return value
    return value


def _fields_at(type_: Any, path: str) -> list[str]:
    struct = struct_in(_type_at(type_, path))
    return [] if struct is None else list(struct.__struct_encode_fields__)


def _type_at(type_: Any, path: str) -> Any:
    for name in re.findall(r"\.([\w-]+)", path):
        struct = struct_in(type_)
        type_ = None if struct is None else types_of(struct).get(name)
    return type_


@functools.cache  # reading annotations takes some tenths of a millisecond
def types_of(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the types of a struct's fields by their keys in the file."""
    return {field.encode_name: field.type for field in msgspec.structs.fields(struct)}


def struct_in(type_: Any) -> type[msgspec.Struct] | None:
    """Return the struct behind a type: the type itself, or of a list's entries."""
    while type_ is not None and not hasattr(type_, "__struct_fields__"):
        type_ = next(iter(get_args(type_)), None)
    return type_  # type: ignore[no-any-return]


def show(value: Any) -> str:
    """Format a value as in the file, on a single line, shortened."""
    if isinstance(value, str):
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in value[:_LONGEST_TEXT])
        return f'"{text}"' if len(value) <= _LONGEST_TEXT else f'"{text}..."'
    if isinstance(value, bool):
        return str(value).lower()
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
