"""Which events of a recording are sent again: by type, and by source."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from events import (
    Announcement,
    Category,
    EstimatorAnnouncement,
    Event,
    PoseEstimate,
)

USUAL = Category.SENSOR | Category.GEOMETRY | Category.VEHICLE
"""What a simulator says, and nobody else should."""


class Choice:
    """Tells which events are wanted; see `nodes.data.replay.settings` for the rules.

    Args:
        only: Types and sources; if there are any, an event must be of one of the types and from
            one of the sources named. If there are none, it must be of the usual categories, and
            not from an estimator.
        skip: Types and sources that are never wanted.
        announcements: Of the recording.
    """

    def __init__(
        self,
        only: Sequence[str] = (),
        skip: Sequence[str] = (),
        announcements: Iterable[Announcement] = (),
    ) -> None:
        types = {each.__name__ for each in _types(Event)}
        self._types = [name for name in only if name in types]
        self._sources = [name for name in only if name not in types]
        self._skip = list(skip)
        self._estimators = {
            each.source for each in announcements if isinstance(each, EstimatorAnnouncement)
        }
        self._known: dict[tuple[type[Event], str], bool] = {}
        self.unmatched = {*only, *skip}
        """What was named, and is of no event so far."""

    def __call__(self, kind: type[Event], source: str) -> bool:
        """Tell whether events of a type from a source are wanted."""
        key = kind, source
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = self._wants(kind, source)
        return known

    def announced(self, announcement: Announcement) -> bool:
        """Tell whether an announcement is to be made again: all are but those of no use."""
        if any(self._matches(name, type(announcement), announcement.source) for name in self._skip):
            return False
        if isinstance(announcement, EstimatorAnnouncement):
            return self(PoseEstimate, announcement.source)
        return True

    def _wants(self, kind: type[Event], source: str) -> bool:
        # All are looked at, so that `unmatched` is right.
        skipped = [self._matches(name, kind, source) for name in self._skip]
        of_type = [self._matches(name, kind, source) for name in self._types]
        of_source = [self._matches(name, kind, source) for name in self._sources]
        if any(skipped):
            return False
        if of_type or of_source:
            return (any(of_type) or not of_type) and (any(of_source) or not of_source)
        return bool(kind.category & USUAL) and source not in self._estimators

    def _matches(self, name: str, kind: type[Event], source: str) -> bool:
        found = (
            name in {base.__name__ for base in kind.__mro__}
            or source == name
            or source.startswith(f"{name}/")
        )
        if found:
            self.unmatched.discard(name)
        return found


def _types(cls: type[Event]) -> list[type[Event]]:
    return [cls, *(found for each in cls.__subclasses__() for found in _types(each))]
