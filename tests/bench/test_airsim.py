"""The benchmark of AirSim's server measures what it says."""

from __future__ import annotations

import pytest

from bench import airsim
from bench.lateness import Window


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_every_second_window_is_quiet_and_the_others_ask_as_quickly_as_they_are_answered() -> None:
    rows = {row["case"]: row for row in airsim.measure(rounds=1)}
    assert [*rows] == ["quiet", *airsim.CASES]
    assert rows["quiet"]["per_second"] is None
    for case in airsim.CASES:
        row = rows[case]
        assert row["per_second"]
        assert row["median_us"]
        assert row["p99_us"]
        assert 0 < row["median_us"] <= row["p99_us"]
        assert row["ticks"] > 100


def test_rows_are_statistics_of_the_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet, busy = [1_000.0] * 100, [2_000.0] * 100
    monkeypatch.setattr(airsim, "lateness", lambda _: busy)
    window = Window(5, 5 + 10**9, [100_000, 200_000, 300_000])
    row = airsim._row("ping", [window], [quiet])
    assert (row["per_second"], row["median_us"], row["ratio_p99"]) == (3.0, 200.0, 2.0)
    assert row["late_p50_us"] == 2.0
