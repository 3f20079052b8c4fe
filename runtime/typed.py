"""What `typing` has from Python 3.12 or 3.13 on, for type checkers, who bring it along."""

from __future__ import annotations

import typing
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import TypeVar as TypeVar
    from typing_extensions import override as override
else:

    def TypeVar(name, bound=None, default=None):  # noqa: N802, ARG001
        """Return a type variable without its default."""
        return typing.TypeVar(name, bound=bound)

    def override(method):
        """Return the method."""
        return method
