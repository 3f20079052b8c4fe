"""Events of a window and its keyboard, and the names of keys in these events."""

from __future__ import annotations

import string

from events.base import Category, Event


class KeyPressed(Event, category=Category.INPUT):
    """A key went down. Held keys are not repeated.

    Attributes:
        key: Name in lower case: ``w``, ``7``, ``space``, ``left``, ``page_up``, ``left_shift``.
    """

    key: str


class KeyReleased(Event, category=Category.INPUT):
    """A key came up.

    Attributes:
        key: Name, as in `KeyPressed`.
    """

    key: str


class WindowClosed(Event, category=Category.WINDOW):
    """The user closed a window; the run ends in order."""


class WindowResized(Event, category=Category.WINDOW):
    """A window has a new size.

    Attributes:
        width: Pixels.
        height: Pixels.
    """

    width: int
    height: int


LABELS = {letter: letter for letter in string.ascii_lowercase} | {
    "'": "apostrophe",
    ",": "comma",
    "-": "minus",
    ".": "period",
    "/": "slash",
    ";": "semicolon",
    "=": "equal",
    "[": "left_bracket",
    "\\": "backslash",
    "]": "right_bracket",
    "`": "grave_accent",
}
"""Names of the keys identified by their label in the user's keyboard layout."""

_BY_POSITION = """
    escape enter tab space backspace insert delete right left down up page_up page_down home end
    caps_lock scroll_lock num_lock print_screen pause menu world_1 world_2
    left_shift left_control left_alt left_super right_shift right_control right_alt right_super
    kp_decimal kp_divide kp_multiply kp_subtract kp_add kp_enter kp_equal
"""

KEYS = frozenset(
    [*LABELS.values(), *string.digits, *_BY_POSITION.split()]
    + [f"kp_{n}" for n in range(10)]
    + [f"f{n}" for n in range(1, 26)]
)
"""Names of all keys. Any other key of a keyboard is called ``scancode_`` and a number."""
