"""Automatic exposure in a run: what each image says of it, and that no worker has a say in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import CameraAnnouncement, Image
from events.camera_info import srgb_light
from runtime.testing import NodeResult, run_node
from sims.computer_vision import FreeCamera

pytestmark = pytest.mark.slow

WORLD = """<mujoco><visual>
<headlight ambient="{0} {0} {0}" diffuse="0 0 0" specular="0 0 0"/></visual>
<worldbody><geom type="plane" size="9 9 1" rgba="0.8 0.8 0.8 1"/>
<geom type="box" size="1 9 9" pos="3 0 0" rgba="0.5 0.5 0.5 1"/></worldbody></mujoco>"""
AUTO = {"max_exposure": "8ms", "max_gain": 16.0}


def run(folder: Path, ambient: float, processes: int = 1, **camera: Any) -> NodeResult:
    """Run a camera of 30 Hz for two seconds in a world of some light."""
    path = folder / "world.xml"
    path.write_text(WORLD.format(ambient), "utf-8")
    settings = {
        "name": "c",
        "images": ["rgb"],
        "width": 32,
        "height": 24,
        "rate": 30,
        "noise": 1.0,
        "reference_exposure": "4ms",
        "auto_exposure": AUTO,
    }
    config = {
        "world": str(path),
        "rate": 30,
        "camera_processes": processes,
        "cameras": [settings | camera],
    }
    return run_node(FreeCamera, config=config, duration=2.0, seed=4)


def shutters(result: NodeResult) -> list[tuple[float, float]]:
    return [(image.exposure_time, image.gain) for image in result.of(Image)]


@pytest.mark.parametrize(("ambient", "gained"), [(1.6, False), (0.16, True)])
def test_images_of_a_bright_and_of_a_dark_world_come_right(
    tmp_path: Path, ambient: float, gained: bool
) -> None:
    """The last ones have the target's light, the first the reference's; the dark ones have gain."""
    result = run(tmp_path, ambient)
    images = result.of(Image)
    light = [srgb_light()[image.data].mean() for image in images]
    assert images[0].exposure_time == pytest.approx(4e-3)
    assert images[0].gain == 1.0
    assert abs(np.log(light[0] / 0.18)) > 0.5
    np.testing.assert_allclose(light[20:], 0.18, rtol=0.1)
    exposure, gain = shutters(result)[-1]
    assert (gain > 1.0) == gained
    assert (exposure == pytest.approx(8e-3)) == gained
    (announced,) = result.of(CameraAnnouncement)
    assert announced.exposure == 8e-3
    assert announced.reference_exposure == 4e-3


def test_who_renders_makes_no_difference(tmp_path: Path) -> None:
    """With late images, lost ones and three processes: the same exposures and the same bytes."""
    camera: dict[str, Any] = {"latency": "70ms", "jitter": "20ms", "loss": 0.2}
    first, second = (run(tmp_path, 0.2, processes, **camera) for processes in (1, 3))
    assert shutters(first) == shutters(second)
    for one, other in zip(first.of(Image), second.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)


def test_an_image_has_no_effect_before_it_is_delivered(tmp_path: Path) -> None:
    """With a latency of three periods, the first four are exposed alike."""
    found = shutters(run(tmp_path, 1.6, latency="110ms"))
    assert found[0] == pytest.approx((4e-3, 1.0))
    assert len(set(found[:4])) == 1
    assert found[4] != found[0]


def test_an_image_of_a_fixed_camera_says_how_it_was_exposed(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"auto_exposure": None, "exposure": "2ms", "gain": 2.0}
    result = run(tmp_path, 0.9, **settings)
    assert set(shutters(result)) == {(2e-3, 2.0)}
    plain = run(tmp_path, 0.9, auto_exposure=None, reference_exposure=0)
    assert set(shutters(plain)) == {(0.0, 1.0)}
    for one, other in zip(result.of(Image), plain.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)  # half the time at twice the gain
