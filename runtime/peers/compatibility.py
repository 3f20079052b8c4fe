"""Whether the processes present make up the run: all nodes once, and equal files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from runtime.config.messages import show
from runtime.config.model import Config, to_builtins
from runtime.errors import PeerError
from runtime.paths import file_names
from runtime.peers.messages import Hello


def what_all_share(config: Config) -> dict[str, Any]:
    """Return a file without what may differ in each process: network, log, folders of files."""
    table: dict[str, Any] = to_builtins(config)
    types = [spec.node.config_type for spec in config.nodes]
    table["nodes"] = [file_names(*each) for each in zip(table["nodes"], types, strict=True)]
    return {
        **{key: value for key, value in table.items() if key != "network"},
        "run": {key: value for key, value in table["run"].items() if key not in {"log", "stall"}},
    }


def check_fits(mine: Hello, other: Hello, nodes: Sequence[str]) -> None:
    """Check that another process can be part of the same run.

    Raises:
        PeerError: It runs another file, or a node that runs here, or left us out.
    """
    if place := _difference(mine.config, other.config):
        where, here, there = place
        raise PeerError(
            f"expected the process at {other.place} to run the same file, found {where} = "
            f"{there} there, {here} here"
        )
    if not other.nodes or not set(other.nodes) <= set(nodes):
        raise PeerError(
            f"expected the process at {other.place} to run some of {', '.join(nodes)}, found "
            f"{', '.join(other.nodes) or 'none'}"
        )
    if twice := set(mine.nodes) & set(other.nodes):
        raise PeerError(
            f"expected each node to run in one process, found {_in_order(twice, nodes)} at "
            f"{other.place}, too"
        )
    if gone := set(mine.nodes) & set(other.left_out):
        raise PeerError(
            f"expected a run that waits for us, found that it goes on without "
            f"{_in_order(gone, nodes)}"
        )


def missing(present: Iterable[Hello], nodes: Sequence[str]) -> list[str]:
    """Return the nodes that no process has, in file order."""
    found = {node for hello in present for node in hello.nodes}
    return [node for node in nodes if node not in found]


def missing_message(absent: Sequence[str], seconds: float, meet: str) -> str:
    """Return the message for a process that waits in vain."""
    only = ",".join(absent)
    return (
        f"expected all nodes to be there within {seconds:g} s (network.wait), found none of "
        f"{', '.join(absent)} that knows our secret (network.secret) at {meet}: "
        f"start them with --only {only}"
    )


def name_of(nodes: Iterable[str]) -> str:
    """Return the name of a process: those of its nodes."""
    return ", ".join(nodes)


def _in_order(found: Iterable[str], nodes: Sequence[str]) -> str:
    found = set(found)
    return ", ".join(node for node in nodes if node in found)


def _difference(mine: Any, other: Any, where: str = "") -> tuple[str, str, str] | None:
    """Return the first place at which two tables differ, and what is there in either."""
    if isinstance(mine, Mapping) and isinstance(other, Mapping):
        for key in dict.fromkeys([*mine, *other]):
            if key not in mine or key not in other:
                inside = f"{where}.{key}".strip(".")
                return inside, *(show(t[key]) if key in t else "nothing" for t in (mine, other))  # type: ignore[return-value]
            if found := _difference(mine[key], other[key], f"{where}.{key}".strip(".")):
                return found
        return None
    if isinstance(mine, list | tuple) and isinstance(other, list | tuple):
        if len(mine) != len(other):
            return where, f"{len(mine)} entries", f"{len(other)} entries"
        for index, pair in enumerate(zip(mine, other, strict=True)):
            if found := _difference(*pair, f"{where}[{index}]"):
                return found
        return None
    return None if mine == other else (where, show(mine), show(other))
