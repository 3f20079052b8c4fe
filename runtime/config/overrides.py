"""Overrides of a configuration: ``--set NODE.KEY=VALUE``, applied to the tables of a file."""

from __future__ import annotations

import itertools
import tomllib
from typing import Any

from runtime.config.explain import show
from runtime.errors import ConfigError, expect_known, suggest
from runtime.paths import CommandLineText


def override(table: dict[str, Any], change: str) -> None:
    """Change a single setting of a table read by `tomllib`.

    Args:
        change: ``node.key=value`` or ``run.key=value``; the value in TOML, or a bare word.
            ``front.rate`` is short for ``drone.cameras.front.rate``, if nothing else has that name.

    Raises:
        ConfigError: There is no such node, or nothing to set there.
    """
    path, equals, text = change.partition("=")
    keys = path.strip().split(".")
    where = f"--set {show(change)[1:-1]}"
    if not equals or len(keys) < 2 or not all(keys):
        raise ConfigError(f"{where}: expected node.key=value or run.key=value")
    try:
        value = parse_value(text)
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    nodes = _by_name(table.get("nodes"))
    if keys[0] in {"run", "network"}:
        target = table.setdefault(keys[0], {})
    elif keys[0] in nodes:
        target = nodes[keys[0]]
    else:
        target = _part(nodes, keys[0], where)
    for before, key in itertools.pairwise(keys[:-1]):
        if isinstance(target, list):  # an entry of a list of tables, by its name
            target = _entry(target, key, f"{where}: {before}")
        elif isinstance(target, dict):
            target = target.setdefault(key, {})
    if isinstance(target, list):
        _entry(target, keys[-1], f"{where}: {keys[-2]}")
    if not isinstance(target, dict):
        raise ConfigError(
            f"{where}: {keys[-2]}: expected a table, since .{keys[-1]} follows, "
            f"found {show(target)}"
        )
    target[keys[-1]] = value


def parse_value(text: str) -> Any:
    """Return a command-line text's value in TOML, or the text; else raise `ValueError`."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return CommandLineText(text.strip())
    except ValueError:  # of Python's int()
        raise ValueError("expected a number of a usual size") from None
    except RecursionError:
        raise ValueError("expected a value, found brackets nested too deep") from None
    if len(table) > 1:
        raise ValueError("expected one setting, found more lines")
    value = table["value"]
    return CommandLineText(value) if isinstance(value, str) else value


def _part(nodes: dict[str, dict[str, Any]], name: str, where: str) -> dict[str, Any]:
    """Return the only table of this name in the lists of all nodes, such as a camera's."""
    parts = {
        f"{node}.{key}.{part}": entry
        for node, table in nodes.items()
        for key, entries in table.items()
        for part, entry in _by_name(entries).items()
    }
    matches = [path for path in parts if path.endswith(f".{name}")]
    if len(matches) == 1:
        return parts[matches[0]]
    if matches:
        raise ConfigError(f"{where}: expected one of {', '.join(matches)}; found {show(name)}")
    known = ["run", *nodes, *(path.rpartition(".")[2] for path in parts)]
    raise ConfigError(
        f"{where}: expected run or a node ({', '.join(nodes)}), found {show(name)}"
        + suggest(name, known)
    )


def _entry(entries: list[Any], name: str, where: str) -> dict[str, Any]:
    named = _by_name(entries)
    listed = ", ".join(named) or "a table with a name"
    expect_known(name, named, f"{where}: expected one of {listed}; found {show(name)}")
    return named[name]


def _by_name(entries: Any) -> dict[str, dict[str, Any]]:
    tables = [e for e in entries if isinstance(e, dict)] if isinstance(entries, list) else []
    return {str(table["name"]): table for table in tables if "name" in table}
