"""``settings``: what every file may hold, whatever its nodes."""

from __future__ import annotations


def settings() -> None:
    """Describe the settings that every file may have: of the run, its network, and any node."""
    from rich.console import Console
    from rich.markup import escape
    from rich.tree import Tree

    from runtime.channels.links import LinkConfig
    from runtime.config.model import NetworkConfig, RunConfig
    from runtime.tools.cli.nodes import add_settings
    from runtime.tools.describe import NODE_SETTINGS, describe_settings, summary

    console = Console()
    for title, doc, found in (
        ("[run]", summary(RunConfig), describe_settings(RunConfig)),
        ("[network]", summary(NetworkConfig), describe_settings(NetworkConfig)),
        ("[[nodes]]", "What every node may have, beside its own settings.", NODE_SETTINGS),
        ("[nodes.links.PORT]", summary(LinkConfig), describe_settings(LinkConfig)),
    ):
        tree = Tree(f"[bold]{escape(title)}[/bold]\n{escape(doc)}")
        add_settings(tree, found)
        console.print(tree, highlight=False)
