"""`outside_cpp`: an estimator in C++ is built, fed, judged, and the same every time."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.examples.test_examples import run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler"),
]


def test_it_is_judged_and_gives_the_same_digest_twice(tmp_path: Path) -> None:
    shorter = ("run.duration=6s", "run.startup_limit=300s", "report.figures=[]")
    first, second = (run("outside_cpp", tmp_path / name, *shorter) for name in "ab")
    assert first["digest"] == second["digest"]
    outside = first["outside"]["slam"]
    assert outside["inputs"] == second["outside"]["slam"]["inputs"]
    assert outside["reproducible"]
    assert outside["answered"] > 170
    figures = first["verdict"]["estimators"]["slam"]
    assert figures["ate_percent"] < 2.0
    assert figures["coverage_percent"] == 100.0
