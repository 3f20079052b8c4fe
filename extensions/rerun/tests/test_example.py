"""The example runs as its first lines say, a little shorter."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.examples.test_examples import run


@pytest.mark.slow
def test_rerun_leaves_a_recording(tmp_path: Path) -> None:
    """`rerun` writes a file with the whole flight in it."""
    run("rerun", tmp_path, "run.duration=4s", "report.figures=[]")
    assert (tmp_path / "flight.rrd").stat().st_size > 500_000
