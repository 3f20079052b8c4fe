"""No estimator looks better by giving up: in each pair the worse one has the worse figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings

from nodes.judging.evaluation.judging import held_errors, interpolated_errors, judge, to_planned_end
from nodes.judging.evaluation.record import EstimatorRecord, Interval, cover
from nodes.trajectory import Trajectory
from tests.nodes.judging.evaluation.flights import (
    MS,
    SECOND,
    estimate,
    heading,
    lost,
    place,
    regained,
)

SECONDS = 20
END = SECONDS * SECOND
FRAMES = np.arange(0, END + 1, 50 * MS)
GAP = SECOND // 2

Say = Callable[[EstimatorRecord, int, float], None]
"""Adds what an estimator says of an image: record, stamp (ns), share of the flight."""


def flight() -> Trajectory:
    """Two rounds on a circle of 2 m radius, 25 m in all: it ends where it began."""
    stamps = np.arange(0, END + 1, 5 * MS)
    places = [place(int(stamp)) for stamp in stamps]
    return Trajectory(stamps, np.array(places), np.array([heading(int(s)) for s in stamps]))


TRUTH = flight()
PATH = TRUTH.length()


def drifts(percent: float) -> Say:
    """Be off by so many percent of the path flown, to the side."""

    def say(record: EstimatorRecord, stamp: int, share: float) -> None:
        error = (0.0, 0.0, percent / 100 * share * PATH)
        record.add(estimate(stamp, error=error), stamp + MS)

    return say


def until(share: float, say: Say) -> Say:
    return lambda record, stamp, now: say(record, stamp, now) if now < share else None


def after(share: float, say: Say) -> Say:
    return lambda record, stamp, now: say(record, stamp, now) if now >= share else None


def silent(start: float, end: float, say: Say) -> Say:
    return lambda record, stamp, now: None if start < now < end else say(record, stamp, now)


def stuck(record: EstimatorRecord, stamp: int, share: float) -> None:
    """Repeat the first place for ever: it is as far off as the circle is wide."""
    x, y, z = place(stamp)
    first = place(0)
    record.add(estimate(stamp, error=(first[0] - x, first[1] - y, first[2] - z)), stamp + MS)


def in_a_new_frame(share: float) -> Say:
    """Begin anew in a frame of its own, without an error."""

    def say(record: EstimatorRecord, stamp: int, now: float) -> None:
        record.add(estimate(stamp, frame_id="map" if now < share else "odom_1"), stamp + MS)

    return say


def judged(say: Say, scale_free: bool = False, **options: Any) -> dict[str, Any]:
    record = EstimatorRecord(scale_free)
    for stamp in FRAMES.tolist():
        say(record, stamp, stamp / END)
    return judge(record, TRUTH, cameras={"c": FRAMES}, **options).figures


def nothing(record: EstimatorRecord, stamp: int, share: float) -> None:
    """Say nothing."""


PAIRS: dict[str, tuple[Say, Say]] = {
    "gives up half-way; drifts by 2 %": (until(0.5, drifts(0)), drifts(2)),
    "gives up half-way; drifts by 30 %": (until(0.5, drifts(0)), drifts(30)),
    "gives up earlier; later": (until(0.4, drifts(0)), until(0.6, drifts(0))),
    "gives up at the end; does not": (until(0.95, drifts(1)), drifts(1)),
    "never starts; drifts by 50 %": (nothing, drifts(50)),
    "never starts; starts half-way": (nothing, after(0.5, drifts(0))),
    "says one pose; drifts by 50 %": (until(0.001, drifts(0)), drifts(50)),
    "starts late; drifts by 2 %": (after(0.3, drifts(0)), drifts(2)),
    "restarts in a new frame; drifts by 2 %": (in_a_new_frame(0.5), drifts(2)),
    "restarts half-way; early": (in_a_new_frame(0.5), in_a_new_frame(0.3)),
    "restarts half-way; late": (in_a_new_frame(0.5), in_a_new_frame(0.7)),
    "is silent for a while; drifts by 2 %": (silent(0.4, 0.6, drifts(0)), drifts(2)),
    "is silent for longer": (silent(0.3, 0.6, drifts(1)), silent(0.4, 0.5, drifts(1))),
    "never starts; repeats the first place": (nothing, stuck),
    "drifts more; less": (drifts(3), drifts(2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_the_worse_one_looks_worse(pair: str) -> None:
    worse, better = (judged(say) for say in PAIRS[pair])
    assert worse["flight_ate_percent"] > 1.05 * better["flight_ate_percent"]


def test_the_figures_are_those_of_the_page() -> None:
    assert judged(nothing)["flight_ate_percent"] == pytest.approx(100 / np.sqrt(3), rel=0.01)
    assert judged(until(0.5, drifts(0)))["flight_ate_percent"] == pytest.approx(20.4, rel=0.02)
    assert judged(drifts(2))["flight_ate_percent"] == pytest.approx(2 / np.sqrt(3), rel=0.01)


def test_without_a_loss_it_is_the_absolute_error() -> None:
    for percent in (0.5, 7.0):
        figures = judged(drifts(percent))
        # But for the last image, whose answer may still be on its way.
        assert figures["flight_ate_rmse_m"] == pytest.approx(figures["ate_rmse_m"], rel=0.005)
        assert figures["flight_ate_percent"] == pytest.approx(figures["ate_percent"], rel=0.005)


def test_a_slow_estimator_that_is_not_lost_is_not_charged() -> None:
    """Two poses a second of twenty images: rate and latency have figures of their own."""
    every_tenth: Say = lambda r, s, now: drifts(1)(r, s, now) if s % (500 * MS) == 0 else None  # noqa: E731
    assert judged(every_tenth)["lost_seconds"] == 0.0
    assert judged(every_tenth)["flight_ate_percent"] == pytest.approx(
        judged(drifts(1))["flight_ate_percent"], rel=0.02
    )


@pytest.mark.parametrize("poses", [3, 4, 10])
def test_an_alignment_of_few_poses_hides_nothing(poses: int) -> None:
    """Sim(3) lays three poses on any others: the absolute error is nothing, the flight is lost."""
    few = until(poses * 50 * MS / END - 1e-6, drifts(30))
    figures = judged(few, scale_free=True)
    assert figures["estimates"] == poses
    assert figures["alignment"] == "sim3"
    assert figures["ate_percent"] < 0.01
    assert figures["flight_ate_percent"] > 50.0


def test_what_sim3_shrinks_to_a_point_is_no_motion() -> None:
    random = np.random.default_rng(3)

    def garbage(record: EstimatorRecord, stamp: int, share: float) -> None:
        x, y, z = random.normal(0.0, 100.0, 3).tolist()
        record.add(estimate(stamp, error=(x, y, z)), stamp + MS)

    figures = judged(garbage, scale_free=True)
    assert figures["rpe_mean_trans_percent"] > 80.0
    assert figures["flight_ate_percent"] > 5.0


def test_poses_on_a_line_that_cannot_be_aligned_count_as_none() -> None:
    def along(record: EstimatorRecord, stamp: int, share: float) -> None:
        x, y, z = place(stamp)
        record.add(estimate(stamp, error=(share - x, -y, -z)), stamp + MS)

    figures = judged(along, scale_free=True)
    assert figures["alignment"] == "sim3"
    assert figures["why"].startswith("alignment: expected ")
    assert not figures["why"].endswith("None")
    assert figures["flight_ate_percent"] == pytest.approx(57.8, abs=0.1)


def test_initialization_takes_until_the_first_pose_or_the_whole_flight() -> None:
    assert judged(drifts(0))["initialization_seconds"] == 0.0
    assert judged(after(0.25, drifts(0)))["initialization_seconds"] == pytest.approx(5.0)
    record = EstimatorRecord.of(TRUTH.take(TRUTH.stamps >= 6 * SECOND))
    later = FRAMES[FRAMES >= 5 * SECOND]
    figures = judge(record, TRUTH, cameras={"c": later}).figures
    assert figures["initialization_seconds"] == pytest.approx(1.0)
    assert judged(nothing)["initialization_seconds"] == pytest.approx(SECONDS, abs=0.1)


def test_relocalization_takes_until_there_is_a_pose_again_or_to_the_end() -> None:
    assert "relocalization_max_seconds" not in judged(drifts(0))
    assert "relocalization_max_seconds" not in judged(after(0.25, drifts(0)))
    twice = silent(0.2, 0.3, silent(0.6, 0.8, drifts(0)))
    figures = judged(twice)
    assert figures["relocalization_max_seconds"] == pytest.approx(4.0, abs=0.11)
    assert figures["relocalization_p50_seconds"] == pytest.approx(3.0, abs=0.11)
    for share in (0.25, 1e-3):  # which is one pose
        figures = judged(until(share, drifts(0)))
        lasts = (1.0 - share) * SECONDS
        assert figures["relocalization_max_seconds"] == pytest.approx(lasts, abs=0.11)


def test_a_reported_loss_is_charged_only_where_there_is_no_pose() -> None:
    def says_so(keeps_on: bool) -> Say:
        def say(record: EstimatorRecord, stamp: int, share: float) -> None:
            if stamp == 5 * SECOND:
                record.add_tracking(lost(stamp), stamp)
            if stamp == 7 * SECOND:
                record.add_tracking(regained(stamp), stamp)
            if keeps_on or not 5 * SECOND < stamp < 7 * SECOND:
                drifts(0)(record, stamp, share)

        return say

    honest, quiet = judged(says_so(keeps_on=True)), judged(says_so(keeps_on=False))
    assert honest["lost_seconds"] == quiet["lost_seconds"] == pytest.approx(2.0)
    assert honest["flight_ate_percent"] < 1e-9
    assert quiet["flight_ate_percent"] > 1.0


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("percent", [0, 2])
def test_an_early_end_costs_as_much_as_giving_up(share: float, percent: float) -> None:
    """The path that is not flown is as long as it would be at the speed so far."""
    given_up = judged(until(share, drifts(percent)))
    stop = round(share * END)
    record = EstimatorRecord()
    for stamp in FRAMES[stop > FRAMES].tolist():
        drifts(percent)(record, stamp, stamp / END)
    flown = TRUTH.take(TRUTH.stamps <= stop)
    frames = FRAMES[stop >= FRAMES]
    cut = judge(record, flown, cameras={"c": frames}, end=stop, planned=END).figures
    assert cut["path_m"] == pytest.approx(share * PATH, rel=0.01)
    for name in ("flight_ate_rmse_m", "flight_ate_percent"):
        assert cut[name] == pytest.approx(given_up[name], rel=0.05)  # an image more of 40
    assert cut["lost_seconds"] == pytest.approx((1.0 - share) * SECONDS, abs=0.2)


def test_the_error_to_the_planned_end_is_that_of_the_images_one_by_one() -> None:
    random = np.random.default_rng(2)
    frames = np.arange(20) * 50 * MS
    errors = random.uniform(0.0, 1.0, 20)
    planned = int(frames[-1]) + 10 * 50 * MS
    lengths = errors[-1] + 19.0 * np.arange(1, 11) / 19  # 19 m in 19 periods so far
    every = np.concatenate([errors, lengths])
    error = to_planned_end(errors, 19.0, frames, planned)
    assert error == pytest.approx((np.sqrt(np.mean(every**2)), 29.0))
    usual = pytest.approx((np.sqrt(np.mean(errors**2)), 19.0))
    for end in (None, int(frames[-1]), int(frames[3])):
        assert to_planned_end(errors, 19.0, frames, end) == usual
    assert to_planned_end(errors[:1], 19.0, frames[:1], planned) == (errors[0], 19.0)
    far = to_planned_end(errors, 19.0, frames, 10**18)  # in no time, in no memory
    assert far[0] / far[1] == pytest.approx(1 / np.sqrt(3), rel=1e-3)


def test_a_trajectory_after_loop_closures_ends_early_with_its_flight() -> None:
    stop = END // 2
    flown = TRUTH.take(TRUTH.stamps <= stop)
    record = EstimatorRecord.of(flown)
    record.final, record.final_frame_id = flown, "map"
    figures = judge(
        record, flown, cameras={"c": FRAMES[stop >= FRAMES]}, end=stop, planned=END
    ).figures
    assert figures["final_flight_ate_percent"] == pytest.approx(20.4, rel=0.02)


stamps = st.lists(st.integers(0, 200), max_size=30, unique=True)


@pytest.mark.slow
@given(said=stamps, percent=st.floats(0.0, 20.0))
@settings(deadline=None, max_examples=60)
def test_to_say_less_never_looks_better(said: list[int], percent: float) -> None:
    """Of two with the same drift, the one that falls silent earlier has no smaller error."""
    poses = np.array(sorted(said), np.int64) * 100 * MS
    errors: npt.NDArray[np.float64] = percent / 100 * PATH * (poses / END)

    def root(count: int) -> float:
        kept = poses[:count]
        gaps = cover(FRAMES, kept, GAP).lost
        held = held_errors(TRUTH, FRAMES, kept, errors[:count], gaps)
        assert len(held) == len(FRAMES)
        assert (held >= 0.0).all()
        return float(np.sqrt(np.mean(held**2)))

    every = [root(count) for count in range(len(poses) + 1)]
    assert (np.diff(every) <= 0.05 * PATH / 100).all()  # of an image within the gap at the end


SPEED = PATH / SECONDS


def test_an_image_without_a_pose_has_the_error_of_the_nearest_the_earlier_of_two() -> None:
    poses = FRAMES[::10]
    held = held_errors(TRUTH, FRAMES, poses, np.arange(len(poses), dtype=float), [])
    assert held.tolist() == [(k + 4) // 10 for k in range(len(FRAMES))]
    assert (held_errors(TRUTH, FRAMES, poses[:1], np.full(1, 2.0), []) == 2.0).all()


def test_while_lost_the_path_is_added_to_the_last_error_and_before_the_first_to_none() -> None:
    poses, flown = FRAMES[[100, 200]], SPEED * FRAMES / SECOND
    lost_all = [Interval(0, END)]
    never = held_errors(TRUTH, FRAMES[100:], poses[:0], np.zeros(0), lost_all)
    np.testing.assert_allclose(never, flown[:301], atol=1e-3)
    held = held_errors(TRUTH, FRAMES, poses, np.array([2.0, 3.0]), lost_all)
    np.testing.assert_allclose(held[:100], flown[:100], atol=1e-3)
    np.testing.assert_allclose(held[100:200], 2.0 + flown[:100], atol=1e-3)
    np.testing.assert_allclose(held[200:], 3.0 + flown[:201], atol=1e-3)


def test_within_a_loss_images_with_a_pose_of_their_own_have_its_error() -> None:
    """Also those whose pose is of a little later."""
    held = held_errors(TRUTH, FRAMES, FRAMES + 10 * MS, np.ones(len(FRAMES)), [Interval(0, END)])
    assert (held == 1.0).all()


def test_a_vehicle_that_stands_has_no_errors_in_percent() -> None:
    stands = Trajectory(TRUTH.stamps, np.ones((len(TRUTH), 3)), TRUTH.orientations)
    record = EstimatorRecord.of(stands, "map")
    record.final_frame_id = "map"
    record.final = stands
    figures = judge(record, stands, cameras={"c": FRAMES}).figures
    for prefix in ("", "final_", "flight_", "final_flight_"):
        assert figures[f"{prefix}ate_rmse_m"] == 0.0
        assert figures[f"{prefix}ate_percent"] is None


def test_of_an_images_poses_the_worst_counts() -> None:
    poses = np.sort(np.concatenate([FRAMES, FRAMES + MS]))
    for errors in ([3.0, 1.0], [1.0, 3.0]):
        held = held_errors(TRUTH, FRAMES, poses, np.tile(errors, len(FRAMES)), [])
        assert (held == 3.0).all()


def delayed(by: int, until: int = END, step: int = 1) -> dict[str, Any]:
    """Return the figures of an exact estimator with so long a delay (ns), silent from a time on."""
    record = EstimatorRecord()
    for stamp in FRAMES[until >= FRAMES][::step].tolist():
        record.add(estimate(stamp), stamp + by)
    return judge(record, TRUTH, cameras={"c": FRAMES}).figures


@pytest.mark.parametrize("step", [1, 10])
def test_more_than_five_answered_images_late_is_not_causal(step: int) -> None:
    limit = 5 * step * 50 * MS
    in_time = delayed(limit, step=step)
    assert (in_time["not_causal"], in_time["latency_p50_ms"]) == (0, limit / MS)
    late = delayed(limit + 1, step=step)
    assert (late["not_causal"], late["not_causal_percent"]) == (late["estimates"], 100.0)


@pytest.mark.parametrize(("by", "lost"), [(300 * MS, 0.9), (2 * SECOND, 0.7)])
def test_last_images_without_an_answer_are_forgiven_up_to_the_gap(by: int, lost: float) -> None:
    assert delayed(by, END - 1200 * MS)["lost_seconds"] == pytest.approx(lost)


def test_errors_of_no_image_are_none() -> None:
    none = FRAMES[:0]
    assert held_errors(TRUTH, none, FRAMES, np.zeros(len(FRAMES)), []).shape == (0,)
    assert held_errors(TRUTH, none, none, np.zeros(0), []).shape == (0,)
    assert interpolated_errors(TRUTH, none, TRUTH).shape == (0,)


def test_images_after_the_truths_time_have_no_error() -> None:
    record = EstimatorRecord()
    for stamp in FRAMES.tolist():
        drifts(2)(record, stamp, stamp / END)
    figures = judge(record, TRUTH, cameras={"c": FRAMES + 2 * END}).figures
    assert figures["flight_ate_rmse_m"] is None
    assert figures["ate_rmse_m"] > 0.0


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    start=st.integers(1, SECONDS * 10 - 40),
    length=st.integers(4, 39),
    hole=st.integers(20, 30),
)
def test_where_no_truth_is_known_nothing_is_held_against_anybody(
    start: int, length: int, hole: int
) -> None:
    """Tenths of a second without a truth, in which the circle is no straight line."""
    record = EstimatorRecord()
    for stamp in FRAMES.tolist():
        drifts(2)(record, stamp, stamp / END)
    known = (TRUTH.stamps <= start * 100 * MS) | (TRUTH.stamps >= (start + length) * 100 * MS)
    rest, most = TRUTH.take(known), hole * 10 * MS
    result = judge(record, rest, cameras={"c": FRAMES}, hole=most)
    compared = rest.covers(FRAMES, most)
    assert result.figures["compared"] == compared.sum() == len(FRAMES) - (2 * length - 1)
    errors = 0.02 * PATH * FRAMES[compared] / END
    assert result.figures["ate_rmse_m"] == pytest.approx(np.sqrt((errors**2).mean()))
    assert result.figures["flight_ate_rmse_m"] == pytest.approx(
        result.figures["ate_rmse_m"], rel=0.01
    )
    assert result.figures["newest_pose_rmse_m"] < 0.05 * PATH
    assert (result.figures["lost_seconds"], result.figures["coverage_percent"]) == (0.0, 100.0)
    assert f"{2 * length - 1} between true poses more than {hole / 100:g} s apart" in result.note
    made_up = judge(record, rest, cameras={"c": FRAMES}, hole=END)
    assert (made_up.figures["compared"], made_up.note) == (len(FRAMES), "")
    assert made_up.figures["ate_rmse_m"] != result.figures["ate_rmse_m"]
