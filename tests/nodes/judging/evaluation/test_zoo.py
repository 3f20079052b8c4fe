"""No bad estimator passes, and no good one fails, whatever is asked for; and which figure says so.

Three sets of thresholds: none at all, those of `config.toml`, and strict ones.
"""

from __future__ import annotations

import contextlib
import json
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from events import (
    Announcement,
    Collision,
    EstimatorAnnouncement,
    Event,
    Image,
    PoseEstimate,
    TrackingEvent,
    TrajectoryEstimate,
)
from nodes.judging.evaluation import Evaluation
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.plausibility import at_images
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.evaluation.verdict import conclude, planned_end
from nodes.trajectory import Trajectory
from runtime import Input, Node, NodeConfig, Output
from runtime.errors import NodeError
from runtime.figures import FIGURES
from runtime.testing import run_nodes, spec
from tests.nodes.judging.evaluation.flights import MS, SECOND, announced, heading, place, truth
from tests.nodes.judging.evaluation.zoo import (
    BAD,
    EARLY,
    FRAMES,
    GOOD,
    SECONDS,
    STRICT,
    Animal,
    ended,
)

ROOT = Path(__file__).parents[4]


def standard() -> dict[str, Any]:
    """Return what `config.toml` asks for."""
    settings = tomllib.loads((ROOT / "config.toml").read_text(encoding="utf-8"))
    (node,) = (n["thresholds"] for n in settings["nodes"] if n["name"] == "evaluation")
    return dict(node)


SETS: dict[str, dict[str, Any]] = {"default": {}, "standard": standard(), "strict": STRICT}
STAMPS = range(0, SECONDS * SECOND + 100 * MS + 1, 5 * MS)
TRUTH = Trajectory(
    np.array(STAMPS), np.array([*map(place, STAMPS)]), np.array([*map(heading, STAMPS)])
)


