"""Settings that may change while a run goes on."""

from __future__ import annotations

from typing import Annotated

import msgspec
import pytest

from runtime import Duration, NodeConfig
from runtime.changeable import Changeable
from runtime.config.parameters import change, changeable, settings
from runtime.errors import ConfigError


class Lens(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    loss: Changeable[Annotated[float, msgspec.Meta(le=1)]] = 0.0
    width: int = 4


class Rig(NodeConfig):
    lenses: tuple[Lens, ...] = ()
    speed: Changeable[Annotated[float, msgspec.Meta(gt=0)]] = 1.0
    wait: Changeable[Duration] = Duration(1)
    limit: Changeable[float | None] = None
    place: Changeable[tuple[float, float]] = (0.0, 0.0)
    height: float = 1.0


RIG = Rig(lenses=(Lens(name="front"), Lens(name="rear")))
NODES = {"rig": RIG, "other": Rig()}


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("rig.speed=2", {"speed": "2.0"}),
        ("rig.speed = 2.5 ", {"speed": "2.5"}),
        ("rig.wait=80ms", {"wait": "0.08"}),
        ("rig.limit=3", {"limit": "3.0"}),
        ("rig.place=[1, 2]", {"place": "[1.0, 2.0]"}),
        ("rig.lenses.rear.loss=0.5", {"lenses.rear.loss": "0.5"}),
        ("front.loss=0.25", {"lenses.front.loss": "0.25"}),
        ("rig.speed=1.0", {}),
    ],
)
def test_a_change_is_what_the_file_would_say(text: str, values: dict[str, str]) -> None:
    result = change(NODES, text)
    assert result.values == values
    assert result.node == ("rig" if values else "")


def test_all_else_stays_and_the_old_settings_too() -> None:
    changed = change(NODES, "rear.loss=0.5").config
    assert isinstance(changed, Rig)
    assert changed.lenses == (RIG.lenses[0], Lens(name="rear", loss=0.5))
    assert RIG.lenses[1].loss == 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rig.speed=-1", "rig.speed: expected a number > 0, found -1"),
        ("rig.speed=fast", 'rig.speed: expected a number, found "fast"'),
        ("rig.wait=late", 'rig.wait: expected a duration such as 0.5, "80ms" or "2min", found'),
        (
            "rig.sped=1",
            r"rig: found unknown key 'sped' \(did you mean 'speed'\?\); expected",
        ),
        ("rigg.speed=1", r'expected run or a node \(rig, other\), found "rigg" \(did you mean'),
        ("rig.height=2", "rig.height: cannot change while the run goes on: of rig, lenses.*.loss,"),
        ("front.width=2", "rig.lenses.front.width: cannot change while the run goes on"),
        ("front.loss=2", r"rig.lenses\[0\].loss: expected a number <= 1, found 2"),
        ("rig", "expected node.key=value"),
        ("run.seed=2", "what .run. says holds to its end"),
        ("network.port=2", "what .network. says holds to its end"),
        ("rig.name=2", "a node's name cannot change"),
    ],
)
def test_what_cannot_be_is_refused_as_in_the_file(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        change(NODES, text)


def test_what_can_change_is_listed_with_its_values() -> None:
    assert changeable(Rig) == ["lenses.*.loss", "speed", "wait", "limit", "place"]
    values = settings(RIG)
    assert values["lenses.rear.loss"] == "0.0"
    assert values["speed"] == "1.0"
    assert "height" not in values
