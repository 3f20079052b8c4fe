"""An estimator that loses its map begins another: that with most poses is judged."""

import numpy as np
import pytest

from events import PoseEstimate
from nodes.judging.evaluation.judging import judge
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.trajectory import Trajectory
from runtime.time.clock import SECOND

STEP = 50_000_000
STAMPS = np.arange(0, 20 * SECOND + 1, STEP)
SECONDS = STAMPS / SECOND
PLACES = np.stack([np.cos(SECONDS / 3), np.sin(SECONDS / 3), -0.05 * SECONDS], axis=1)
TURNS = np.stack([np.cos(SECONDS / 9), *np.zeros((2, len(STAMPS))), np.sin(SECONDS / 9)], axis=1)
TRUTH = Trajectory(STAMPS, PLACES, TURNS)


def record_of(
    lost_at: float, scales: tuple[float, float], scale_free: bool = True
) -> EstimatorRecord:
    """Return the record of an estimator whose second map, in another unit, begins at a second."""
    record = EstimatorRecord(scale_free)
    for stamp, place, turn in zip(STAMPS.tolist(), PLACES, TURNS.tolist(), strict=True):
        second = stamp >= lost_at * SECOND
        x, y, z = (scales[second] * place).tolist()
        w, _, _, heading = turn
        event = PoseEstimate(
            stamp=stamp, source="vo", frame_id="odom_1" if second else "odom",
            position=(x, y, z), orientation=(w, 0.0, 0.0, heading),
        )  # fmt: skip
        record.add(event, stamp + 1)
    return record


@pytest.mark.parametrize(
    ("lost_at", "frame", "share"), [(1.0, "odom_1", 0.95), (16.0, "odom", 0.8)]
)
def test_the_longer_map_is_judged_whichever_comes_first(
    lost_at: float, frame: str, share: float
) -> None:
    judgement = judge(record_of(lost_at, (0.4, 3.0)), TRUTH, cameras={"c": STAMPS})
    figures = judgement.figures
    assert figures["ate_rmse_m"] < 1e-6
    assert figures["restarts"] == 1
    assert figures["frame_coverage_percent"] == pytest.approx(100 * share, abs=0.3)
    assert f"in '{frame}', most of those in 2 frames" in judgement.note


def test_what_is_lost_before_the_longer_map_counts_over_the_whole_flight() -> None:
    whole = judge(record_of(0.0, (1.0, 3.0)), TRUTH, cameras={"c": STAMPS})
    late = judge(record_of(5.0, (1.0, 3.0)), TRUTH, cameras={"c": STAMPS})
    assert whole.figures["flight_ate_percent"] < 1e-6
    assert late.figures["flight_ate_percent"] > 5.0
    assert late.figures["lost_seconds"] == pytest.approx(5.0)
    assert not whole.note
    assert "left out" in late.note


def test_a_scale_between_maps_is_none_of_the_error() -> None:
    """One trajectory of both maps, as if they had one unit, would be lost."""
    figures = judge(record_of(10.5, (1.0, 3.0)), TRUTH, cameras={"c": STAMPS}).figures
    assert figures["ate_rmse_m"] < 1e-6
    assert figures["compared"] == 210
