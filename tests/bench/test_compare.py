"""Comparing two result files: what counts as a change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from bench.compare import compare
from runtime.errors import ConfigError


def results(path: Path, **rounds: tuple[float, ...]) -> Path:
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
    before = results(tmp_path / "a", steady=(1.0, 1.0, 1.01), wild=(1.0, 1.0, 2.5))
    after = results(tmp_path / "b", steady=(2.0, 2.0, 2.02), wild=(2.0, 2.0, 4.0))
    changes = {change.what.split(", ")[1]: change for change in compare(before, after)}
    assert changes["steady"].real
    assert changes["steady"].ratio == pytest.approx(2.0)
    assert not changes["wild"].real


def test_faster_counts_as_much_as_slower(tmp_path: Path) -> None:
    """A file compared with itself has no change; swapped files have inverse ratios."""
    before = results(tmp_path / "a", ours=(3.0, 3.0, 3.1))
    after = results(tmp_path / "b", ours=(1.0, 1.0, 1.05), new=(1.0,))
    assert not any(change.real for change in compare(before, before))
    (there,), (back,) = compare(before, after), compare(after, before)
    assert there.real
    assert back.real
    assert there.ratio * back.ratio == pytest.approx(1.0)


@pytest.mark.parametrize("content", [None, b"no json", b"[]", b'{"rows": [{"median_us": 1}]}'])
def test_what_is_no_result_file_is_refused(tmp_path: Path, content: bytes | None) -> None:
    """A missing or foreign file is an error that names it."""
    path = tmp_path / "results.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"results\.json: expected a result file"):
        compare(path, path)
