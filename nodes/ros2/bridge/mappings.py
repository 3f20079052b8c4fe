"""Imports what a file names: mappings of the user's own, and the events that they are of."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from typing import Any

from events import Event
from nodes.ros2.bridge.settings import OwnPublication


def import_mapping(topic: str, path: str) -> Callable[[Any, Any], Any]:
    """Return a function.

    Args:
        topic: Of whose messages it is, for errors.
        path: ``module:function``.

    Raises:
        ValueError: It cannot be imported, or is no function.
    """
    found = _imported(topic, "mapping", path)
    if not callable(found):
        raise ValueError(f"{topic}: mapping: expected a function, found {found!r}")
    function: Callable[[Any, Any], Any] = found
    return function


def event_type(publication: OwnPublication) -> type[Event]:
    """Return the type of the events that a publication is of.

    Raises:
        ValueError: It cannot be imported, or is no event's.
    """
    found = _imported(publication.topic, "event", publication.event)
    if not (isinstance(found, type) and issubclass(found, Event)):
        raise ValueError(f"{publication.topic}: event: expected a type of event, found {found!r}")
    return found


def _imported(topic: str, setting: str, path: str) -> Any:
    try:
        return pkgutil.resolve_name(path)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"{topic}: {setting}: expected something that can be imported, found {path!r}: {error}"
        ) from None
