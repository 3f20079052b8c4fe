"""Noise is Gaussian, white, of the size that is asked for, and the same for the same exposure.

Automatic exposure in a run: what each image says of it, and that no worker has a say in it.
"""

from __future__ import annotations

import ctypes
import hashlib
import itertools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraAnnouncement, Image
from events.camera_info import srgb_light
from runtime.testing import NodeResult, run_node
from sims.cameras import CameraSpec
from sims.cameras.development import Development, Passes, _at, _quantiles, noise_key, random_words
from sims.cameras.optics import generator
from sims.cameras.spec import DepthSensor
from sims.compiled import libraries
from sims.computer_vision import FreeCamera

GREY = np.full((400, 400, 3), 128, np.uint8)
DEPTH = np.full((400, 400), 2.0, np.float32)
ENOUGH = 5.0 / 400
"""Five standard deviations of a correlation between 160,000 independent pairs."""

Array = npt.NDArray[np.float64]


def noisy_image(image: npt.NDArray[np.uint8], sigma: float, random: np.random.Generator) -> Array:
    spec = CameraSpec(name="c", noise=sigma)
    return Development(spec).develop([image], random).astype(np.float64)


def noisy_depth(
    depth: npt.NDArray[np.float32], coefficient: float, random: np.random.Generator
) -> npt.NDArray[np.float32]:
    spec = CameraSpec(name="c", depth_noise=coefficient)
    return Development(spec).measure(depth, (), random)


def image_noise(sigma: float, stamp: int = 7, camera: str = "c", seed: int = 1) -> Array:
    return noisy_image(GREY, sigma, generator(seed, camera, stamp)) - 128.0


def depth_noise(coefficient: float, stamp: int = 7) -> Array:
    return noisy_depth(DEPTH, coefficient, generator(1, "c", stamp)).astype(np.float64) - 2.0


def shot_noise() -> Array:
    """Of a linear image sensor, 32 electrons a grey level."""
    spec = CameraSpec(name="c", response="linear", full_well=8160.0, gain=2.0)
    image = Development(spec).develop([GREY], generator(1, "c", 7), gain=2.0)
    return image.astype(np.float64)


def correlation(a: Array, b: Array) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.parametrize("sigma", [0.5, 2.0, 10.0, 40.0])
def test_grey_levels_have_mean_and_deviation(sigma: float) -> None:
    """Of the rounded noise: a whole number of levels adds a variance of 1/12."""
    noise = image_noise(sigma)
    assert noise.mean() == pytest.approx(0.0, abs=0.015 * sigma)
    assert noise.std() == pytest.approx((sigma**2 + 1 / 12) ** 0.5, rel=0.02)


def test_noise_is_distributed_normally() -> None:
    """As much as there should be lies beyond one, two, three and four deviations."""
    deviations = np.abs(depth_noise(0.002)) / 0.008
    for border, share in ((1, 0.3173), (2, 0.0455), (3, 0.0027), (4, 6.3e-5)):
        beyond = float((deviations > border).mean())
        assert beyond == pytest.approx(share, abs=5 * (share / deviations.size) ** 0.5)


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    """Sigma is k z², whatever z."""
    assert depth_noise(0.002).std() == pytest.approx(0.008, rel=0.01)
    assert depth_noise(0.002).mean() == pytest.approx(0.0, abs=1e-4)
    far = noisy_depth(2.5 * DEPTH, 0.002, generator(1, "c", 7)).astype(np.float64)
    assert far.std() == pytest.approx(0.05, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise",
    [image_noise(10.0), shot_noise(), depth_noise(0.002)],
    ids=["image", "shot", "depth"],
)
def test_noise_is_white(noise: Array) -> None:
    """No pixel says anything of its neighbours, and no channel of the others."""
    for shift in range(1, 5):
        assert abs(correlation(noise[:, :-shift], noise[:, shift:])) < ENOUGH
        assert abs(correlation(noise[:-shift], noise[shift:])) < ENOUGH
    if noise.ndim == 3:
        assert abs(correlation(noise[..., 0], noise[..., 1])) < ENOUGH
        assert abs(correlation(noise[..., 0], noise[..., 2])) < ENOUGH
        assert abs(correlation(noise[..., 1], noise[..., 2])) < ENOUGH
    flat = noise.ravel()  # random numbers are made in blocks of 8, groups of 64 and chunks of 512
    for shift in (5, 6, 8, 16, 32, 48, 64, 128, 512, 1200):
        assert abs(correlation(flat[:-shift], flat[shift:])) < ENOUGH
        size = np.square(flat - flat.mean())
        assert abs(correlation(size[:-shift], size[shift:])) < ENOUGH
    spectrum = np.abs(np.fft.rfft(flat - flat.mean())) ** 2 / (flat.size * flat.var())
    assert spectrum.max() < 25.0  # exponential with mean 1: one of 240,000 beyond it in 3e5 images


