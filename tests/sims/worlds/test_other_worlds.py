"""Worlds of other packages: found by name, and named if they fail."""

from __future__ import annotations

from typing import Any

import mujoco
import pytest

from runtime.errors import CommandError
from runtime.extras import Offer
from sims import worlds
from sims.worlds import Dynamics, Scene, WorldError, load_scene


class Package(Offer):
    """Entry point of another package, whose object is at hand."""

    loaded: Any = None

    def load(self) -> Any:
        if isinstance(self.loaded, Exception):
            raise self.loaded
        return self.loaded


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Package:
    offer = Package("their-worlds", "maze", "theirs:maze")
    monkeypatch.setattr(worlds, "others", lambda _: (offer,))
    return offer


def test_a_packages_world_is_found_by_its_name(package: Package) -> None:
    package.loaded = lambda seed, bare: Scene(mujoco.MjSpec(), Dynamics(fog=bare and seed == 3))
    assert load_scene("maze", 3, bare=True).dynamics.fog
    package.loaded = lambda seed, bare: mujoco.MjSpec.from_string("<mujoco model='x'/>")
    assert load_scene("maze").spec.modelname == "x"
    with pytest.raises(WorldError, match=r"expected one of .*hall, maze, .* did you mean maze\?"):
        load_scene("mazze")


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        (CommandError("maze of the package their-worlds: …"), "world: maze of the package their-w"),
        (lambda seed, bare: 1 / 0, "world: maze of the package their-worlds: ZeroDivisionError"),
        (
            lambda seed, bare: "<mujoco/>",
            "worlds: expected a mujoco.MjSpec or a Scene, found",
        ),
        (lambda: None, "world: maze of the package their-worlds: TypeError"),
    ],
)
def test_a_packages_world_that_fails_is_named(package: Package, loaded: Any, message: str) -> None:
    package.loaded = loaded
    with pytest.raises(WorldError, match=message):
        load_scene("maze")
