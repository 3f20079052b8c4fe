"""The benchmarks of the bridge to ROS 2."""

from __future__ import annotations

import pytest

from bench import bridge, flood, lateness
from bench.lateness import Beat, Window


def test_both_encoders_are_measured_and_compared() -> None:
    """A row for each kind of image; that both make the same bytes is checked while warming up."""
    rows = bridge.measure_ros_images(repeats=5)
    assert [row["case"] for row in rows] == ["512×512 rgb8", "512×512 32FC1"]
    for row, size in zip(rows, (3, 4), strict=True):
        assert row["samples"] == 5
        assert 0 < row["bytes"] - 512 * 512 * size < 200
        assert row["ratio"] == pytest.approx(row["ours_us"] / row["rosbags_us"])
        assert 0.0 < row["ours_us"] <= row["ours_p99_us"]


def test_each_flooded_window_is_compared_with_the_quiet_one_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A window in which all was slow weighs no more than any other, and edges are left out."""
    second, ticks = 10**9, []
    for window, late in enumerate([100, 120, 5000, 6000, 100, 130]):
        ticks += [(window * second + n * 2_500_000, late * 1000) for n in range(400)]
        ticks.append((window * second + 1_000_000, 10**9))
    monkeypatch.setattr(lateness, "BEATS", [Beat(at, at, late, 0) for at, late in ticks])
    windows = [Window(w * second, (w + 1) * second, 10_000 * (w % 2)) for w in range(6)]
    row = flood._row("flood", windows[1::2], windows[0::2])
    assert (row["late_p50_us"], row["late_p99_us"], row["late_max_us"]) == (130.0, 130.0, 6000.0)
    assert row["ratio_p50"] == row["ratio_p99"] == pytest.approx(1.2)
    assert row["messages_per_second"] == 10_000.0
    assert row["ticks"] == 3 * sum(12 < n < 388 for n in range(400))


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_ticks_go_on_under_a_flood() -> None:
    """How late they are is the benchmark's to tell."""
    quiet, flooded = flood.measure(windows=12)
    assert quiet["messages_per_second"] == 0.0
    assert flooded["messages_per_second"] > 500
    assert min(quiet["ticks"], flooded["ticks"]) > 500
    assert min(flooded["ratio_p50"], flooded["ratio_p99"]) > 0
