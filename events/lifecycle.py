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
