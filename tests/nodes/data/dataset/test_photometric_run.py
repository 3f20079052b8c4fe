"""What a camera did to the light of a scene is undone by the files of the run, frame by frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nodes.data.dataset import DatasetWriter
from runtime import Duration
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.testing import spec
from sims.computer_vision import FreeCamera
from tests.nodes.data.dataset.samples import png

pytestmark = pytest.mark.slow

CAMERA = {
    "world": "hall",
    "rate": 10,
    "cameras": [{
        "name": "eye", "images": ["grey"], "width": 160, "height": 120, "response": "gamma",
        "vignette": [-0.5, 0.1], "reference_exposure": "1ms", "full_well": 50000.0,
        "auto_exposure": {"target": 0.3, "max_exposure": "2ms", "max_gain": 8.0, "damping": 0.8},
    }],
}  # fmt: skip


def test_a_still_scene_keeps_its_light_while_the_exposure_changes(tmp_path: Path) -> None:
    """As DSO corrects images: ``G[image] / vignette / exposure``; without it, they differ."""
    nodes = (
        spec(FreeCamera, "rig", CAMERA),
        spec(DatasetWriter, "mono", {"format": "tum_mono", "folder": "mono"}),
    )
    execute(Config(run=RunConfig(duration=Duration(2.05)), nodes=nodes), tmp_path)
    data = tmp_path / "mono"
    light = np.loadtxt(data / "pcalib.txt")
    shares = png(data / "vignette.png") / 65535.0
    exposures = np.loadtxt(data / "times.txt")[:, 2]
    images = [png(data / "images" / f"{number:05d}.png") for number in range(len(exposures))]
    assert exposures.max() / exposures.min() > 1.5
    assert len(np.unique(np.round(exposures, 6))) > 4
    first = light[images[0]] / shares / exposures[0]
    for image, exposure in zip(images, exposures, strict=True):
        known = (image > 40) & (image < 250) & (images[0] > 40) & (images[0] < 250)
        ratio = (light[image] / shares / exposure)[known] / first[known]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
        assert np.percentile(np.abs(ratio - 1.0), 90) < 0.06
    plain = images[-1][known] / images[0][known]
    assert abs(np.median(plain) - 1.0) > 0.15
