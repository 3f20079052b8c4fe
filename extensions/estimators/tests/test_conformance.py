"""Other people's estimators pass the suite of `tests.nodes.estimators.conformance`, too."""

from __future__ import annotations

import functools
from typing import Any

import pytest

from events.camera_info import COEFFICIENTS
from extensions.estimators.tests.vit.library import stub_settings
from nodes.estimators import Estimator
from tests.nodes.estimators.conformance import (
    Case,
    Lack,
    faults,
    flights,
    lenses_of,
    refusal_faults,
    refusals,
    run,
)
from visnav_estimators.evalio import Evalio
from visnav_estimators.orb_slam3 import OrbSlam3
from visnav_estimators.orb_slam3.settings import find_vocabulary
from visnav_estimators.svo import Svo
from visnav_estimators.vit import Vit


def stub_of_vit(mode: str) -> Case:
    """Return the case of a library that counts on its IMU, from the sixth image on."""
    settings = {"library": "stub.so", "mode": mode, "hold": {"initialise": 1.0}}
    more = functools.partial(stub_settings, "starts 5 delay 1")
    return Case(Vit, settings, begins=4, width=160, built=more)


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
    "svo": Case(Svo, begins=30, width=480, worker=True, needs="svo_cpp", slow=True),
    "ORB-SLAM3, RGB-D": orb_slam3("rgbd"),
    "ORB-SLAM3, stereo": orb_slam3("stereo"),
    "vit": stub_of_vit("stereo_inertial"),
    "monocular vit": stub_of_vit("monocular_inertial"),
}


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


@pytest.mark.parametrize(
    ("node", "settings", "lenses"),
    [
        (Svo, {}, set()),
        (Evalio, {}, set()),
        (OrbSlam3, {"mode": "rgbd"}, {"plumb_bob"}),
        (OrbSlam3, {"mode": "monocular"}, {"plumb_bob", "equidistant"}),
        (OrbSlam3, {"mode": "stereo"}, set()),
        (Vit, {"library": "libvit.so"}, set(COEFFICIENTS)),
    ],
)
def test_each_says_which_lenses_it_knows(
    node: type[Estimator[Any]], settings: dict[str, Any], lenses: set[str]
) -> None:
    assert lenses_of(node, settings) == lenses
