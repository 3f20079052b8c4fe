"""Mark of the settings that may change during a run; `runtime.config.parameters` changes them."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar, get_origin

import msgspec

T = TypeVar("T")

_MARK = "changeable"

Changeable = Annotated[T, msgspec.Meta(extra={_MARK: True})]
"""Type of a setting changeable during a run: ``Changeable[float]``. Inside a table or a list of
tables, this applies to the setting (``drone.cameras.front.loss``); around them, to all settings.
"""


def is_marked(type_: Any) -> bool:
    """Return whether a setting of this type can change in a run."""
    marks = type_.__metadata__ if get_origin(type_) is Annotated else ()
    return any(isinstance(m, msgspec.Meta) and (m.extra or {}).get(_MARK) for m in marks)
