"""Events from a window and its keyboard."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event


class KeyPressed(Event):
    """A key went down. Held keys are not repeated.

    Attributes:
        key: Name in lower case: ``w``, ``7``, ``space``, ``left``, ``page_up``, ``left_shift``.
    """

    category: ClassVar[Category] = Category.INPUT

    key: str


class KeyReleased(Event):
    """A key came up.

    Attributes:
        key: Name, as in `KeyPressed`.
    """

    category: ClassVar[Category] = Category.INPUT

    key: str


class WindowClosed(Event):
    """The user closed a window; the run ends in order."""

    category: ClassVar[Category] = Category.WINDOW


class WindowResized(Event):
    """A window has a new size.

    Attributes:
        width: Pixels.
        height: Pixels.
    """

    category: ClassVar[Category] = Category.WINDOW

    width: int
    height: int
