"""Owners of source names: which node may send in which name."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from events import Announcement, Event
from runtime.errors import ChannelSourceError


class SourceOwners:
    """Owners of source names: each node owns its name, its announced sources, and all names below.

    A node that announces ``*`` (a replay does) may send in all names without another owner; those
    in `scripted`, scripts of tests, in any.
    """

    def __init__(self, nodes: Iterable[str], scripted: Collection[str] = ()) -> None:
        self._owners = {name: name for name in nodes}
        self._scripted = frozenset(scripted)
        self._for_others: set[str] = set()
        self._announced: set[tuple[type[Announcement], str]] = set()

    def announce(self, node: str, announcement: Announcement) -> None:
        """Register a node as the owner of an announced source, or raise `ChannelSourceError`."""
        kind, source = type(announcement), announcement.source
        if kind is Announcement and source == "*":
            self._for_others.add(node)
            return
        if node in self._scripted:
            return
        self._check(node, source, f"{kind.__name__} of {source!r}")
        self._owners.setdefault(source, node)
        if kind is not Announcement and (kind, source) in self._announced:
            raise ChannelSourceError(
                f"{node}: expected to announce each source once, found {kind.__name__} of "
                f"{source!r} twice"
            )
        self._announced.add((kind, source))

    def check(self, port: str, event: Event) -> None:
        """Raise an error if an event is sent by ``node.port`` in the name of another."""
        node = port.partition(".")[0]
        if node not in self._scripted and not (
            node in self._for_others and self.owner(event.source) is None
        ):
            self._check(port, event.source, f"{type(event).__name__} of {event.source!r}")

    def owner(self, source: str) -> str | None:
        """Return the owner of a source; `None` if there is none."""
        while source not in self._owners and "/" in source:
            source = source.rpartition("/")[0]
        return self._owners.get(source)

    def _check(self, sender: str, source: str, described: str) -> None:
        """Raise an error unless a source belongs to a sender, ``node`` or ``node.port``."""
        node = sender.partition(".")[0]
        owner = self.owner(source)
        if owner == node or (sender == node and owner is None):
            return
        whose = f"which is {owner}'s" if owner else "which nobody announces"
        raise ChannelSourceError(
            f"{sender}: expected a source that is {node!r}, below it, or announced by this node, "
            f"found {described}, {whose}"
        )
