"""Thresholds of the figures, as settings of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from runtime.figures import FIGURES, Figure, is_off


class _Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    def any_set(self, *, of_flight: bool = False) -> bool:
        """Return whether any threshold of an estimator, or else of a flight, is not its default.

        One that switches a default off asks for nothing.
        """
        limits = ((figure.default, getattr(self, figure.name)) for figure in _asked(of_flight))
        return any(limit != usual and not is_off(limit) for usual, limit in limits)

    def missed(self, figures: Mapping[str, Any], *, of_flight: bool = False) -> list[str]:
        """Return a sentence for each missed threshold of an estimator, or else of the flight."""
        asked = _asked(of_flight)
        sentences = (f.missed(getattr(self, f.name), figures.get(f.name)) for f in asked)
        return [*filter(None, sentences)]


def _asked(of_flight: bool) -> list[Figure]:
    return [figure for figure in _ASKED if figure.of_flight == of_flight]


_ASKED = [figure for figure in FIGURES.values() if figure.limit]

if TYPE_CHECKING:

    class Thresholds(_Limits, frozen=True):
        """Settings: thresholds of the figures; `None` for no threshold."""

        def __init__(self, **limits: float | None) -> None: ...

else:
    Thresholds = msgspec.defstruct(
        "Thresholds",
        [
            (figure.name, kind, figure.default)
            if figure.default is not None
            else (figure.name, kind | None, None)
            for figure in _ASKED
            for kind in [int | float if figure.counts else float]  # ``inf`` for none
        ],
        bases=(_Limits,),
        module=__name__,
        namespace={
            "__doc__": "What an estimator's figures may be; what is not given, and has no default, "
            "is not asked for.\n\nAttributes:\n"
            + "".join(f"    {figure.name}: {figure.setting}\n" for figure in _ASKED)
        },
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )
