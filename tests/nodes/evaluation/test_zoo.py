"""No bad estimator passes the thresholds of `config.toml`, and none harms a good one beside it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import Collision, Event, Image
from nodes.evaluation import Evaluation
from runtime.testing import run_nodes, spec
from tests.nodes.evaluation.flights import SECOND, announced, truth
from tests.nodes.evaluation.zoo import ZOO, Animal

ROOT = Path(__file__).parents[3]
SECONDS = 12


def standard_thresholds() -> dict[str, float]:
    """Return what `config.toml` asks for."""
    settings = tomllib.loads((ROOT / "config.toml").read_text(encoding="utf-8"))
    (thresholds,) = (n["thresholds"] for n in settings["nodes"] if n["name"] == "evaluation")
    found: dict[str, float] = thresholds
    return found


def images() -> list[Event]:
    """30 small images a second."""
    data = np.zeros((2, 2), np.uint8)
    return [
        Image(stamp=round(k * SECOND / 30), source="c", frame_id="o", encoding="mono8", data=data)
        for k in range(30 * SECONDS)
    ]


def judged(
    out: Path, kinds: list[str], *more: Event, thresholds: dict[str, float] | None = None
) -> dict[str, Any]:
    """Fly with these estimators, and return the verdict."""
    asked = standard_thresholds() if thresholds is None else thresholds
    nodes = [spec(Animal, kind, {"kind": kind}, on_error="drop") for kind in kinds]
    evaluation = spec(Evaluation, "evaluation", {"thresholds": asked})
    script = sorted([*truth(SECONDS), *images(), *more], key=lambda e: e.stamp)
    run_nodes(
        [*nodes, evaluation], inputs=[announced()[0], *script], duration=SECONDS + 0.1, out=out
    )
    verdict: dict[str, Any] = json.loads((out / "evaluation" / "verdict.json").read_text())
    return verdict


@pytest.fixture(scope="module")
def zoo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return judged(tmp_path_factory.mktemp("zoo"), ["good", *ZOO])


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return judged(tmp_path_factory.mktemp("alone"), ["good"])


@pytest.mark.parametrize("kind", ZOO)
def test_a_bad_estimator_fails_and_the_reason_names_what_is_wrong(
    zoo: dict[str, Any], kind: str
) -> None:
    figures = zoo["estimators"][kind]
    assert figures["passed"] is False
    assert [reason for reason in figures["failed"] if reason.startswith(ZOO[kind][1])]


def test_a_good_one_beside_them_is_judged_as_if_alone(
    zoo: dict[str, Any], alone: dict[str, Any]
) -> None:
    assert alone["passed"] is True
    assert alone["estimators"]["good"]["failed"] == []
    assert zoo["estimators"]["good"] == alone["estimators"]["good"]
    assert zoo["passed"] is False


@pytest.mark.slow
def test_without_thresholds_a_good_one_is_not_judged_and_an_absent_one_fails(
    tmp_path: Path,
) -> None:
    verdict = judged(tmp_path, ["good", "frozen"], thresholds={})
    assert verdict["passed"] is None
    assert verdict["estimators"]["good"]["passed"] is None
    verdict = judged(tmp_path, ["good", "last_second_only", "twice"], thresholds={})
    passed = {name: figures["passed"] for name, figures in verdict["estimators"].items()}
    assert passed == {"good": None, "last_second_only": False, "twice": False}


def test_a_vehicle_that_hits_something_fails(tmp_path: Path) -> None:
    hits = [
        Collision(
            stamp=k * SECOND,
            source="drone",
            other="wall",
            position=(0.0, 0.0, 0.0),
            normal=(1.0, 0.0, 0.0),
            speed=1.0,
        )
        for k in (3, 4)
    ]
    figures = judged(tmp_path, ["good"], *hits)["estimators"]["good"]
    assert figures["collisions"] == 2
    assert figures["failed"] == ["collisions: expected at most 0, found 2"]
