"""Results: what the page says first, that its figures are those measured, what counts as change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from bench.benchmarks import Row
from bench.page import write
from bench.results import compare
from runtime.errors import ConfigError


def row(system: str, mode: str, nodes: int, median: float) -> Row:
    return {
        "case": "small",
        "system": system,
        "mode": mode,
        "nodes": nodes,
        "place": "one process",
        "samples": 100,
        "median_us": median,
        "mean_us": median,
        "q1_us": median * 0.9,
        "q3_us": median * 1.1,
        "p99_us": median * 2,
        "max_us": median * 9,
        "rounds_us": (median,),
    }


def stall_row(mode: str, p99: float) -> Row:
    return {
        "mode": mode,
        "ticks": 100,
        "late_p50_us": 20,
        "late_p99_us": p99,
        "late_max_us": 500,
        "missed": 0,
        "update_mean_ms": 2.5,
        "update_median_ms": 2.5,
        "update_sd_ms": 0.1,
        "frames": 0 if mode == "none" else 10,
        "fetch_ms_median": 8,
    }


def results() -> dict[str, Any]:
    return {
        "environment": {"cpu": "a processor", "commit": "abc"},
        "quick": True,
        "rows": [
            *(row("visnav", "handler", n, 0.5) for n in (2, 128)),
            *(row("plain calls", "handler", n, 0.4) for n in (2, 128)),
            *(row("visnav", "stream", n, 1.0) for n in (2, 128)),
            *(row("asyncio.Queue (uvloop)", "stream", n, 4.0) for n in (2, 128)),
        ],
        "stall": [stall_row("none", 50), stall_row("worker", 60)],
        "throughput": [
            {
                "case": "events, stream, all in one wake",
                "batch": 256,
                "per_event_us": 0.3,
                "events_per_second": 3e6,
                "bytes_per_second": 0,
            }
        ],
        "idle": {"hz": 100, "seconds": 10, "ticks": 1000, "cpu_percent": 0.8},
        "lockstep": [{"case": "run", "speed": 100, "share": 0.2}],
        "bridge": [
            {
                "case": "small event",
                "bytes": 64,
                "samples": 100,
                "ours_us": 180,
                "zenoh_us": 100,
                "ratio": 1.8,
                "ours_p99_us": 300,
                "zenoh_p99_us": 200,
                "ours_per_second": 2e4,
                "zenoh_per_second": 1e4,
            }
        ],
        "missing": {"trio channels": "not installed"},
        "versions": {"pyee": "pyee 13"},
    }


@pytest.mark.slow
def test_the_page_says_first_what_its_numbers_do_not_show(tmp_path: Path) -> None:
    """Caveats, then ratios, then tables; what was not measured is at the end, with the reason."""
    write(results(), tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "RESULTS.md").read_text()
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings[:2] == ["## What these numbers do not show", "## In short"]
    assert "| small, handlers | plain calls | 128 | 1.25 | ≤ 1.3 |" in text
    assert "| small, streams | asyncio.Queue (uvloop) | 2 | 0.25 | ≤ 0.33 |" in text
    assert "camera in a worker | no camera | | 1.20 | ≤ 1.25 |" in text
    assert text.rstrip().endswith("- trio channels: not installed")


def test_figures_of_numpy_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of half an hour nothing may be lost for a number's type."""
    monkeypatch.setattr("bench.page.draw", lambda *_: {})
    row = {
        "world": "hall",
        "camera": "pinhole",
        "raster_ms": np.float64(2.5),
        "mujoco_ms": None,
        "ratio": None,
    }
    write({**results(), "frame": [row]}, tmp_path, tmp_path / "RESULTS.md")
    written = msgspec.json.decode((tmp_path / "results.json").read_bytes())
    assert written["frame"][0]["raster_ms"] == 2.5


