"""Thresholds that hold by default: each catches an estimator that no other one does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.plausibility import (
    at_images,
    too_large_percent,
    velocity_error_percent,
)
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.evaluation.verdict import conclude
from nodes.trajectory import Trajectory
from runtime.figures import FIGURES, is_off
from tests.nodes.judging.evaluation.flights import MS, SECOND, heading, place
from tests.nodes.judging.evaluation.test_coverage import FRAMES as IMAGES
from tests.nodes.judging.evaluation.test_zoo import judged
from tests.nodes.judging.evaluation.zoo import (
    BAD,
    FRAMES,
    GOOD,
    LATE,
    SECONDS,
    Animal,
    Change,
    Fields,
    covariance,
    delayed,
    ended,
    first,
    given,
    merged,
    noisy,
    said_lost,
    says,
    turned,
    velocity,
)

DEFAULTS = {f.name for f in FIGURES.values() if f.limit and not f.of_flight} & {
    f.name for f in FIGURES.values() if f.default is not None or f.all_or_none is not None
}
OF_FILES = {"compared_percent"}  # of the truth and the estimate that are brought


def stamped_at_its_arrival(stamp: int, pose: Fields) -> Fields:
    return pose | {"stamp": stamp + LATE}


def frozen(stamp: int, pose: Fields) -> Fields:
    """Stay at the place of the start, and turn as the vehicle does."""
    return pose | {"position": place(0)}


ONLY: dict[str, Animal] = {
    "rot_rmse_deg": Animal(
        says(turned(lambda r, _: r * Rotation.from_euler("z", 20, degrees=True)))
    ),
    "rpe_1m_trans_percent": Animal(says(frozen)),
    "velocity_error_percent": Animal(says(given(0, velocity=(0.0, 0.0, 0.0)))),
    "nees_position": Animal(says(noisy(0.01, covariance=covariance(1e-8)))),
    "coverage_percent": Animal(says(lambda t, p: p if t > 2 * SECOND else None)),
    "velocities_percent": Animal(says(lambda t, p: first(19, velocity=velocity(t))(t, p))),
    "covariances_percent": Animal(says(first(19, covariance=covariance(1.0)))),
    "covariance_invalid": Animal(says(given(0, covariance=covariance(-1e-4)))),
    "covariance_too_large_percent": Animal(says(given(0, covariance=covariance(1e6)))),
    "restarts": Animal(says(), end=ended(restarts={"est": 1})),
    "repeated_stamps": Animal(merged(says(), says())),
    "future_stamps": Animal(merged(says(), said_lost(10**18, SECOND, SECOND + LATE))),
    "not_causal_percent": Animal(says(delayed(lambda t: SECONDS * SECOND - t))),
    "stamped_at_images_percent": Animal(says(stamped_at_its_arrival)),
    "other_bodies": Animal(says(given(0, child_frame_id="camera"))),
    "early_end_seconds": Animal(says(), end=ended(by="est", planned=False, stamp=11_900 * MS)),
}
"""By default figure an estimator that only this figure catches."""


def test_each_default_has_an_estimator_that_only_it_catches() -> None:
    assert {*ONLY} == DEFAULTS - OF_FILES


def failures(animal: Animal, **limits: float) -> list[str]:
    """Return the names of the figures by which it fails."""
    figures = {"est": judged(animal)}
    verdict = conclude(figures, Thresholds(**limits), (), animal.end)["estimators"]["est"]
    return [text.partition(":")[0] for text in verdict["failed"]]


@pytest.mark.slow
@pytest.mark.parametrize("figure", ONLY)
def test_a_default_catches_what_no_other_does_and_is_switched_off_by_inf(figure: str) -> None:
    assert failures(ONLY[figure]) == [figure]
    assert failures(ONLY[figure], **{figure: math.inf}) == []


def interpolated(every: int) -> Change:
    """Track every so many images, and put poses between them once the next one is tracked."""

    def say(stamp: int, pose: Fields) -> Fields:
        k = FRAMES.index(stamp)
        before, after = k - k % every, min(k - k % every + every, len(FRAMES) - 1)
        if k == before:
            return pose
        share = (stamp - FRAMES[before]) / (FRAMES[after] - FRAMES[before])
        a, b = (np.array(place(FRAMES[k])) for k in (before, after))
        late = FRAMES[after] + LATE - stamp
        return pose | {"position": tuple((a + share * (b - a)).tolist()), "late": late}

    return say


UNNOTICED: dict[str, tuple[Animal, str]] = {
    "rotations of identity": (
        Animal(says(given(0, orientation=(1.0, 0.0, 0.0, 0.0)))),
        "rot_rmse_deg",
    ),
    "conjugated rotations": (Animal(says(turned(lambda r, _: r.inv()))), "rot_rmse_deg"),
    "the scalar last": (
        Animal(
            says(lambda _, p: p | {"orientation": (*p["orientation"][1:], p["orientation"][0])})
        ),
        "rot_rmse_deg",
    ),
    "poses only at the end": (ONLY["not_causal_percent"], "not_causal_percent"),
    "interpolated later": (Animal(says(interpolated(10))), "not_causal_percent"),
    "in heaps": (BAD["in heaps of a second"], "not_causal_percent"),
    "stamped at its arrival": (ONLY["stamped_at_images_percent"], "stamped_at_images_percent"),
    "covariances of zero": (Animal(says(given(0, covariance=(0.0,) * 36))), "covariance_invalid"),
    "covariances of a micrometre": (
        Animal(says(noisy(0.005, covariance=covariance(1e-12)))),
        "nees_position",
    ),
    "covariances of a kilometre": (
        ONLY["covariance_too_large_percent"],
        "covariance_too_large_percent",
    ),
    "any orientation": (
        Animal(says(given(0, covariance=covariance(1e-4, 100.0)))),
        "covariance_too_large_percent",
    ),
    "velocities of zero": (ONLY["velocity_error_percent"], "velocity_error_percent"),
    "velocities of the body": (BAD["velocity of the body"], "velocity_error_percent"),
    "velocities in kilometres an hour": (
        Animal(says(lambda t, p: p | {"velocity": tuple(3.6 * v for v in velocity(t))})),
        "velocity_error_percent",
    ),
}
ASKED = {"ate_percent": 1.0, "lost_seconds": 0.5, "coverage_percent": 95.0}
OFF = dict.fromkeys(DEFAULTS - ASKED.keys(), math.inf)


@pytest.mark.slow
@pytest.mark.parametrize("kind", UNNOTICED)
def test_positions_that_are_right_hide_nothing_else(kind: str) -> None:
    animal, figure = UNNOTICED[kind]
    assert failures(animal, **ASKED, **OFF) == []
    assert figure in failures(animal, **ASKED)


@pytest.mark.slow
@pytest.mark.parametrize("name", GOOD)
def test_the_defaults_fail_nobody_who_is_good(name: str) -> None:
    declared = ["est"] if "truth" in GOOD[name].reads else []
    verdict = conclude({"est": judged(GOOD[name])}, Thresholds(), (), GOOD[name].end, declared)
    assert verdict["estimators"]["est"]["failed"] == []


@pytest.mark.slow
def test_twenty_minutes_in_a_small_place_make_a_frozen_estimator_no_better() -> None:
    """Its error is a few parts in a thousand of the path: it is the size of the place."""
    stamps = np.arange(0, 1200 * SECOND, 50 * MS)
    places, headings = ([*map(of, stamps.tolist())] for of in (place, heading))
    truth = Trajectory(stamps, np.array(places), np.array(headings))
    record = EstimatorRecord()
    for stamp, _, orientation in truth.poses():
        record.longest.rows.add(stamp, place(0), orientation)
    figures = judge(record, truth, alignment="none", cameras={"c": stamps}).figures
    assert figures["ate_percent"] < 0.4
    (failed,) = conclude({"est": figures}, Thresholds(**ASKED))["estimators"]["est"]["failed"]
    assert failed.startswith("rpe_1m_trans_percent: expected at most 75, found 9")


def test_defaults_count_only_where_there_is_a_figure() -> None:
    figures = {"ate_rmse_m": 0.0, "coverage_percent": 100.0, "compared_percent": 100.0}
    verdict = conclude({"est": figures}, Thresholds())
    assert verdict["estimators"]["est"]["failed"] == []
    assert verdict["passed"] is None
    asked = Thresholds(rpe_1m_trans_percent=50.0, rot_rmse_deg=1.0)  # these are asked for
    assert [text.partition(":")[0] for text in asked.missed(figures)] == [
        "rot_rmse_deg",
        "rpe_1m_trans_percent",
    ]


def test_a_default_that_is_switched_off_asks_for_nothing() -> None:
    off = Thresholds(rot_rmse_deg=math.inf, coverage_percent=math.inf)
    assert not off.any_set()
    assert not off.missed({"compared_percent": 100.0})
    assert Thresholds(rot_rmse_deg=14.0).any_set()
    assert is_off(-math.inf)
    assert not is_off(None)


def test_orientations_of_no_body_fail_and_in_files_may_be_missing() -> None:
    why = "its orientations are inverted, from the world to the body"
    figures: dict[str, Any] = {"ate_rmse_m": 0.0}
    figures |= {"coverage_percent": 100.0, "compared_percent": 100.0}
    left_out = figures | {"why_no_rotations": why, "orientations": "inverse"}

    def failed(figures: dict[str, Any], **limits: float) -> list[str]:
        verdict = conclude({"est": figures}, Thresholds(**limits), (), ended())
        texts: list[str] = verdict["estimators"]["est"]["failed"]
        return texts

    assert failed(figures) == []
    assert failed(left_out) == [f"rot_rmse_deg: expected at most 15, found none: {why}"]
    assert failed(left_out, rot_rmse_deg=1.0) == ["rot_rmse_deg: expected at most 1, found none"]
    assert failed(left_out, rot_rmse_deg=math.inf) == []
    assert failed(left_out | {"orientations": "truth without"}) == []
    none = left_out | {"orientations": "estimate without"}
    assert len(failed(none)) == 1
    # Many files have positions only, and may; none has to have what is wrong.
    for est, count in ((none, 0), (left_out, 1)):
        of_file = conclude({"est": est}, Thresholds())["estimators"]["est"]
        assert len(of_file["failed"]) == count


@pytest.mark.parametrize(
    ("poses", "offset", "percent"),
    [
        (IMAGES, 0, 100.0),
        (IMAGES + 900_000, 0, 100.0),
        (IMAGES + 4_900_000, 0, 100.0),  # a tenth of the period
        (IMAGES + 5_100_000, 0, 0.0),
        (IMAGES - 4_900_000, 0, 100.0),
        (IMAGES + 15 * MS, 0, 0.0),  # of the arrival
        (IMAGES + 15 * MS, -10 * MS, 100.0),
        (IMAGES + 15 * MS, 9 * MS, 0.0),
        (np.arange(5 * MS, 12 * SECOND, 33 * MS), 0, 100.0),  # as dense as two of three images
        (IMAGES + 15 * MS, 15 * MS, 100.0),  # as the camera's clock has them
        (IMAGES[::7], 0, 100.0),
        (np.arange(0, 12 * SECOND, 7 * MS), 0, 100.0),  # of the samples of an IMU
        (IMAGES + np.arange(len(IMAGES)) % 2 * 15 * MS, 0, 50.0),
        (IMAGES[:0], 0, None),
        (IMAGES + 10**12, 0, None),
    ],
)
def test_poses_are_stamped_as_images_are(
    poses: npt.NDArray[np.int64], offset: int, percent: float | None
) -> None:
    assert at_images(IMAGES, poses, offset) == percent


def test_a_pose_that_came_before_its_image_is_none_of_it() -> None:
    """Arrivals may fall on later images: 52 ms after every 50 ms."""
    late = np.full(len(IMAGES), 52 * MS)
    assert at_images(IMAGES, IMAGES, 0, late, 40 * MS) == 100.0
    arrived = IMAGES + late
    assert at_images(IMAGES, arrived) == 100.0
    assert at_images(IMAGES, arrived, 0, late * 0, 40 * MS) == 0.0
    assert at_images(IMAGES, arrived, 0, late * 0, 0) == 100.0  # of no latency nothing is known
    inertial = np.arange(0, 12 * SECOND, 5 * MS)
    assert at_images(IMAGES, inertial, 0, inertial * 0, 40 * MS) == 100.0


def test_velocities_are_held_against_the_speed() -> None:
    true = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 5.0]])
    assert velocity_error_percent(np.array([1.0, 1.0]), true) == pytest.approx(20.0)
    assert velocity_error_percent(np.linalg.norm(true, axis=1), true) == pytest.approx(100.0)
    assert velocity_error_percent(np.ones(2), 0.01 * true) is None  # it stood


def test_covariances_too_large_say_nothing() -> None:
    """Uniformly random rotations have an RMS angle of 131.8°; 10 m are never too uncertain."""
    angle = Rotation.random(20_000, rng=np.random.default_rng(1)).magnitude()
    limit = math.sqrt(np.mean(angle**2))
    assert math.degrees(limit) == pytest.approx(131.8, abs=0.5)

    def share(position: float, orientation: float, path: float = 5.0) -> float:
        diagonal = [position**2 / 3] * 3 + [orientation**2 / 3] * 3
        return too_large_percent(np.array([np.diag(diagonal), np.eye(6)]), path)

    assert share(9.9, 2.29) == 0.0
    assert share(10.1, 0.1) == 50.0
    assert share(10.1, 0.1, path=11.0) == 0.0
    assert share(0.1, 1.01 * limit) == 50.0
    assert share(math.nan, 0.1) == 0.0  # it is none: `covariance_invalid`
