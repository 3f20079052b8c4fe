"""The table of the kinds of sensors: what it has, and what other packages add."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, get_type_hints

import pytest

from events import Event, Range, SensorAnnouncement, Vector3, Wind
from events.sensors import SENSOR_KINDS, SensorKind, numbers
from runtime import sensors
from runtime.errors import CommandError
from runtime.extras import Offer
from runtime.sensors import fields_of, measured, sensor_kinds


class Echo(Event):
    """A measurement that only its own package knows."""

    echo: float


KIND = SensorKind(
    name="echo",
    event=Echo,
    announcement=SensorAnnouncement,
    group="echoes",
    fields={"echo": "m/s"},
)


class Sonar:
    """A sensor, as far as the table knows one."""

    kind = KIND


class Package(Offer):
    """Entry point of another package, whose object is at hand."""

    loaded: Any = Sonar

    def load(self) -> Any:
        return self.loaded


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[Package]:
    """Another package's sensor, for the time of a test."""
    offer = Package("their-sensors", "echo", "theirs:Sonar")
    monkeypatch.setattr(sensors, "others", lambda _: (offer,))
    caches = (sensors.other_sensors, sensors.measured, sensors.fields_of)
    for cached in caches:
        cached.cache_clear()
    yield offer
    for cached in caches:
        cached.cache_clear()


@pytest.mark.parametrize("event", measured())
def test_each_field_is_a_number_or_a_vector(event: type[Event]) -> None:
    hints = get_type_hints(event)
    assert all(hints[field] in (float, Vector3) for field in measured()[event])


def test_a_plot_is_of_a_measured_field() -> None:
    assert all(kind.plots.keys() <= kind.fields.keys() for kind in SENSOR_KINDS.values())


def test_subclasses_measure_what_their_base_does() -> None:
    class Near(Range):
        """A node's own."""

    assert fields_of(Near) == {"range": "m"}
    assert fields_of(Event) == {}


def test_numbers_are_what_was_measured() -> None:
    far = Range(stamp=0, source="r", range=math.inf, min_range=0.1, max_range=9.0)
    assert numbers(far, "range") == (math.inf,)
    wind = Wind(stamp=0, source="drone", velocity=(1.0, 2.0, 3.0))
    assert numbers(wind, "velocity") == (1.0, 2.0, 3.0)


def test_a_packages_sensor_comes_after_ours(package: Package) -> None:
    assert sensor_kinds() == (*SENSOR_KINDS.values(), KIND)
    assert fields_of(Echo) == {"echo": "m/s"}


@pytest.mark.parametrize("loaded", [Echo, Sonar(), None, 3])
def test_what_is_no_sensor_is_refused_by_the_name_of_its_package(
    package: Package, loaded: Any
) -> None:
    package.loaded = loaded
    with pytest.raises(CommandError, match=r"echo of the package their-sensors: expected a cl"):
        sensor_kinds()


@pytest.mark.parametrize(
    ("what", "taken"), [("name", "gnss"), ("event", Range), ("group", "ranges")]
)
def test_a_name_that_another_sensor_has_is_refused(package: Package, what: str, taken: Any) -> None:
    values = {name: getattr(KIND, name) for name in KIND.__struct_fields__}
    package.loaded = type("Other", (), {"kind": SensorKind(**{**values, what: taken})})
    with pytest.raises(CommandError, match=rf"package their-sensors: kind\.{what}: expected one"):
        sensor_kinds()
