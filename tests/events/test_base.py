"""What every event is: frozen, keyword-only, documented, and exported by name."""

from __future__ import annotations

import inspect
import subprocess
import sys
from types import ModuleType

import msgspec
import pytest

import events
import runtime
from events import Announcement, Category, Event

CLASSES = sorted(
    (v for v in vars(events).values() if isinstance(v, type) and issubclass(v, Event)),
    key=lambda cls: cls.__name__,
)


class Mine(Event):
    """As an author of nodes writes one."""

    value: int = 0


def submodules(package: ModuleType) -> list[ModuleType]:
    return [v for v in vars(package).values() if inspect.ismodule(v)]


def test_each_event_is_frozen_and_takes_keywords_only() -> None:
    for event in CLASSES:
        assert event.__struct_config__.frozen, event
        with pytest.raises(TypeError, match="positional"):
            event(0, "source")  # type: ignore[call-arg]


def test_an_authors_event_is_so_without_saying_it() -> None:
    mine = Mine(stamp=1, source="me", value=2)
    assert mine == Mine(stamp=1, source="me", value=2)
    assert mine != Mine(stamp=1, source="me", value=3)
    with pytest.raises(AttributeError, match="immutable"):
        mine.value = 3  # type: ignore[misc]
    with pytest.raises(TypeError, match="positional"):
        Mine(1, "me")  # type: ignore[call-arg]
    assert mine.category is Category.USER


@pytest.mark.parametrize("missing", ["stamp", "source"])
def test_no_event_without_a_time_and_a_speaker(missing: str) -> None:
    given = {"stamp": 0, "source": "me"}
    del given[missing]
    with pytest.raises(TypeError, match=missing):
        Mine(**given)  # type: ignore[arg-type]


def test_each_event_says_what_it_is_in_a_docstring_that_names_its_fields() -> None:
    for event in CLASSES:
        text = vars(event).get("__doc__") or ""
        assert text.strip(), event
        own = {field.name for field in msgspec.structs.fields(event)} - {"stamp", "source"}
        for base in event.__mro__[1:]:
            if issubclass(base, Event):
                own -= {field.name for field in msgspec.structs.fields(base)}
        assert [name for name in sorted(own) if f"{name}:" not in text] == [], event


def test_each_event_has_a_category() -> None:
    for event in CLASSES:
        assert isinstance(event.category, Category), event
        assert event is Event or event.category is not Category.USER, event


def test_announcements_are_one_category() -> None:
    announcements = {cls for cls in CLASSES if cls.category is Category.ANNOUNCEMENT}
    assert announcements == {cls for cls in CLASSES if issubclass(cls, Announcement)}


def test_events_exports_exactly_what_its_modules_define() -> None:
    """And nothing that is defined elsewhere, or twice."""
    exported = [n for n in vars(events) if not n.startswith(("_", "@"))]  # @: pytest's
    modules = [module.__name__.rpartition(".")[2] for module in submodules(events)]
    assert sorted(events.__all__) == sorted(set(exported) - set(modules))
    assert events.__all__ == sorted(set(events.__all__))


def test_every_event_of_every_module_is_exported() -> None:
    defined = {
        name
        for module in submodules(events)
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Event)
    }
    assert defined <= set(events.__all__)


def test_the_face_of_the_runtime_is_small_and_all_there() -> None:
    assert len(runtime.__all__) <= 15
    assert runtime.__all__ == sorted(set(runtime.__all__))
    assert [name for name in runtime.__all__ if not hasattr(runtime, name)] == []


def test_importing_events_imports_nothing_heavy() -> None:
    code = "import sys, events; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    heavy = {
        "asyncio",
        "cv2",
        "matplotlib",
        "mujoco",
        "rich",
        "runtime",
        "socket",
        "typer",
        "zenoh",
    }
    assert heavy & set(done.stdout.split()) == set()


def test_an_event_has_the_category_of_its_class_line_or_of_its_base() -> None:
    class Fog(Event, category=Category.SENSOR):
        """Seen through."""

    class Mist(Fog):
        """Thinner."""

    class Plain(Event):
        """Of a user."""

    categories = [cls.category for cls in (Fog, Mist, Plain)]
    assert categories == [Category.SENSOR, Category.SENSOR, Category.USER]
    assert Fog(stamp=1, source="a") == Fog(stamp=1, source="a")
