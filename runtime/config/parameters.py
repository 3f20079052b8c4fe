"""Settings changeable during a run.

    class PilotConfig(NodeConfig):
        waypoints: tuple[Vector3, ...]
        gain: Changeable[float] = 1.0

A node finds the new value in `self.config`, and may react to it in `on_change`. Accepted are the
values that the file accepts, and nothing else. This module computes the new settings;
`runtime.tools.monitor` asks for a change, and `runtime.run.supervisor` makes it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
import tomli_w

from runtime.changeable import is_marked
from runtime.config.explain import struct_in, types_of
from runtime.config.model import without_none
from runtime.config.overrides import override
from runtime.config.reading import convert
from runtime.errors import ConfigError
from runtime.node import NodeConfig
from runtime.paths import unmarked
from runtime.units import plain


class Change(NamedTuple):
    """Change of a node's settings.

    Attributes:
        node: Its name; empty if nothing changes.
        values: Each new value, as TOML, by key: ``gain``, ``cameras.front.loss``.
    """

    node: str
    config: NodeConfig
    values: dict[str, str]


def change(configs: Mapping[str, NodeConfig], text: str) -> Change:
    """Return the change made by ``node.key=value`` to the nodes' settings.

    Args:
        text: ``node.key=value``, as for ``--set``; ``front.loss`` is short for
            ``drone.cameras.front.loss`` if nothing else has that name.

    Raises:
        ConfigError: There is no such setting, it cannot change, or not to this value.
    """
    text = text.strip()
    first = text.partition("=")[0].strip().partition(".")[0]
    if first in {"run", "network"}:
        raise ConfigError(f"{text}: expected node.key=value: what [{first}] says holds to its end")
    before = {name: _table(config) for name, config in configs.items()}
    tables = [{"name": name} | copy.deepcopy(table) for name, table in before.items()]
    try:
        override({"nodes": tables}, text)
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("--set ")) from None
    for (name, config), table in zip(configs.items(), tables, strict=True):
        if table.pop("name") != name:
            raise ConfigError(f"{text}: expected node.key=value: a node's name cannot change")
        if table != before[name]:
            return _checked(name, config, convert(unmarked(table), type(config), name))
    return Change("", NodeConfig(), {})


def changeable(type_: type[msgspec.Struct], before: str = "") -> list[str]:
    """Return the keys of the changeable settings; ``cameras.*.loss`` is every camera's."""
    keys = []
    for name, field in types_of(type_).items():
        key, inner = f"{before}{name}", struct_in(field)
        if is_marked(field):
            keys.append(key)
        elif inner is not None:
            keys += changeable(inner, f"{key}." if inner is field else f"{key}.*.")
    return keys


def _checked(name: str, before: NodeConfig, after: NodeConfig) -> Change:
    values = {}
    for path, value in _differences(_table(before), _table(after)):
        key = ".".join(path)
        if not _may_change(type(before), path):
            listed = ", ".join(changeable(type(before))) or "nothing"
            raise ConfigError(
                f"{name}.{key}: cannot change while the run goes on: of {name}, {listed} can"
            )
        values[key] = toml(value)
    return Change(name, after, values)


def toml(value: Any) -> str:
    """Format a value as TOML on a single line, as after the equals sign."""
    if isinstance(value, list):
        return f"[{', '.join(toml(entry) for entry in value)}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {toml(entry)}' for key, entry in value.items())} }}"
    return tomli_w.dumps({"v": value}).strip().removeprefix("v = ")


def _table(config: msgspec.Struct) -> dict[str, Any]:
    table: dict[str, Any] = without_none(msgspec.to_builtins(config, enc_hook=plain))
    return table


def _differences(before: Any, after: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the path of each difference between two tables, with the second's value."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*before, *after]):
            for path, value in _differences(before.get(key), after.get(key)):
                yield (key, *path), value
    elif _names(before) and _names(before) == _names(after):
        for one, other in zip(before, after, strict=True):
            for path, value in _differences(one, other):
                yield (one["name"], *path), value
    elif before != after:
        yield (), after


def _names(value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(v, dict) and "name" in v for v in value):
        return []
    return [v["name"] for v in value]


def _may_change(type_: Any, path: tuple[str, ...]) -> bool:
    struct = type_
    for name in path:
        if struct is None:
            return False
        field = types_of(struct).get(name)
        if field is None:  # the name of an entry of a list
            continue
        if is_marked(field):
            return True
        struct = struct_in(field)
    return False


def settings(config: NodeConfig) -> dict[str, str]:
    """Return the changeable settings with their values, as `Change.values`."""
    texts: dict[str, str] = {}

    def walk(type_: Any, value: Any, before: str) -> None:
        for name, field in types_of(type_).items():
            key, inner, struct = f"{before}{name}", value.get(name), struct_in(field)
            if inner is None:
                continue
            if is_marked(field):
                texts[key] = toml(inner)
            elif isinstance(inner, dict) and struct is not None:
                walk(struct, inner, f"{key}.")
            elif names := _names(inner):
                for entry_name, entry in zip(names, inner, strict=True):
                    walk(struct, entry, f"{key}.{entry_name}.")

    if changeable(type(config)):
        walk(type(config), _table(config), "")
    return texts