def judged(animal: Animal) -> dict[str, Any]:
    """Return its figures."""
    record = EstimatorRecord(animal.scale_free, "test", animal.reads)
    for now, event in animal.sent():
        if now > animal.end.stamp:
            continue
        if isinstance(event, PoseEstimate):
            record.add(event, now)
        elif isinstance(event, TrackingEvent):
            record.add_tracking(event, now)
        elif isinstance(event, TrajectoryEstimate):
            record.add_final(event)
    stop = animal.end.stamp
    frames = np.array([t for t in FRAMES[:: 30 // animal.rate] if t + 40 * MS <= stop])
    truth = TRUTH.take(TRUTH.stamps <= stop)
    planned = planned_end(animal.end)
    figures = judge(
        record, truth, cameras={"camera": frames}, end=stop, planned=planned, rate=100
    ).figures
    return figures | {"stamped_at_images_percent": at_images(frames, record.stamps())}


@pytest.mark.parametrize("name", [*GOOD, *BAD])
def test_which_figure_tells(name: str) -> None:
    animal = (GOOD | BAD)[name]
    figures = judged(animal)
    for which, limits in SETS.items():
        thresholds = Thresholds(**limits, **((animal.asked or {}) if which == "strict" else {}))
        declared = ["est"] * ("truth" in animal.reads)
        verdict = conclude({"est": figures}, thresholds, (), animal.end, declared)
        failed, expected = verdict["estimators"]["est"]["failed"], getattr(animal, which)
        assert any(reason.startswith(expected) for reason in failed) or not expected, which
        assert verdict["passed"] is (False if expected else True if limits else None), failed


def test_each_threshold_fails_a_bad_estimator() -> None:
    telling = {reason for animal in BAD.values() for reason in animal.telling()}
    assert not {f.name for f in FIGURES.values() if f.limit and not f.of_flight} - telling


def images() -> list[Event]:
    """30 small images a second."""
    data = np.zeros((2, 2), np.uint8)
    return [Image(stamp=t, source="c", frame_id="o", encoding="mono8", data=data) for t in FRAMES]


class BeastConfig(NodeConfig):
    kind: str = "good"


class Beast(Node[BeastConfig]):
    """Says of each image where it was, until something happens to it at 3 s."""

    images = Input(Image)
    estimates = Output(PoseEstimate)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method=self.config.kind)

    async def run(self) -> None:
        async for image in self.images:
            place_, turn, kind = place(image.stamp), heading(image.stamp), self.config.kind
            if image.stamp > 3 * SECOND:
                if kind == "stops":
                    self.stop("it gets dark")
                elif kind == "crashes" and not self.restarts:
                    raise RuntimeError("SVD did not converge")
                elif kind == "not a number":
                    place_ = (math.nan, 0.0, 0.0)
                elif kind == "no rotation":
                    turn = (0.0, 0.0, 0.0, 0.0)
            frame = " " if kind == "no frame" else "map"
            pose: dict[str, Any] = {"frame_id": frame, "position": place_, "orientation": turn}
            self.estimates.send(PoseEstimate(stamp=image.stamp, source=self.name, **pose))


def flown(
    out: Path,
    kinds: dict[str, str],
    *more: Event,
    limits: dict[str, float] | None = None,
    on_error: Literal["stop", "restart", "drop"] = "drop",
) -> dict[str, Any]:
    """Fly 6 s with these estimators, by their names, and return the verdict."""
    out.mkdir(exist_ok=True)
    nodes = [spec(Beast, name, {"kind": kind}, on_error=on_error) for name, kind in kinds.items()]
    asked = standard() if limits is None else limits
    evaluation = spec(Evaluation, "evaluation", {"thresholds": asked})
    script = sorted([*truth(6), *images()[:180], *more], key=lambda e: e.stamp)
    with contextlib.suppress(NodeError):
        run_nodes([*nodes, evaluation], inputs=[announced()[0], *script], duration=6.1, out=out)
    verdict: dict[str, Any] = json.loads((out / "evaluation" / "verdict.json").read_text())
    return verdict


def test_one_that_raises_fails_and_the_good_one_beside_it_is_judged_as_if_alone(
    tmp_path: Path,
) -> None:
    kinds = ("good", "not a number", "no rotation", "no frame", "crashes")
    both = flown(tmp_path / "zoo", {kind.replace(" ", "_"): kind for kind in kinds})
    alone = flown(tmp_path / "alone", {"good": "good"})
    assert alone["passed"] is True
    assert both["passed"] is False
    passed = {name: judgement["passed"] for name, judgement in both["estimators"].items()}
    assert passed.pop("good")
    assert not any(passed.values())
    assert both["estimators"]["good"] == alone["estimators"]["good"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "on_error", "figure", "other"),
    [
        (
            "stops",
            "stop",
            "early_end_seconds: expected at most 0, found 3.067 (est ended the run: it",
            ["early_end_seconds"],
        ),
        (
            "crashes",
            "stop",
            "ended_by: expected no error of its own, found: ",
            ["early_end_seconds"],
        ),
        ("crashes", "restart", "restarts: expected at most 0, found 1", []),
    ],
)
def test_who_ends_the_run_or_begins_anew_has_failed(
    tmp_path: Path, kind: str, on_error: Literal["stop", "restart"], figure: str, other: list[str]
) -> None:
    verdict = flown(tmp_path, {"est": kind, "other": "good"}, on_error=on_error, limits={})
    estimators = verdict["estimators"]
    assert verdict["passed"] is False
    assert [reason for reason in estimators["est"]["failed"] if reason.startswith(figure)]
    failed = [reason.partition(":")[0] for reason in estimators["other"]["failed"]]
    assert [reason for reason in failed if reason != "coverage_percent"] == other
    if other:
        assert estimators["other"]["coverage_percent"] == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize(("limits", "passed"), [({"ate_percent": 1.0}, False), ({}, None)])
def test_thresholds_that_nobody_is_there_to_meet_are_missed(
    tmp_path: Path, limits: dict[str, float], passed: bool | None
) -> None:
    verdict = flown(tmp_path, {}, limits=limits)
    assert verdict["passed"] is passed
    assert ("expected an estimator" in str(verdict.get("failed"))) == (passed is False)


def test_nobody_invents_by_how_much_an_end_was_early() -> None:
    animal = BAD["asks for it where no end is planned"]
    verdict = conclude({"est": judged(animal)}, Thresholds(early_end_seconds=9.0), (), animal.end)
    figures = verdict["estimators"]["est"]
    assert figures["early_end_seconds"] is None
    unknown = "early_end_seconds: ended early (by est: dark); the planned end is not known"
    assert figures["failed"] == [unknown]


def test_an_estimator_is_its_node_by_whatever_name_it_speaks() -> None:
    figures = {"est": judged(GOOD["exact"])}

    def judged_with(**how: Any) -> dict[str, Any]:
        end = ended(owners={"est": "node", "est/further": "other"}, **how)
        verdict = conclude(figures, Thresholds(), (), end)["estimators"]["est"]
        return dict(verdict)

    assert judged_with()["failed"] == []
    reads = judged_with(truth_readers=frozenset({"node"}))
    assert (reads["reads_truth"], len(reads["failed"])) == ("undeclared", 1)
    offered = judged_with(truth_relays=frozenset({"node"}))
    assert (offered["reads_truth"], offered["failed"]) == ("offered", [])
    assert judged_with(restarts={"node": 2})["restarts"] == 2
    assert "ended_by" in str(
        judged_with(by="node", error="SVD did not converge", **EARLY)["failed"]
    )
    assert "reads_truth" not in judged_with(truth_readers=frozenset({"other"}))


def test_what_the_user_ended_is_not_judged() -> None:
    end = ended(by="user", reason="Ctrl-C", planned=False, stamp=3 * SECOND)
    for figures in ({"est": judged(BAD["mute"])}, {}):
        verdict = conclude(figures, Thresholds(ate_percent=1.0), (), end)
        assert verdict["passed"] is None
        assert "the user ended the run" in str(verdict)


def test_a_vehicle_that_hits_something_fails_its_flight_and_no_estimator(tmp_path: Path) -> None:
    where: dict[str, Any] = {"position": (0.0, 0.0, 0.0), "normal": (1.0, 0.0, 0.0)}
    hits = [
        Collision(stamp=k * SECOND, source="drone", other="wall", speed=1.0, **where)
        for k in (3, 4)
    ]
    verdict = flown(tmp_path, {"good": "good"}, *hits)
    assert verdict["estimators"]["good"]["failed"] == []
    assert verdict["flights"]["drone"]["failed"] == ["collisions: expected at most 0, found 2"]
    assert verdict["passed"] is verdict["flights"]["drone"]["passed"] is False


def test_a_flight_is_judged_without_an_estimator() -> None:
    near, far = {"plan_rmse_m": 0.1, "collisions": 0}, {"plan_rmse_m": 0.3, "collisions": 0}
    limits = Thresholds(plan_rmse_m=0.2)
    assert conclude({}, limits, flights={"drone": near})["passed"] is True
    verdict = conclude({}, limits, flights={"drone": near, "other": far})
    assert verdict["passed"] is False
    assert verdict["flights"]["other"]["failed"] == ["plan_rmse_m: expected at most 0.2, found 0.3"]
    assert conclude({}, Thresholds(), flights={"drone": near})["passed"] is None
    good = {"est": judged(next(iter(GOOD.values()))) | far}
    assert conclude(good, limits, flights={"drone": far})["estimators"]["est"]["passed"] is None


def test_an_estimator_may_have_thresholds_of_its_own() -> None:
    figures = judged(next(iter(GOOD.values()))) | {"ate_percent": 3.0}
    judged_figures = dict.fromkeys(("vo", "mono"), figures)
    limits = Thresholds(ate_percent=1.0)
    verdict = conclude(judged_figures, limits, by_estimator={"mono": Thresholds(ate_percent=5.0)})
    assert verdict["estimators"]["mono"]["passed"] is True
    assert verdict["estimators"]["vo"]["failed"] == ["ate_percent: expected at most 1, found 3"]
    assert verdict["own_thresholds"]["mono"]["ate_percent"] == 5.0
    for there in ({}, {"vo": figures | {"ate_percent": 0.5}}):  # and it has to be there
        verdict = conclude(there, limits, by_estimator={"mono": Thresholds(ate_percent=5.0)})
        assert verdict["passed"] is verdict["estimators"]["mono"]["passed"] is False
        assert verdict["estimators"]["mono"]["failed"] == ["expected estimates, found none"]