def test_each_exposure_has_its_own_noise() -> None:
    """Another stamp, camera or seed draws anew; and depth is not as wrong as the colours are."""
    first = image_noise(10.0)
    others = (image_noise(10.0, stamp=8), image_noise(10.0, camera="d"), image_noise(10.0, seed=2))
    for other in others:
        assert abs(correlation(first, other)) < ENOUGH
        shifted = correlation(first[:200], other[200:])
        assert abs(shifted) < 2 * ENOUGH
    random = generator(1, "c", 7)
    seen = noisy_image(GREY, 10.0, random)
    measured = noisy_depth(DEPTH, 0.002, random).astype(np.float64)
    assert abs(correlation(seen[..., 0], measured)) < ENOUGH


def test_a_pixel_says_nothing_of_the_next_exposures() -> None:
    """Of many small images, whose stamps, cameras or seeds follow one another."""
    small = Development(CameraSpec(name="c", width=8, height=8, noise=10.0))
    grey = np.full((8, 8, 3), 128, np.uint8)
    for step in ((0, 0, 1), (0, 0, 33_333_333), (0, 1, 0), (1, 0, 0)):
        levels = np.array(
            [
                small.develop([grey], generator(k * step[0], f"c{k * step[1]}", k * step[2]))
                for k in range(800)
            ],
            np.float64,
        )
        for lag in (1, 2, 7):
            assert abs(correlation(levels[:-lag], levels[lag:])) < 5.0 / levels[lag:].size ** 0.5
        assert levels.mean() == pytest.approx(128.0, abs=5 * 10.0 / levels.size**0.5)


def test_the_same_exposure_has_the_same_noise() -> None:
    np.testing.assert_array_equal(image_noise(10.0), image_noise(10.0))
    np.testing.assert_array_equal(depth_noise(0.002), depth_noise(0.002))


def test_grey_levels_are_clipped_not_wrapped() -> None:
    """Black stays dark and white stays light, however strong the noise."""
    for sigma in (10.0, 1e6):
        for level in (0, 255):
            flat = np.full((100, 100), level, np.uint8)
            levels = noisy_image(flat, sigma, generator(1, "c", 7)).astype(int)
            assert (levels == level).mean() == pytest.approx(0.5, abs=0.06)
            if sigma == 10.0:
                assert np.abs(levels - level).max() < 60


def test_what_was_not_hit_stays_so() -> None:
    """Infinite depth has no noise, and finite depth never becomes infinite or negative."""
    depth = np.array([[np.inf, 0.02, 3.0, 499.0]] * 500, np.float32)
    noisy = noisy_depth(depth, 0.05, generator(1, "c", 7))
    assert np.isinf(noisy[:, 0]).all()
    assert (noisy[:, 0] > 0).all()
    assert np.isfinite(noisy[:, 1:]).all()
    assert noisy.min() == 0.0
    assert noisy.dtype == np.float32


def test_no_noise_costs_nothing() -> None:
    """Neither an image's copy nor a random number."""
    random = generator(1, "c", 7)
    state = str(random.bit_generator.state)
    ideal = Development(CameraSpec(name="c"))
    assert ideal.develop([GREY], random) is GREY
    assert ideal.measure(DEPTH, (), random) is DEPTH
    assert str(random.bit_generator.state) == state


