"""The command ``check``: find mistakes in a file without running it."""

from __future__ import annotations

from runtime.cli.common import ConfigFile, Overrides


def check(config: ConfigFile, overrides: Overrides = None) -> None:
    """Read a file and its nodes, and say what is wrong with it, without running anything."""
    from runtime.cli.run import warn_unconnected
    from runtime.config import load
    from runtime.graph import edges

    settings = load(config, overrides or [])
    warn_unconnected(settings)
    connections = edges([(spec.name, spec.node) for spec in settings.nodes])
    print(f"{config}: {len(settings.nodes)} nodes, {len(connections)} connections: right")
