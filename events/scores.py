"""How well something did."""

from __future__ import annotations

from typing import ClassVar

from events.base import Category, Event
from events.checks import check


class Score(Event):
    """One number about one estimate.

    Attributes:
        subject: Source of what is scored.
        metric: ``position_error``, ``rotation_error``, ``ate_rmse``, …
        value: In `unit`.
        unit: ``m``, ``rad``, ``m^2``, ``s``, …
    """

    category: ClassVar[Category] = Category.SCORE

    subject: str
    metric: str
    value: float
    unit: str

    def __post_init__(self) -> None:
        check(self)
