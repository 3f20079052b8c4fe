"""From light to grey levels: each effect is as large as its setting says, and off is off."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from events.camera_info import response_light, srgb_light, vignette_map
from sims.cameras import CameraSpec, announcement, camera_info
from sims.cameras.development import Development
from sims.cameras.noise import generator

Image = npt.NDArray[np.uint8]
LIGHT = srgb_light()
RADTAN = {"model": "plumb_bob", "coefficients": [-0.1, 0.01, 0.0, 0.0]}


def spec(width: int = 64, height: int = 48, **settings: Any) -> CameraSpec:
    table = {"name": "c", "width": width, "height": height, **settings}
    return msgspec.convert(table, CameraSpec, dec_hook=lambda t, v: t.parse(v))


def developed(
    images: list[Image], shutter: tuple[float, float] = (0.0, 1.0), **settings: Any
) -> Image:
    """Return what becomes of some moments at an exposure time and gain."""
    height, width = images[0].shape[:2]
    development = Development(spec(width, height, **settings))
    return development.develop(images, generator(1, "c", 7), *shutter)


def flat(level: int, size: int = 300) -> Image:
    return np.full((size, size, 3), level, np.uint8)


@given(
    arrays.arrays(
        np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.sampled_from([1, 3]))
    )
)
def test_an_ideal_camera_changes_no_byte(image: Image) -> None:
    """Nor does one that exposes as long as its reference, nor moments that are all the same."""
    image = image[..., 0] if image.shape[2] == 1 else image
    assert developed([image]) is image
    np.testing.assert_array_equal(
        developed([image], (0.005, 1.0), exposure="5ms", reference_exposure="5ms"), image
    )
    np.testing.assert_array_equal(developed([image] * 3), image)


def test_moments_are_added_in_linear_light() -> None:
    """Half black and half white is not the grey level in the middle, but sRGB's 188."""
    assert (developed([flat(0), flat(255)]) == 188).all()


@pytest.mark.parametrize("factor", [0.1, 0.5, 2.0])
def test_exposure_and_gain_are_factors_on_the_light(factor: float) -> None:
    ramp = np.arange(256, dtype=np.uint8)[None].repeat(2, axis=0)
    settings: dict[str, Any] = {"exposure": "2ms", "reference_exposure": "2ms"}
    expected = np.rint(np.interp(LIGHT[ramp] * factor, LIGHT, np.arange(256)))
    np.testing.assert_array_equal(developed([ramp], (0.002 * factor, 1.0), **settings), expected)
    np.testing.assert_array_equal(developed([ramp], (0.002, factor), **settings), expected)
    np.testing.assert_array_equal(developed([ramp], (0.0, factor)), expected)


@pytest.mark.parametrize("grey", [True, False])
def test_a_vignette_darkens_as_announced(grey: bool) -> None:
    """In linear light, of every channel."""
    image = np.full((48, 64) if grey else (48, 64, 3), 200, np.uint8)
    found = developed([image], vignette=(-0.5, 0.1))
    light = LIGHT[200] * vignette_map(camera_info(spec()), (-0.5, 0.1))
    expected = np.interp(light if grey else light[..., None].repeat(3, 2), LIGHT, np.arange(256))
    np.testing.assert_allclose(found, expected, atol=0.6)


@pytest.mark.parametrize("level", [30, 128, 220])
@pytest.mark.parametrize("gain", [1.0, 4.0])
@pytest.mark.parametrize("full_well", [2000.0, 20_000.0])
def test_shot_noise_is_that_of_the_electrons(level: int, gain: float, full_well: float) -> None:
    """Variance = mean, in electrons: found back by undoing the response, quantisation apart."""
    factor = 1.0 / gain  # the same light, of a shorter exposure
    found = developed(
        [flat(level)],
        (0.001 * factor, gain),
        full_well=full_well,
        response="linear",
        exposure="1ms",
        reference_exposure="1ms",
    )
    electrons = found / 255.0 * full_well / gain
    expected = LIGHT[level] * full_well / gain
    step = full_well / gain / 255.0
    assert electrons.mean() == pytest.approx(expected, rel=0.01, abs=0.5 * step)
    clipped = expected + 4.0 * expected**0.5 > full_well / gain
    if expected**0.5 > 0.5 * step and not clipped:  # so that rounding is no more than a noise
        assert electrons.mean() == pytest.approx(expected, rel=0.01)
        assert electrons.var() == pytest.approx(expected + step**2 / 12, rel=0.04)
    else:
        assert level in {30, 220}


