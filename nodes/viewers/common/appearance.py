"""Colours, the shape of a vehicle, and words for the log."""

from __future__ import annotations

from typing import NamedTuple

from events import Event, Vector3

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

TRUTH: Colour = (80, 220, 120)
_TRUTHS: list[Colour] = [TRUTH, (60, 200, 190), (170, 215, 70), (40, 160, 110)]
PLAN: Colour = (140, 140, 150)
WIND: Colour = (120, 200, 255)
INLIER: Colour = (90, 240, 120)
OUTLIER: Colour = (240, 80, 70)

_ESTIMATES: list[Colour] = [
    (255, 160, 20),
    (90, 170, 255),
    (230, 110, 230),
    (250, 230, 80),
    (120, 230, 230),
]


class Box(NamedTuple):
    """A box in the frame of a body, along its axes: centre and lengths of its sides in metres."""

    centre: Vector3
    size: Vector3
    colour: Colour


VEHICLE = [
    Box((0.0, 0.0, 0.0), (0.2, 0.12, 0.07), (200, 200, 210)),
    Box((0.09, 0.0, 0.0), (0.06, 0.06, 0.04), (230, 80, 70)),
    *(
        Box((x, y, -0.03), (0.18, 0.18, 0.012), (90, 95, 110))
        for x in (-0.14, 0.14)
        for y in (-0.14, 0.14)
    ),
]
"""A body with a nose and four rotors."""


_SIZES: dict[str, Vector3] = {"person": (0.5, 0.5, 1.8), "car": (4.2, 1.8, 1.5)}


def moving_body(kind: str) -> Box:
    """Return a box about as large as what moves by itself: nothing else is known of its shape."""
    return Box((0.0, 0.0, 0.0), _SIZES.get(kind, (0.5, 0.5, 0.5)), (235, 150, 60))


def estimate_colour(index: int) -> Colour:
    """Return the colour of the n-th estimator, from 0."""
    return _ESTIMATES[index % len(_ESTIMATES)]


def truth_colour(index: int) -> Colour:
    """Return the colour of the n-th vehicle's true path, from 0."""
    return _TRUTHS[index % len(_TRUTHS)]


def describe(event: Event) -> str:
    """Return a tracking or vehicle event in words."""
    more = getattr(event, "reason", "") or getattr(event, "other", "")
    return type(event).__name__ + (f" ({more})" if more else "")