@pytest.mark.slow
def test_the_plots_on_the_page_exist(tmp_path: Path) -> None:
    """Links lead from the page to plots in another folder."""
    out = tmp_path / "results"
    out.mkdir()
    write(results(), out, tmp_path / "RESULTS.md")
    lines = (tmp_path / "RESULTS.md").read_text().splitlines()
    links = [line.split("](")[1].rstrip(")") for line in lines if line.startswith("![")]
    assert links == ["results/small-scaling.png", "results/small-2.png", "results/small-128.png"]
    assert all((tmp_path / link).stat().st_size > 5_000 for link in links)


@pytest.mark.slow
def test_each_plot_stands_once_under_its_own_case(tmp_path: Path) -> None:
    """``large`` and ``large-shared`` begin alike, and yet do not share their images."""
    measured = results()
    cases = ("small", "large", "large-shared")
    rows = [{**r, "case": case} for r in measured["rows"] for case in cases]
    write({**measured, "rows": rows}, tmp_path, tmp_path / "RESULTS.md")
    lines = (tmp_path / "RESULTS.md").read_text().splitlines()
    links = [line.split("](")[1] for line in lines if line.startswith("![")]
    assert len(links) == len(set(links)) == 9
    shared = next(n for n, line in enumerate(lines) if line.startswith("## Large message, by"))
    assert not any("large-shared" in line for line in lines[:shared] if line.startswith("!["))


@pytest.mark.slow
def test_what_crosses_to_another_process_is_held_against_zenoh(tmp_path: Path) -> None:
    """As a ratio with its mark, and as a table."""
    write(results(), tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "RESULTS.md").read_text(encoding="utf-8")
    assert "| small event to another process and back | Zenoh | 2 | 1.80 | ≤ 2 |" in text
    assert "| small event | 64 | 180 | 100 | 1.80 | 20,000 | 10,000 |" in text


def result_file(path: Path, **rounds: tuple[float, ...]) -> Path:
    """Write a result file with a row a system."""
    rows: list[dict[str, Any]] = [
        {
            "case": "small",
            "system": system,
            "mode": "handler",
            "nodes": 2,
            "median_us": sorted(values)[len(values) // 2],
            "rounds_us": values,
        }
        for system, values in rounds.items()
    ]
    path.write_bytes(msgspec.json.encode({"environment": {}, "rows": rows}))
    return path


def test_a_change_beyond_the_noise_is_real(tmp_path: Path) -> None:
    """Twice as slow with steady rounds is a change; the same with wild rounds is not."""
    before = result_file(tmp_path / "a", steady=(1.0, 1.0, 1.01), wild=(1.0, 1.0, 2.5))
    after = result_file(tmp_path / "b", steady=(2.0, 2.0, 2.02), wild=(2.0, 2.0, 4.0))
    changes = {change["what"].split(", ")[1]: change for change in compare(before, after)}
    assert changes["steady"]["real"]
    assert changes["steady"]["ratio"] == pytest.approx(2.0)
    assert not changes["wild"]["real"]


def test_faster_counts_as_much_as_slower(tmp_path: Path) -> None:
    """A file compared with itself has no change; swapped files have inverse ratios."""
    before = result_file(tmp_path / "a", ours=(3.0, 3.0, 3.1))
    after = result_file(tmp_path / "b", ours=(1.0, 1.0, 1.05), new=(1.0,))
    assert not any(change["real"] for change in compare(before, before))
    (there,), (back,) = compare(before, after), compare(after, before)
    assert there["real"]
    assert back["real"]
    assert there["ratio"] * back["ratio"] == pytest.approx(1.0)


@pytest.mark.parametrize("content", [None, b"no json", b"[]", b'{"rows": [{"median_us": 1}]}'])
def test_what_is_no_result_file_is_refused(tmp_path: Path, content: bytes | None) -> None:
    """A missing or foreign file is an error that names it."""
    path = tmp_path / "results.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"results\.json: expected a result file"):
        compare(path, path)