def test_announced_noise_is_the_one_at_middle_grey() -> None:
    """Shot noise and the other together."""
    settings = spec(noise=2.0, full_well=3000.0)
    announced = announcement(settings, source="d/c", prefix="d/", parent_frame_id="base_link")
    found = developed([flat(128)], noise=2.0, full_well=3000.0)
    assert announced.noise == pytest.approx(found.std(), rel=0.03)
    assert announced.noise > 2.5
    plain = announcement(spec(noise=2.0), source="d/c", prefix="", parent_frame_id="b")
    assert plain.noise == 2.0


def test_a_response_is_undone_by_what_is_announced(tmp_path: Path) -> None:
    """Of a file, and of names; 255 stays white."""
    file = tmp_path / "pcalib.txt"
    file.write_text(" ".join(f"{255 * (k / 255) ** 1.7:.9g}" for k in range(256)), "utf-8")
    ramp = np.arange(256, dtype=np.uint8)[None]
    for response in ("linear", "gamma", str(file)):
        found = developed([ramp], response=response)
        announced = announcement(
            spec(response=response), source="c", prefix="", parent_frame_id="b"
        )
        light = response_light(announced.response)
        levels = np.arange(256)
        np.testing.assert_array_equal(found[0], np.rint(np.interp(LIGHT, light, levels)))
        assert found[0, -1] == 255


def test_a_response_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for text in ("", "1 2 3", "a b"):
        file = tmp_path / "pcalib.txt"
        file.write_text(text, "utf-8")
        with pytest.raises(ValueError, match="response: expected srgb, linear, gamma or a file"):
            Development(spec(response=str(file)))
    with pytest.raises(ValueError, match=r"missing\.txt"):
        Development(spec(response="missing.txt"))


@given(
    st.floats(0.01, 50.0),
    st.integers(0, 255),
    st.sampled_from(["srgb", "linear", "gamma"]),
    st.sampled_from([0.0, 500.0, 1e5]),
)
def test_more_light_is_never_darker(
    factor: float, level: int, response: str, full_well: float
) -> None:
    """Whatever is on; and white is the end."""
    image = np.array([[level, 255]], np.uint8)
    settings: dict[str, Any] = {"response": response, "full_well": full_well}
    less, more = (developed([image], (0.0, g), **settings) for g in (factor, factor))
    np.testing.assert_array_equal(less, more)  # the same arguments, the same bytes
    if full_well == 0.0:
        brighter = developed([image], (0.0, 2.0 * factor), **settings)
        assert (brighter >= less).all()
        if factor >= 1.0:
            assert less[0, 1] == 255


def test_the_meter_reads_the_mean_light() -> None:
    random = np.random.default_rng(1)
    image = random.integers(0, 256, (240, 320, 3), np.uint8)
    for response in ("srgb", "linear"):
        development = Development(spec(320, 240, response=response))
        light = response_light(
            () if response == "srgb" else tuple(np.linspace(0.0, 1.0, 256).tolist())
        )
        assert development.meter(image) == pytest.approx(light[image].mean(), rel=0.02)
        assert development.meter(flat(255)) == 1.0
        assert development.meter(image[..., 0]) > 0.0


def test_defocus_is_in_linear_light() -> None:
    """A white line that blurs keeps its light."""
    image = np.zeros((41, 41), np.uint8)
    image[:, 20] = 255
    found = developed([image], blur=2.0)
    assert LIGHT[found[20]].sum() == pytest.approx(1.0, rel=0.02)
    assert cv2.minMaxLoc(found)[1] > 60


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"vignette": (0.5,)}, "vignette: expected shares of light from 0 to 1"),
        ({"vignette": (-1.5,)}, "vignette: expected shares of light from 0 to 1"),
        ({"auto_exposure": {}}, "auto_exposure: expected a reference_exposure"),
        (
            {"auto_exposure": {}, "reference_exposure": "1ms", "gain": 2.0},
            "neither exposure nor gain",
        ),
        ({"lens": RADTAN, "depth_sensor": {}}, "depth_sensor: expected a camera without"),
        (
            {"lens": RADTAN, "undistorted": True, "vignette": (-0.1,)},
            "undistorted: expected no vignette",
        ),
        ({"reference_exposure": "1ms"}, "reference_exposure: expected an exposure"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        spec(**settings)