@pytest.mark.parametrize(
    ("rounds", "expected"),
    [
        (7, "5f6fb709 0d893f64 4f121f81 4f730a48"),
        (10, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ],
)
def test_random_numbers_are_those_of_philox(rounds: int, expected: str) -> None:
    """Known answers of Random123 (``kat_vectors``), for counter and key 0."""
    words = random_words(np.zeros(4, np.uint32), 0, 64, rounds).view(np.uint32)
    assert " ".join(f"{word:08x}" for word in words[::8]) == expected


def test_every_word_of_the_key_makes_other_random_numbers() -> None:
    """So does the stream; and a longer image's numbers begin with those of a shorter one."""
    key = np.array([5, 6, 7, 8], np.uint32)
    words = random_words(key, 1, 64 * 100)
    assert len(np.unique(words.view(np.uint64))) == 16 * 100
    np.testing.assert_array_equal(random_words(key, 1, 1000), words[:1000])
    for other in range(4):
        changed = key.copy()
        changed[other] += 1
        assert (random_words(changed, 1, 6400) == words).mean() < 0.001
    assert (random_words(key, 0, 6400) == words).mean() < 0.001


SPOILT: dict[str, Any] = {
    "noise": 2.0, "full_well": 5000.0, "vignette": (-0.3, 0.05), "response": "gamma",
}  # fmt: skip
FORMS: list[tuple[dict[str, Any], str]] = [
    ({"noise": 3.0}, "5caad579aa8355f2"),
    ({"depth_noise": 0.002}, "6411c8ab13fcb971"),
    (SPOILT | {"blur": 0.8}, "9f668e8f45e5bc16"),
    ({"depth_sensor": DepthSensor()}, "a79e054aaf61570b"),
    ({"depth_sensor": DepthSensor(model="stereo", disparity_step=0.0)}, "4f01ad9ef69e802a"),
]


@pytest.mark.parametrize(("settings", "expected"), FORMS)
def test_bytes_are_the_same_with_all_instructions(settings: dict[str, Any], expected: str) -> None:
    """In C++ and in numpy, on every machine, of odd sizes; and OpenCV's have no say in it."""
    spec = CameraSpec(name="c", width=161, height=123, **settings)
    scene = np.random.default_rng(3)
    images = [scene.integers(0, 256, (123, 81, 3), np.uint8) for _ in range(3)]
    images = [image.repeat(2, axis=1)[:, :161] for image in images]
    depth = scene.uniform(0.5, 6.0, (5, 7)).astype(np.float32)
    depth = depth.repeat(25, axis=0)[:123].repeat(23, axis=1)
    depth[:9] = np.inf
    hashes = set()
    for instructions, optimized in itertools.product((*libraries(), "numpy"), (True, False)):
        cv2.setUseOptimized(optimized)
        try:
            development = Development(spec, instructions)
            random = generator(1, "c", 7)
            developed = (
                development.develop(images, random),
                development.develop(images[:1], random),
                development.develop([image[..., 1] for image in images], random),
                development.measure(depth, images, random),
            )
        finally:
            cv2.setUseOptimized(True)
        hashes.add(hashlib.sha256(b"".join(part.tobytes() for part in developed)).hexdigest()[:16])
    assert hashes == {expected}


def test_cameras_have_noise_where_nothing_was_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with MuJoCo's renderer on a machine without a compiler; and it is the same."""
    compiled = image_noise(3.0)
    monkeypatch.setattr("sims.cameras.development.libraries", dict)
    np.testing.assert_array_equal(image_noise(3.0), compiled)


@pytest.mark.slow
@given(st.lists(st.integers(0, 4000), max_size=5), st.booleans(), st.sampled_from([*libraries()]))
def test_parts_of_an_image_are_those_of_the_whole(
    cuts: list[int], wide: bool, instructions: str
) -> None:
    """However its samples are split: parts may be left to rows or threads of their own."""
    spec = CameraSpec(name="c", width=50, height=80, **SPOILT)
    light = np.random.default_rng(1).integers(0, 256, (80, 50), np.uint8)
    image = light.astype(np.uint16) * 257 if wide else light
    stages = Development(spec)._make_stages(wide, 2, 1.0, 1.0)
    key = noise_key(generator(1, "c", 7))
    whole = Passes(instructions).develop(image, stages, key)
    depth = (1.0 + light).astype(np.float32)
    deep = Passes(instructions).add_noise(depth, 0.002, key, square=True)
    pieces, far = np.zeros_like(whole), np.zeros_like(deep)
    table = _quantiles() * np.float32(0.002)
    library = libraries()[instructions]
    places = sorted({0, 4000, *cuts})
    for first, last in reversed(list(itertools.pairwise(places))):
        part = _at(key), ctypes.c_int64(first), ctypes.c_int64(last)
        library.develop_image(*part, int(wide), _at(image), *map(_at, stages), _at(pieces))
        library.develop_depth(*part, 1, *map(_at, (depth, table, far)))
    np.testing.assert_array_equal(pieces, whole)
    np.testing.assert_array_equal(far, deep)


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_who_renders_makes_no_difference(tmp_path: Path) -> None:
    """With late images, lost ones and three processes: the same exposures and the same bytes."""
    camera: dict[str, Any] = {"latency": "70ms", "jitter": "20ms", "loss": 0.2}
    first, second = (run(tmp_path, 0.2, processes, **camera) for processes in (1, 3))
    assert shutters(first) == shutters(second)
    for one, other in zip(first.of(Image), second.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)


@pytest.mark.slow
def test_an_image_has_no_effect_before_it_is_delivered(tmp_path: Path) -> None:
    """With a latency of three periods, the first four are exposed alike."""
    exposures = shutters(run(tmp_path, 1.6, latency="110ms"))
    assert exposures[0] == pytest.approx((4e-3, 1.0))
    assert len(set(exposures[:4])) == 1
    assert exposures[4] != exposures[0]


@pytest.mark.slow
def test_an_image_of_a_fixed_camera_says_how_it_was_exposed(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"auto_exposure": None, "exposure": "2ms", "gain": 2.0}
    result = run(tmp_path, 0.9, **settings)
    assert set(shutters(result)) == {(2e-3, 2.0)}
    plain = run(tmp_path, 0.9, auto_exposure=None, reference_exposure=0)
    assert set(shutters(plain)) == {(0.0, 1.0)}
    for one, other in zip(result.of(Image), plain.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)  # half the time at twice the gain
