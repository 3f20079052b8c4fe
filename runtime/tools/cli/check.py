"""The command ``check``: say what is wrong with a file before anything flies."""

from __future__ import annotations

import sys

from runtime.tools.cli.common import ConfigFile, Overrides, warn


def check(config: ConfigFile, overrides: Overrides = None) -> None:
    """Check a file without flying: print a line for each mistake.

    The settings are read, and the nodes are brought up to where the first update would be: worlds,
    recordings and other files are opened, cameras and vehicles announced, and every node says
    whether it finds what it needs. Checked are, among others, names of nodes, cameras, inputs and
    files; that no input is without a sender or a reader; that no two nodes write the same file;
    and that start and waypoints are in free space. Nothing is rendered, written or sent. Ends
    with 0, or with 2 if there is a mistake; what may be meant, as what lint finds, is a warning.
    """
    from runtime.config.reading import load_configuration
    from runtime.run.graph import edges
    from runtime.tools import preflight
    from runtime.tools.cli.run import leave_behind
    from runtime.tools.lint import lint

    settings = load_configuration(config, overrides or [])
    found = preflight.of_file(settings)
    if not found.errors:
        nodes = preflight.of_nodes(settings)
        odd = [] if nodes.errors else [str(e) for e in lint(settings, nodes.announcements)]
        found = preflight.Findings(nodes.errors, found.warnings + nodes.warnings + odd)
    errors = found.errors
    for warning in found.warnings:
        warn(warning)
    for error in errors:
        print(f"error: {config.name}: {error}", file=sys.stderr)
    if not errors:
        connections = edges([(spec.name, spec.node) for spec in settings.nodes])
        print(f"{config}: {len(settings.nodes)} nodes, {len(connections)} connections: right")
    leave_behind(2 if errors else 0)
