"""Noise is Gaussian, white, of the size that is asked for, and the same for the same exposure.

Automatic exposure in a run: what each image says of it, and that no worker has a say in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from events import CameraAnnouncement, Image
from events.camera_info import srgb_light
from runtime.testing import NodeResult, run_node
from sims.cameras import response as noise
from sims.cameras.response import generator, noisy_depth, noisy_image
from sims.computer_vision import FreeCamera

GREY = np.full((400, 400, 3), 128, np.uint8)
DEPTH = np.full((400, 400), 2.0, np.float32)
ENOUGH = 5.0 / 400
"""Five standard deviations of a correlation between 160,000 independent pairs."""

Array = npt.NDArray[np.float64]


def image_noise(sigma: float, stamp: int = 7, camera: str = "c", seed: int = 1) -> Array:
    random = generator(seed, camera, stamp)
    return noisy_image(GREY, sigma, random).astype(np.float64) - 128.0


def depth_noise(coefficient: float, stamp: int = 7) -> Array:
    return noisy_depth(DEPTH, coefficient, generator(1, "c", stamp)).astype(np.float64) - 2.0


def correlation(a: Array, b: Array) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("sigma", [0.5, 2.0, 10.0, 40.0])
def test_grey_levels_have_mean_and_deviation(sigma: float) -> None:
    """Of the rounded noise: a whole number of levels adds a variance of 1/12."""
    found = image_noise(sigma)
    assert found.mean() == pytest.approx(0.0, abs=0.015 * sigma)
    assert found.std() == pytest.approx((sigma**2 + 1 / 12) ** 0.5, rel=0.02)


def test_noise_is_distributed_normally() -> None:
    """As much as there should be lies beyond one, two, three and four deviations."""
    found = np.abs(depth_noise(0.002)) / 0.008
    for border, share in ((1, 0.3173), (2, 0.0455), (3, 0.0027), (4, 6.3e-5)):
        beyond = float((found > border).mean())
        assert beyond == pytest.approx(share, abs=5 * (share / found.size) ** 0.5)


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    """Sigma is k z², whatever z."""
    assert depth_noise(0.002).std() == pytest.approx(0.008, rel=0.01)
    assert depth_noise(0.002).mean() == pytest.approx(0.0, abs=1e-4)
    far = noisy_depth(2.5 * DEPTH, 0.002, generator(1, "c", 7)).astype(np.float64)
    assert far.std() == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("found", [image_noise(10.0), depth_noise(0.002)], ids=["image", "depth"])
def test_noise_is_white(found: Array) -> None:
    """No pixel says anything of its neighbours, and no channel of the others."""
    for shift in range(1, 5):
        assert abs(correlation(found[:, :-shift], found[:, shift:])) < ENOUGH
        assert abs(correlation(found[:-shift], found[shift:])) < ENOUGH
    if found.ndim == 3:
        assert abs(correlation(found[..., 0], found[..., 1])) < ENOUGH
        assert abs(correlation(found[..., 0], found[..., 2])) < ENOUGH


def test_each_exposure_has_its_own_noise() -> None:
    """Another stamp, camera or seed draws anew; and depth is not as wrong as the colours are."""
    first = image_noise(10.0)
    others = (image_noise(10.0, stamp=8), image_noise(10.0, camera="d"), image_noise(10.0, seed=2))
    for other in others:
        assert abs(correlation(first, other)) < ENOUGH
        shifted = correlation(first[:200], other[200:])
        assert abs(shifted) < 2 * ENOUGH
    random = generator(1, "c", 7)
    seen = noisy_image(GREY, 10.0, random).astype(np.float64)
    measured = noisy_depth(DEPTH, 0.002, random).astype(np.float64)
    assert abs(correlation(seen[..., 0], measured)) < ENOUGH


def test_the_same_exposure_has_the_same_noise() -> None:
    np.testing.assert_array_equal(image_noise(10.0), image_noise(10.0))
    np.testing.assert_array_equal(depth_noise(0.002), depth_noise(0.002))


def test_grey_levels_are_clipped_not_wrapped() -> None:
    """Black stays dark and white stays light, however strong the noise."""
    for sigma in (10.0, 1e6):
        for level in (0, 255):
            flat = np.full((100, 100), level, np.uint8)
            found = noisy_image(flat, sigma, generator(1, "c", 7)).astype(int)
            assert (found == level).mean() == pytest.approx(0.5, abs=0.06)
            if sigma == 10.0:
                assert np.abs(found - level).max() < 60


def test_what_was_not_hit_stays_so() -> None:
    """Infinite depth has no noise, and finite depth never becomes infinite or negative."""
    depth = np.array([[np.inf, 0.02, 3.0, 499.0]] * 500, np.float32)
    found = noisy_depth(depth, 0.05, generator(1, "c", 7))
    assert np.isinf(found[:, 0]).all()
    assert (found[:, 0] > 0).all()
    assert np.isfinite(found[:, 1:]).all()
    assert found.min() == 0.0
    assert found.dtype == np.float32


def test_no_noise_costs_nothing() -> None:
    random = generator(1, "c", 7)
    assert noisy_image(GREY, 0.0, random) is GREY
    assert noisy_depth(DEPTH, 0.0, random) is DEPTH


def test_both_ways_of_looking_up_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV from version 5 on, and numpy, give the same bits."""
    first = image_noise(3.0), depth_noise(0.002)
    monkeypatch.setattr(noise, "_TABLES_OF_16_BITS", not noise._TABLES_OF_16_BITS)
    np.testing.assert_array_equal(image_noise(3.0), first[0])
    np.testing.assert_array_equal(depth_noise(0.002), first[1])


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
