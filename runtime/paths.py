"""Settings naming files.

A setting names what the file reads, or what its nodes write into the run's folder::

    class ReplayConfig(NodeConfig):
        recording: InputPath
        plot: OutputPath = "plot.png"

A relative path in a configuration file starts at the folder of that file, one on the command line
(``--set replay.recording=…``) at the folder in which the command runs. No two nodes of a process
may write the same file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from runtime.units import plain

Kind = Literal["input", "json", "name", "output", "secret"]
_MARK = "path"

InputPath = Annotated[str, msgspec.Meta(extra={_MARK: "input"})]
"""Path of an input file or folder; empty for none."""

NameOrPath = Annotated[str, msgspec.Meta(extra={_MARK: "name"})]
"""Name; an `InputPath` if there is a slash or a suffix such as ``.xml``."""

JsonOrPath = Annotated[str, msgspec.Meta(extra={_MARK: "json"})]
"""JSON object, beginning with ``{``; else an `InputPath`."""

Secret = Annotated[str, msgspec.Meta(extra={_MARK: "secret"})]
"""Text; an `InputPath` after the prefix ``file:``."""

OutputPath = Annotated[str, msgspec.Meta(extra={_MARK: "output"})]
"""Path in the run's folder; empty for none, or for a name derived from the node's."""


def not_utf8(path: str | Path) -> str:
    """Return why a path is of no use: libraries, JSON and TOML take UTF-8 only; empty if it is."""
    name = os.fsencode(path)
    try:
        name.decode("utf-8")
    except UnicodeDecodeError:
        return f"expected a path in UTF-8, found '{name.decode(errors='backslashreplace')}'"
    return ""


class CommandLineText(str):
    """Text from the command line; as a path, relative to the working directory."""

    __slots__ = ()


def resolve(table: Any, type_: Any, folder: Path) -> Any:
    """Return settings, as given by `tomllib`, with absolute paths of input files."""

    def absolute(kind: Kind, text: str) -> str:
        if kind == "output" or not text or (kind == "json" and text.lstrip().startswith("{")):
            return text
        if kind == "secret":
            file = type(text)(text[5:])
            return f"file:{absolute('input', file)}" if text.startswith("file:") else text
        path = Path(text)
        if kind == "name" and "/" not in text and not path.suffix:
            return text
        base = Path.cwd() if isinstance(text, CommandLineText) else folder
        return str(base / path.expanduser())

    return unmarked(_walk(table, type_, absolute))


def unmarked(value: Any) -> Any:
    """Return settings without the marks of texts from the command line."""
    if isinstance(value, dict):
        return {key: unmarked(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [unmarked(inner) for inner in value]
    return str(value) if isinstance(value, CommandLineText) else value


def file_names(table: Any, type_: Any) -> Any:
    """Return settings with input paths cut to their last part, to compare those of two machines."""
    return _walk(
        table, type_, lambda kind, text: Path(text).name if kind in {"input", "name"} else text
    )


def written(config: msgspec.Struct) -> Iterator[str]:
    """Yield the files and folders in the run's folder named by a node's settings."""
    yield from _of_kinds(config, {"output"})


def inputs(config: msgspec.Struct) -> Iterator[str]:
    """Yield the input files and folders named by a node's settings."""
    yield from _of_kinds(config, {"input", "name", "json"})


def _of_kinds(config: msgspec.Struct, kinds: Container[Kind]) -> Iterator[str]:
    texts: list[str] = []

    def collect(kind: Kind, text: str) -> str:
        if kind in kinds and text:
            texts.append(text)
        return text

    _walk(msgspec.to_builtins(config, enc_hook=plain), type(config), collect)
    yield from texts


def _walk(value: Any, type_: Any, change: Callable[[Kind, str], str]) -> Any:
    """Return a value with `change` applied to the texts marked as paths by their type."""
    for meta in getattr(type_, "__metadata__", ()):
        kind = (getattr(meta, "extra", None) or {}).get(_MARK)
        if kind is not None and isinstance(value, str):
            return change(kind, value)
    if get_origin(type_) is Annotated:
        return _walk(value, type_.__origin__, change)
    if isinstance(type_, type) and issubclass(type_, msgspec.Struct):
        if not isinstance(value, Mapping):
            return value
        types = {field.encode_name: field.type for field in msgspec.structs.fields(type_)}
        return {key: _walk(entry, types.get(key), change) for key, entry in value.items()}
    inner = [argument for argument in get_args(type_) if argument is not type(None)]
    if isinstance(value, list | tuple) and inner:
        return [_walk(entry, inner[0], change) for entry in value]
    if isinstance(value, Mapping) and get_origin(type_) is dict:
        return {key: _walk(entry, inner[1], change) for key, entry in value.items()}
    if len(inner) == 1:  # or None
        return _walk(value, inner[0], change)
    return value
