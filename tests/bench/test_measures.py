"""The benchmarks of whole runs, shortened: they measure what they say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench import frame, lockstep, memory, outside, rays, stall, throughput


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_an_inline_camera_delays_ticks_and_a_worker_fetches_as_much(tmp_path: Path) -> None:
    """The command writes a row a mode; inline, a tick waits for a whole image."""
    out = tmp_path / "stall.json"
    command = [sys.executable, "-m", "runtime", "bench", "stall", "--seconds", "1.5"]
    subprocess.run([*command, "--repeats", "1", "--json", str(out)], check=True)
    rows = {row["mode"]: row for row in json.loads(out.read_text())["rows"]}
    assert list(rows) == ["none", "inline", "thread", "worker", "fetch inline", "fetch"]
    assert rows["none"]["frames"] == 0
    for mode in ("inline", "thread", "worker"):
        assert 10 <= rows[mode]["frames"] <= 16
        assert rows[mode]["fetch_ms_median"] > 1
    # An image takes several periods of the tick, so inline some ticks must be that late.
    assert rows["inline"]["late_max_us"] > 2_500
    assert rows["inline"]["missed"] > 0
    for mode in ("fetch inline", "fetch"):
        assert rows[mode]["fetch_ms_median"] >= 80
    # Waiting for 80 ms on the loop costs 32 periods of 2.5 ms; awaiting it costs none of them.
    assert rows["fetch inline"]["late_max_us"] > 70_000
    assert rows["fetch"]["missed"] < rows["fetch inline"]["missed"] / 10


def test_stall_rows_are_statistics_of_what_was_collected() -> None:
    """Percentiles, means and medians are those of the samples, in the units of their names."""
    late = [1_000 * n for n in range(1, 101)]
    run = stall.Run(late=late, update=[2_500_000] * 99, fetch=[8_000_000], missed=3)
    row = stall._row("worker", [run], [run])
    assert row["late_p50_us"] == pytest.approx(50.5)
    assert row["late_p99_us"] == pytest.approx(99.01)
    assert row["late_max_us"] == 100
    assert (row["update_mean_ms"], row["update_sd_ms"]) == (2.5, 0)
    assert (row["frames"], row["fetch_ms_median"], row["missed"]) == (1, 8.0, 3)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_lockstep_is_compared_with_a_bare_loop() -> None:
    """All fly, and cameras take most of the time; the runtime's share is what the loop leaves."""
    bare, run, cameras = lockstep.measure(seconds=5, repeats=3)  # medians, as one may be held up
    assert bare["speed"] > 0
    assert run["speed"] > cameras["speed"] > 0
    assert run["share"] == pytest.approx(1 - run["speed"] / bare["speed"])


@pytest.mark.slow
def test_idling_is_measured_over_the_ticks() -> None:
    """A second of 100 Hz is a hundred ticks, and takes some of a core but not all of it."""
    (row,) = throughput.measure_idle(seconds=1.0)
    assert 95 <= row["ticks"] <= 102
    assert 0 < row["cpu_percent"] < 100


@pytest.mark.slow
def test_throughput_covers_handlers_streams_and_workers() -> None:
    """Each way through has a row; only images have bytes."""
    rows = throughput.measure(bursts=3)
    assert [row["case"].split(",")[0] for row in rows] == [
        *("poses made", "poses made", "events", "events", "events", "images by reference"),
        *("images to a worker and back", "images to a worker and back"),
    ]
    assert all(row["per_event_us"] > 0 for row in rows)
    assert [row["bytes_per_second"] > 0 for row in rows] == [False] * 5 + [True] * 3


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_the_parts_of_a_frame_add_up() -> None:
    """To the whole; each that is measured by itself takes some time, and none takes it all."""
    rows = {row["part"]: row for row in lockstep.measure_parts(seconds=6, repeats=1)}
    assert list(rows)[-2:] == ["rest", "all"]
    assert sum(row["ms"] for row in rows.values()) == pytest.approx(2 * rows["all"]["ms"])
    assert all(0 < rows[part]["share"] < 1 for part in ("noise", "copies", "odometry", "hashing"))


@pytest.mark.slow
def test_a_frame_to_a_program_is_compared_with_a_call() -> None:
    """Both carry the whole frame, so neither takes less than copying it would."""
    (row,) = outside.measure_link(samples=30)
    assert row["bytes"] == 512 * 512 * 7
    assert row["ratio"] == pytest.approx(row["link_us"] / row["worker_us"])
    assert min(row["link_us"], row["worker_us"]) > 20


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_odometry_outside_and_one_in_a_worker_fly_the_same() -> None:
    (row,) = outside.measure_held(seconds=2.0, repeats=1)
    assert row["equal"]
    assert row["ratio"] == pytest.approx(row["outside_speed"] / row["worker_speed"])


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_frames_are_drawn_by_both_renderers_and_the_first_image_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame, "WORLDS", ("hall",))
    rows = frame.measure(places=1)
    assert [row["camera"] for row in rows] == list(frame.CAMERAS)
    for row in rows:
        assert row["mujoco_ms"] is not None
        assert row["ratio"] == pytest.approx(row["mujoco_ms"] / row["raster_ms"])
    assert [row["world"] for row in frame.measure_first_image(repeats=1)] == ["hall", "yard"]


@pytest.mark.slow
def test_rays_of_all_sides_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rays, "CELLS", {4500: 3})
    (row,) = rays.measure(rounds=1)
    assert row["triangles"] == 4500
    assert row["ours_us"] < row["mujoco_us"]
    if "embree_us" in row:
        assert row["ratio"] == pytest.approx(row["ours_us"] / row["embree_us"])


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_memory_of_all_processes_is_measured_cold_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "CELLS", {1_000_000: 14})
    monkeypatch.setattr(memory, "SIDE", 64)
    rows = memory.measure(seconds=1.0)
    assert [row["start"] for row in rows] == ["cold", "kept"]
    for row in rows:
        assert row["triangles"] == 250 * 2 * 14 * 14
        assert 30e6 < row["main"] < row["flight"] <= row["peak"] < 2e9
        assert row["seconds"] > 0.0
