"""All estimators of the core pass the suite of `tests.nodes.estimators.conformance`.

One entry in `CASES` for each; its rig is what it announces to read.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from nodes.estimators.inertial_odometry import RgbdInertialOdometry, StereoInertialOdometry
from nodes.estimators.monocular_odometry import MonocularOdometry
from nodes.estimators.visual_odometry import VisualOdometry
from nodes.estimators.visual_odometry.node import StereoOdometry
from nodes.outside.native import client as client_module
from nodes.outside.process import Process
from tests.nodes.estimators.conformance import (
    Case,
    Lack,
    faults,
    flights,
    refusal_faults,
    refusals,
    run,
)
from tests.nodes.estimators.flight import fly


def program() -> dict[str, Any]:
    """Return settings of a program that knows the truth, and sees when it is dark."""
    flight = fly(("depth", "rgb"), 1, 160)
    truth = {
        stamp: None if flight.kinds[stamp] in "bwrhz" else pose.tolist()
        for stamp, pose in flight.truth.items()
    }
    file = Path(tempfile.mkdtemp(prefix="conformance_")) / "truth.json"
    file.write_text(json.dumps(truth))
    client = str(Path(client_module.__file__).parent)
    command = [sys.executable, str(Path(__file__).with_name("outside.py")), str(file)]
    return {"command": command, "environment": {"PYTHONPATH": client}}


CASES = {
    "features": Case(VisualOdometry),
    "dense": Case(VisualOdometry, {"method": "dense"}, width=160),
    "monocular": Case(MonocularOdometry, begins=14),
    "stereo": Case(StereoOdometry),
    "program": Case(Process, width=160, built=program),
    "RGB-D-inertial": Case(RgbdInertialOdometry),
    "stereo-inertial": Case(StereoInertialOdometry),
}
"""By a name for the test; those that need a library are slow."""


@pytest.mark.slow
@pytest.mark.parametrize("case", flights(CASES))
def test_it_passes_the_suite_and_equal_input_gives_equal_output(case: Case) -> None:
    record = run(case)
    assert not faults(record, case)
    if case.node.deterministic:
        assert run(case).outcome() == record.outcome()


@pytest.mark.parametrize(("case", "lack"), refusals(CASES))
def test_what_it_cannot_do_it_refuses_in_a_sentence(case: Case, lack: Lack) -> None:
    assert not [*refusal_faults(case, lack)]
