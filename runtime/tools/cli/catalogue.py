"""Finding the nodes that come with the project, by importing `sims` and `nodes`."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from runtime.config.reading import is_base
from runtime.errors import MissingDependencyError
from runtime.node import Node


def find_nodes() -> dict[str, type[Node[Any]]]:
    """Return ``module:Class`` to class, for all nodes that can be imported here.

    A node that a package offers as its own goes by the package's name.
    """
    found: dict[type[Node[Any]], str] = {}
    for room in ("sims", "nodes"):
        package = importlib.import_module(room)
        for module in pkgutil.walk_packages(package.__path__, f"{room}."):
            try:
                contents = vars(importlib.import_module(module.name))
            except (ImportError, MissingDependencyError):  # an extra that is not installed
                continue
            for name, value in contents.items():
                if _is_node(value) and f"{value.__module__}.".startswith(f"{module.name}."):
                    found.setdefault(value, f"{module.name}:{name}")
    return dict(sorted((name, value) for value, name in found.items()))


def _is_node(value: Any) -> bool:
    """Tell whether something is a class of node to be named in a file: no base of others."""
    return (
        isinstance(value, type)
        and issubclass(value, Node)
        and not is_base(value)
        and not value.__name__.startswith("_")
    )
