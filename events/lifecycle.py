"""Events about the run itself."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event


class Shutdown(Event):
    """Asks the run to end in order, as Ctrl-C would.

    Attributes:
        reason: Why, for the log and the summary.
    """

    category: ClassVar[Category] = Category.LIFECYCLE

    reason: str = ""


class ParameterChanged(Event):
    """A setting of a node has changed during the run.

    Its source is the node, its stamp the moment from which on the new value holds.

    Attributes:
        key: The setting, as it stands in the file: ``gain``, ``cameras.front.loss``.
        value: The new value, as TOML.
    """

    category: ClassVar[Category] = Category.LIFECYCLE

    key: str
    value: str
