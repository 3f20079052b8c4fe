"""All estimators of the project pass the suite of `tests.nodes.estimators.conformance`.

One entry in `CASES` for each; its rig is what it announces to read.
"""

from __future__ import annotations

import functools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from nodes.estimators.inertial_odometry import RgbdInertialOdometry, StereoInertialOdometry
from nodes.estimators.monocular_odometry import MonocularOdometry
from nodes.estimators.orb_slam3 import OrbSlam3
from nodes.estimators.orb_slam3.settings import find_vocabulary
from nodes.estimators.svo import Svo
from nodes.estimators.visual_odometry import VisualOdometry
from nodes.estimators.visual_odometry.node import StereoOdometry
from nodes.outside.native import client as client_module
from nodes.outside.process import Process
from nodes.outside.vit import Vit
from tests.nodes.estimators.conformance import Case, Lack, faults, lacks, refusal_faults, run
from tests.nodes.estimators.flight import fly
from tests.nodes.outside.vit.library import stub_settings


def stub_of_vit(mode: str) -> Case:
    """Return the case of a library that counts on its IMU, from the sixth image on."""
    settings = {"library": "stub.so", "mode": mode, "hold": {"initialise": 1.0}}
    more = functools.partial(stub_settings, "starts 5 delay 1")
    return Case(Vit, settings, begins=4, width=160, built=more)


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


def orb_slam3(mode: str) -> Case:
    """Return the case of a mode of ORB-SLAM3, with the vocabulary that somebody has trained.

    After each loss it begins another map where it was last: the flight meanwhile is missing.
    """

    def built() -> dict[str, Any]:
        try:
            return {"vocabulary": str(find_vocabulary(""))}
        except ValueError as error:
            pytest.skip(str(error))

    plain = Case(OrbSlam3, {"mode": mode}, width=480, worker=True, slow=True, needs="pyorbslam3")
    return plain._replace(begins=6, tolerance=0.5, maps=True, built=built)


CASES = {
    "features": Case(VisualOdometry),
    "dense": Case(VisualOdometry, {"method": "dense"}, width=160),
    "monocular": Case(MonocularOdometry, begins=14),
    "stereo": Case(StereoOdometry),
    "svo": Case(Svo, begins=30, width=480, worker=True, needs="svo_cpp", slow=True),
    "program": Case(Process, width=160, built=program),
    "ORB-SLAM3, RGB-D": orb_slam3("rgbd"),
    "ORB-SLAM3, stereo": orb_slam3("stereo"),
    "vit": stub_of_vit("stereo_inertial"),
    "monocular vit": stub_of_vit("monocular_inertial"),
    "RGB-D-inertial": Case(RgbdInertialOdometry),
    "stereo-inertial": Case(StereoInertialOdometry),
}
"""By a name for the test; those that need more than the project itself are slow."""


def cases() -> list[Any]:
    return [
        pytest.param(case, id=name, marks=[pytest.mark.slow] if case.slow else [])
        for name, case in CASES.items()
    ]


@pytest.mark.slow
@pytest.mark.parametrize("case", cases())
def test_it_passes_the_suite_and_equal_input_gives_equal_output(case: Case) -> None:
    record = run(case)
    assert not faults(record, case)
    if case.node.deterministic:
        assert run(case).outcome() == record.outcome()


def refusals() -> list[Any]:
    return [
        pytest.param(case, lack, id=f"{name}, {lack.name} missing")
        for name, case in CASES.items()
        for lack in lacks(case)
    ]


@pytest.mark.parametrize(("case", "lack"), refusals())
def test_what_it_cannot_do_it_refuses_in_a_sentence(case: Case, lack: Lack) -> None:
    assert not [*refusal_faults(case, lack)]
