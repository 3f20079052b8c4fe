"""What counts as lost, and how much of a flight was covered."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import PoseEstimate, TrackingLost
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.record import (
    EstimatorRecord,
    Interval,
    answered,
    choose_camera,
    choose_frames,
    cover,
    seconds,
    union,
)
from tests.nodes.judging.evaluation.flights import estimate
from tests.nodes.judging.report.folders import walk

MS = 1_000_000
SECOND = 1000 * MS
GAP = 500 * MS

FRAMES = np.arange(0, 12 * SECOND, 50 * MS)


def lost(poses: npt.NDArray[np.int64], frames: npt.NDArray[np.int64] = FRAMES) -> float:
    return seconds(cover(frames, poses, GAP).lost)


def test_silence_counts_at_the_start_in_the_middle_and_at_the_end() -> None:
    last = FRAMES[-1] / SECOND
    assert lost(FRAMES) == 0.0
    assert lost(FRAMES[FRAMES >= 2 * SECOND]) == pytest.approx(2.0)
    assert lost(FRAMES[FRAMES <= 9 * SECOND]) == pytest.approx(last - 9.0)
    middle = (FRAMES <= 4 * SECOND) | (FRAMES >= 8 * SECOND)
    assert lost(FRAMES[middle]) == pytest.approx(4.0)
    assert lost(FRAMES[:0]) == pytest.approx(last)


def test_a_slow_camera_makes_nobody_lost() -> None:
    frames = np.arange(0, 10 * SECOND, SECOND)
    assert lost(frames, frames) == 0.0
    assert lost(np.delete(frames, 5), frames) == pytest.approx(2.0)


def test_what_it_said_of_itself_counts_within_the_flight() -> None:
    said = [
        Interval(-SECOND, SECOND),
        Interval(3 * SECOND, 4 * SECOND),
        Interval(11 * SECOND, 10**15),
    ]
    coverage = cover(FRAMES, FRAMES, GAP, said)
    assert seconds(coverage.lost) == pytest.approx(1.0 + 1.0 + FRAMES[-1] / SECOND - 11.0)
    instants = [Interval(5 * SECOND, 5 * SECOND), Interval(-2, -1), Interval(10**15, 10**16)]
    assert cover(FRAMES, FRAMES, GAP, instants).lost == []


def test_images_missing_after_an_early_end_have_no_pose() -> None:
    frames = FRAMES + 7 * SECOND
    last = int(frames[-1])
    planned = last + 120 * SECOND
    coverage = cover(frames, frames, GAP, planned=planned)
    assert coverage.flight == (7 * SECOND, planned)
    assert (coverage.frames, coverage.answered) == (len(frames) + 2400, len(frames))
    assert coverage.lost == [(last, planned)]
    flown = float(np.ptp(FRAMES)) / SECOND
    assert coverage.percent == pytest.approx(100.0 * flown / (flown + 120.0))
    for end in (None, last, last - SECOND):
        assert cover(frames, frames, GAP, planned=end) == cover(frames, frames, GAP)


def test_poses_before_and_after_the_flight_cover_nothing_of_it() -> None:
    outside = np.array([-5 * SECOND, -MS, 20 * SECOND])
    assert cover(FRAMES, outside, GAP).lost == [(0, FRAMES[-1])]


def test_without_a_pose_nothing_is_covered_also_of_a_single_image() -> None:
    for frames in (FRAMES, FRAMES[:1]):
        nothing, everything = (cover(frames, poses, GAP) for poses in (FRAMES[:0], FRAMES))
        assert (nothing.percent, nothing.frames_percent) == (0.0, 0.0)
        assert (everything.percent, everything.frames_percent) == (100.0, 100.0)
    assert cover(FRAMES[:1], FRAMES, GAP, planned=SECOND).flight == (0, 0)  # at no known rate


def test_judged_is_the_frame_of_most_poses_and_of_equal_ones_the_first() -> None:
    record = EstimatorRecord()
    grown = [
        record.add(estimate(k * MS, frame_id=frame), k * MS)
        for k, frame in enumerate(["odom", "odom", "map", "map", "odom", "map"])
    ]
    assert grown == [True, True, False, False, True, False]
    assert (record.longest.frame_id, record.restarts) == ("odom", 2)
    assert record.stamps().tolist() == record.arrivals().tolist() == [0, MS, 4 * MS]
    assert record.longest.bodies == {"base_link": 3}
    assert record.elsewhere() == (
        "judged are the 3 poses in 'odom', most of those in 2 frames; 3 in others are left out"
    )
    assert record.add(estimate(6 * MS, frame_id="map"), 6 * MS) is True
    assert record.stamps().tolist() == [2 * MS, 3 * MS, 5 * MS, 6 * MS]
    assert record.add(estimate(5 * MS), 9 * MS) is False
    assert record.repeated == 1


def test_intervals_that_touch_or_overlap_are_one() -> None:
    intervals = [Interval(7, 8), Interval(1, 2), Interval(0, 1), Interval(4, 6), Interval(5, 5)]
    assert union(intervals) == [(0, 2), (4, 6), (7, 8)]


@pytest.mark.parametrize(("ahead", "future"), [(MS, 0), (MS + 1, 1)])
def test_stamps_are_of_the_future_from_a_millisecond_on(ahead: int, future: int) -> None:
    record = EstimatorRecord()
    assert record.add(estimate(SECOND + ahead), SECOND) is (not future)
    record.add_tracking(TrackingLost(stamp=2 * SECOND + ahead, source="est", reason=""), 2 * SECOND)
    assert record.future == 2 * future
    assert record.reported_lost(3 * SECOND) == [(2 * SECOND + MS, 3 * SECOND)]


def test_images_are_answered_by_poses_of_their_time() -> None:
    shifted = FRAMES + 20 * MS
    assert answered(FRAMES, shifted).all()
    assert answered(FRAMES, FRAMES[::5]).mean() == pytest.approx(0.2)
    assert not answered(FRAMES, FRAMES + 10**12).any()


def test_a_pose_answers_one_image() -> None:
    midway = FRAMES[:-1] + 25 * MS
    assert answered(FRAMES, midway[::2]).mean() == pytest.approx(0.5)
    assert answered(FRAMES, midway[:1]).tolist()[:3] == [True, False, False]
    assert answered(FRAMES, FRAMES[:1] + 26 * MS).tolist()[:3] == [False, True, False]
    twice = np.sort(np.append(FRAMES[::2], FRAMES[::2] + MS))
    assert answered(FRAMES, twice).mean() == pytest.approx(0.5)


SLOW, QUICK = np.arange(0, 10 * SECOND, 100 * MS), np.arange(0, 10 * SECOND, 10 * MS)
CAMERAS = {"quick": QUICK, "slow": SLOW}


def test_the_camera_is_the_one_whose_stamps_the_poses_have() -> None:
    for cameras in (CAMERAS, dict(reversed(CAMERAS.items()))):
        assert choose_camera(cameras, QUICK[1::2]) == "quick"
        assert choose_camera(cameras, SLOW) == "slow"
        assert choose_camera(cameras, np.delete(SLOW, [3, 7])) == "slow"
        assert choose_camera(cameras, np.delete(QUICK, range(0, 900, 20))) == "quick"
        assert choose_camera(cameras, QUICK + 1000) == "quick"  # stamps through a double
        assert choose_camera(cameras, QUICK[:0]) == "quick"
        assert choose_camera(cameras, SLOW, {"quick"}) == "quick"
        assert choose_camera(cameras, QUICK, {"slow"}) == "slow"
        assert choose_camera(cameras, SLOW, {"of depth only"}) == "slow"
    late = {"one is missing": np.append(SLOW, 10 * SECOND), "late": SLOW + 3 * MS}
    assert choose_camera(late, SLOW + MS) == "one is missing"
    assert choose_camera(late, SLOW + MS + 1) == "late"
    assert choose_camera({"c/grey": SLOW, "d": QUICK}, QUICK, {"c"}) == "c/grey"
    assert choose_camera({"c": SLOW[:0]}, SLOW) is choose_camera({}, SLOW) is None
    assert choose_frames(CAMERAS, SLOW) is SLOW
    assert choose_frames({}, SLOW) is None


@pytest.mark.parametrize("rates", [(30, 20), (30, 10), (60, 30), (30, 29)])
def test_of_cameras_that_are_triggered_together_the_estimators_own_is_covered(
    rates: tuple[int, int],
) -> None:
    cameras = {str(r): np.array([round(k * SECOND / r) for k in range(10 * r)]) for r in rates}
    for rate, stamps in cameras.items():
        assert choose_camera(cameras, stamps) == rate
        own = choose_frames(cameras, stamps)
        assert own is not None
        assert cover(own, stamps, GAP).frames_percent == 100.0


@st.composite
def flights(draw: st.DrawFn) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    steps = draw(st.lists(st.integers(1, 900), min_size=1, max_size=40))
    frames = np.cumsum(steps).astype(np.int64) * MS
    kept = draw(st.lists(st.booleans(), min_size=len(frames), max_size=len(frames)))
    return frames, np.array(kept)


@given(flights())
def test_every_image_without_a_pose_for_longer_than_the_gap_is_in_a_lost_interval(
    flight: tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]],
) -> None:
    frames, kept = flight
    poses = frames[kept]
    coverage = cover(frames, poses, GAP)
    edges = [int(frames[0]), *poses.tolist(), int(frames[-1])]
    has_pose = answered(frames, poses)
    for stamp in frames[~has_pose].tolist():
        before = max(edge for edge in edges if edge <= stamp)
        after = min(edge for edge in edges if edge >= stamp)
        inside = any(start <= stamp <= end for start, end in coverage.lost)
        assert inside or after - before <= GAP
    for start, end in coverage.lost:
        assert end - start > GAP
        assert (~has_pose[(frames >= start) & (frames <= end)]).any()
    assert 0.0 <= coverage.percent <= 100.0


@given(flights(), st.lists(st.integers(0, 40 * 900 * MS), max_size=60, unique=True))
def test_each_pose_answers_the_nearest_image_and_no_other(
    flight: tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]], said: list[int]
) -> None:
    frames, poses = flight[0], np.array(sorted(said), np.int64)
    has_pose = answered(frames, poses)
    period = int(np.median(np.diff(frames))) if len(frames) > 1 else 0
    expected = set()
    for pose in poses.tolist():
        nearest = int(np.argmin(abs(frames - pose)))  # the first of two
        if 2 * abs(int(frames[nearest]) - pose) <= period:
            expected.add(nearest)
    assert {*np.flatnonzero(has_pose).tolist()} == expected
    assert has_pose.sum() <= len(poses)


@pytest.mark.slow
@given(flights(), st.data())
def test_saying_less_never_looks_better(
    flight: tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]], data: st.DataObject
) -> None:
    frames, kept = flight
    poses = frames[kept]
    fewer = poses[np.array([data.draw(st.booleans()) for _ in poses], dtype=bool)]
    more, less = cover(frames, poses, GAP), cover(frames, fewer, GAP)
    assert less.percent <= more.percent
    assert less.answered <= more.answered
    assert seconds(less.lost) >= seconds(more.lost)


@pytest.mark.parametrize("late", [0.015, 0.3, 4.0])
def test_being_late_hides_no_silence(late: float) -> None:
    """One image on which it stood for four seconds makes no later silence shorter."""
    truth = walk(12)
    record = EstimatorRecord()
    for stamp in range(0, 12 * SECOND, 50 * MS):
        if 5 * SECOND < stamp < 7 * SECOND:
            continue
        delay = round((late if stamp == 5 * SECOND else 0.015) * SECOND)
        x, y, z = truth.positions[truth.stamps.searchsorted(stamp)].tolist()
        q = (1.0, 0.0, 0.0, 0.0)
        event = PoseEstimate(stamp=stamp, source="e", position=(x, y, z), orientation=q)
        record.add(event, stamp + delay)
    figures = judge(record, truth, end=12 * SECOND).figures
    assert figures["lost_seconds"] == pytest.approx(2.0)
    assert figures["coverage_percent"] == pytest.approx(100 * 10 / 12, abs=0.1)
