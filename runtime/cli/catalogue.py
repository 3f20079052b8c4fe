"""Finding the nodes that come with the project, by importing `sims` and `nodes`."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from runtime.errors import MissingDependencyError
from runtime.node import Node


def find_nodes() -> dict[str, type[Node[Any]]]:
    """Return ``module:Class`` to class, for all nodes that can be imported here."""
    found: dict[str, type[Node[Any]]] = {}
    for room in ("sims", "nodes"):
        package = importlib.import_module(room)
        for module in pkgutil.walk_packages(package.__path__, f"{room}."):
            try:
                contents = vars(importlib.import_module(module.name))
            except (ImportError, MissingDependencyError):  # an extra that is not installed
                continue
            for name, value in contents.items():
                if (
                    isinstance(value, type)
                    and issubclass(value, Node)
                    and value.__module__ == module.name
                    and not name.startswith("_")
                ):
                    found[f"{module.name}:{name}"] = value
    return dict(sorted(found.items()))
