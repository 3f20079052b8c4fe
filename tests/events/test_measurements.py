"""What is plotted, put on a map and exported of the small sensors' events."""

from __future__ import annotations

import math
from typing import get_type_hints

import pytest

from events import Event, Range, Vector3, Wind
from events.sensors import MEASURED, fields_of, numbers


@pytest.mark.parametrize("kind", MEASURED)
def test_each_field_is_a_number_or_a_vector(kind: type[Event]) -> None:
    hints = get_type_hints(kind)
    assert all(hints[field] in (float, Vector3) for field in MEASURED[kind])


def test_subclasses_measure_what_their_base_does() -> None:
    class Sonar(Range):
        """A node's own."""

    assert fields_of(Sonar) == {"range": "m"}
    assert fields_of(Event) == {}


def test_numbers_are_what_was_measured() -> None:
    far = Range(stamp=0, source="r", range=math.inf, min_range=0.1, max_range=9.0)
    assert numbers(far, "range") == (math.inf,)
    wind = Wind(stamp=0, source="drone", velocity=(1.0, 2.0, 3.0))
    assert numbers(wind, "velocity") == (1.0, 2.0, 3.0)
