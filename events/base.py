"""Base class of all events, events of a run, its windows and keys, and checks of every event.

An event is frozen data with a stamp, a source and a category. A stamp is an `int`; vectors, angles
and the like are finite; an orientation is a unit quaternion. A wrong value raises in the node that
makes the event, and the error names the field: no receiver ever sees it.
"""

from __future__ import annotations

import enum
import string
from math import hypot, inf, isfinite
from typing import Any, ClassVar, dataclass_transform

import msgspec
import numpy as np

Vector3 = tuple[float, float, float]
"""Vector x, y, z; unit and frame are given at each field of this type."""

Quaternion = tuple[float, float, float, float]
"""Unit quaternion **w, x, y, z** (Hamilton); rotates child-frame vectors into the parent frame."""


class Category(enum.Flag):
    """Subject of an event; for filtering and logging, never for routing."""

    LIFECYCLE = enum.auto()
    WINDOW = enum.auto()
    INPUT = enum.auto()
    GEOMETRY = enum.auto()
    SENSOR = enum.auto()
    CONTROL = enum.auto()
    VEHICLE = enum.auto()
    ESTIMATE = enum.auto()
    MAP = enum.auto()
    SCORE = enum.auto()
    ANNOUNCEMENT = enum.auto()
    USER = enum.auto()


class EventMeta(msgspec.StructMeta):
    """Makes every subclass of `Event` frozen and keyword-only without its having to say so."""

    def __new__(
        cls,
        name: str,
        bases: tuple[type, ...],
        namespace: dict[str, Any],
        category: Category | None = None,
        **options: Any,
    ) -> EventMeta:
        """Create the class; msgspec inherits neither option to subclasses in the way we need."""
        if category is not None:
            namespace["category"] = category
        options = {"frozen": True, "kw_only": True, "gc": False} | options
        return super().__new__(cls, name, bases, namespace, **options)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(msgspec.field,))
class Event(msgspec.Struct, metaclass=EventMeta, frozen=True, kw_only=True):
    """Typed data sent by a node to all its listeners.

    Subclass it to add fields; every subclass is frozen and takes keyword arguments only. It has the
    category of its base, or its own: ``class Fog(Event, category=Category.SENSOR)``.

    Attributes:
        stamp: Time of the described state, nanoseconds on the run's clock (the exposure of an
            image, not its arrival). An `int`: no bool, float or numpy number.
        source: Name of the sender, as a path: ``drone``, ``drone/front_center``.
    """

    category: ClassVar[Category] = Category.USER

    stamp: int
    source: str


class Shutdown(Event, category=Category.LIFECYCLE):
    """Asks the run to end in order, as Ctrl-C would.

    Attributes:
        reason: Why, for the log and the summary.
    """

    reason: str = ""


class ParameterChanged(Event, category=Category.LIFECYCLE):
    """A setting of a node has changed during the run.

    Its source is the node, its stamp the moment from which on the new value holds.

    Attributes:
        key: The setting, as it stands in the file: ``gain``, ``cameras.front.loss``.
        value: The new value, as TOML.
    """

    key: str
    value: str


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


UNIT_TOLERANCE = 1e-3  # by how much the norm of a quaternion may differ from 1

_LEAST, _MOST = 1.0 - UNIT_TOLERANCE, 1.0 + UNIT_TOLERANCE
_LENGTHS = {
    tuple[float, float, float]: 3,
    tuple[float, float, float] | None: 3,
    tuple[float, float, float, float]: 4,
    float: 0,
}


def check(event: Any, *vectors: tuple[float, ...]) -> None:
    """Check the stamp of an event to be an `int`, and the numbers in `vectors` to be finite.

    Raises:
        TypeError: The stamp is no `int`, or a field is no tuple of as many numbers as it holds.
        ValueError: A number is not finite, or a quaternion not a unit one.
    """
    if event.stamp.__class__ is int:
        for vector in vectors:
            if not (vector.__class__ is tuple and len(vector) == 3 and _norm(vector) < inf):
                break
        else:
            return
    _check_all(event)


def check_pose(event: Any, position: tuple[float, ...], orientation: tuple[float, ...]) -> None:
    """Check the stamp of an event, its position and its orientation; raises as `check` does."""
    # All in one expression: most events have a pose, and this is half of what making one costs.
    if not (
        event.stamp.__class__ is int
        and position.__class__ is tuple
        and orientation.__class__ is tuple
        and len(position) == 3
        and len(orientation) == 4
        and _norm(position) < inf
        and _LEAST <= _norm(orientation) <= _MOST
    ):
        _check_all(event)


def check_frames(event: Any, *names: str) -> None:
    """Raise `ValueError` for blank names of frames."""
    for name in names:
        if not name.strip():
            raise ValueError(
                f"{type(event).__name__}: expected names of frames, found {_show(name)}"
            )


def check_covariance(event: Any, field: str, size: int) -> None:
    """Check a covariance: empty, or `size` rows of `size` finite numbers in a single tuple.

    Raises:
        TypeError: The value is neither.
        ValueError: A number is not finite.
    """
    numbers = getattr(event, field)
    if numbers.__class__ is not tuple or numbers:
        _check_numbers(f"{type(event).__name__}.{field}", numbers, size * size)


def publish(owner: str, name: str, array: Any, dtype: type, ndim: set[int]) -> None:
    """Make `array` read-only; raise `TypeError` for a wrong dtype or number of dimensions."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype or array.ndim not in ndim:
        actual = (
            f"{array.dtype} of shape {array.shape}"
            if isinstance(array, np.ndarray)
            else type(array).__name__
        )
        dims = " or ".join(str(n) for n in sorted(ndim))
        raise TypeError(
            f"{owner}.{name}: expected a {dims}-dimensional {np.dtype(dtype)} array, found {actual}"
        )
    array.setflags(write=False)


def _norm(numbers: tuple[float, ...]) -> float:
    try:
        return hypot(*numbers)
    except TypeError:
        return inf


def _check_all(event: Any) -> None:
    where = type(event).__name__
    if type(event.stamp) is not int:
        raise TypeError(
            f"{where}.stamp: expected nanoseconds as an int, found {_show(event.stamp)}"
        )
    for field in msgspec.structs.fields(event):
        length = _LENGTHS.get(field.type)
        value = getattr(event, field.name)
        if length is not None and not (value is None and field.default is None):
            _check_numbers(f"{where}.{field.name}", value, length)


def _check_numbers(where: str, value: Any, length: int) -> None:
    numbers = value if length else (value,)
    if not isinstance(numbers, tuple) or len(numbers) != (length or 1):
        raise TypeError(f"{where}: expected a tuple of {length} numbers, found {_show(value)}")
    try:
        finite = all(isfinite(n) for n in numbers)
    except TypeError:
        raise TypeError(f"{where}: expected numbers, found {_show(value)}") from None
    if not finite:
        raise ValueError(f"{where}: expected finite numbers, found {_show(value)}")
    if length == 4 and not _LEAST <= hypot(*numbers) <= _MOST:
        raise ValueError(
            f"{where}: expected a unit quaternion (w, x, y, z), found {_show(value)}, "
            f"whose norm is {hypot(*numbers):.6g}"
        )


def _show(value: Any) -> str:
    return f"{value!r:.80} ({type(value).__name__})"
