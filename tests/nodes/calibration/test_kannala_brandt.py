"""Lenses of Kannala and Brandt in the place of others."""

from __future__ import annotations

import numpy as np
import pytest

from events import CameraInfo
from nodes.calibration.kannala_brandt import nearest_kannala_brandt, with_kannala_brandt
from nodes.data.dataset.recording import Rig
from tests.nodes.calibration.samples import IMU, camera

WIDE = CameraInfo(
    width=400, height=300, fx=115.7, fy=115.8, cx=199.7, cy=149.8,
    distortion=(-3.6e-4, -2.6e-4, -3.3e-5, -1.8e-5, 0.0),
)  # fmt: skip


def test_the_nearest_lens_sees_the_same_but_for_what_it_says() -> None:
    nearest, mean, most = nearest_kannala_brandt(WIDE)
    rays = np.random.default_rng(1).uniform((-1.5, -1.1, 1), (1.5, 1.1, 1), (500, 3))
    off = np.linalg.norm(nearest.project(rays) - WIDE.project(rays), axis=1)
    assert nearest.distortion_model == "equidistant"
    assert mean == pytest.approx(0.018, abs=0.003)
    assert np.sqrt((off**2).mean()) < 1.5 * mean
    assert off.max() < 1.2 * most < 0.2


def test_a_lens_of_its_own_kind_is_found_again() -> None:
    lens = camera(lens="kb4").info
    nearest, _, most = nearest_kannala_brandt(lens)
    assert most < 1e-6
    np.testing.assert_allclose(nearest.distortion, lens.distortion, atol=1e-6)


@pytest.mark.parametrize(("name", "fitted"), [("pinhole", 0), ("kb4", 0), ("radtan4", 1)])
def test_only_lenses_that_need_it_are_replaced(name: str, fitted: int) -> None:
    one = camera(lens=name)
    rig, sentences = with_kannala_brandt(Rig("drone", (one,), IMU))
    assert len(sentences) == fitted
    assert (rig.cameras[0] is one) == (not fitted)
    assert rig.cameras[0].info.is_pinhole == (name == "pinhole")
