"""Extreme numbers of worlds and cameras are drawn by their meaning, or refused with a sentence."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import CameraInfo
from events.frames import from_rpy
from sims.cameras.opengl import OpenGL
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import View
from sims.compiled import libraries
from tests.sims.cameras.hostile import Fog
from tests.sims.cameras.test_raster import (
    PINHOLE,
    SHAPES,
    compare,
    compiled,
    difference,
    drawn,
    shaped,
)

DOWN = from_rpy(0.0, -0.5 * math.pi, 0.0)  # its image is up along x, and to the left along y
FLAT = mujoco.mjtTexture.mjTEXTURE_2D
FLOOR = """
<mujoco>
  <statistic extent="8"/>
  <visual>
    <headlight ambient="{ambient}" diffuse="0 0 0" specular="0 0 0"/>
    <quality shadowsize="{size}"/>
    {visual}
  </visual>
  <worldbody>
    {light}
    <geom type="plane" size="4 4 .01" rgba="1 1 1 1"/>
    {body}
  </worldbody>
</mujoco>
"""


def floor(
    light: str = "", body: str = "", ambient: str = "0 0 0", visual: str = "", size: int = 0
) -> Any:
    """Return a model of a white floor below a light."""
    text = FLOOR.format(light=light, body=body, ambient=ambient, visual=visual, size=size)
    return compiled(mujoco.MjSpec.from_string(text))


def seen(
    model: Any, place: Any = (0.0, 0.0, -3.0), turn: Any = DOWN, fog: bool = False
) -> npt.NDArray[np.uint8]:
    """Return the colours that a pinhole camera sees from a place, from above by default."""
    raster = Raster(model, Fog(fog))
    image = drawn(raster, PINHOLE, place, turn).colours
    raster.close()
    assert image is not None
    return image


@pytest.mark.parametrize("step", [0.25, 3.0], ids=["magnified", "reduced"])
@pytest.mark.parametrize("size", [(40_000, 1), (1, 40_000), (65_537, 1), (1, 65_537), (3, 131_071)])
def test_textures_of_any_width_are_drawn_texel_by_texel(size: tuple[int, int], step: float) -> None:
    """A pixel shows the mean of the two texels about it; `step` texels are a pixel."""
    width, height = size
    count = max(size)
    levels = (np.arange(count) % 192).astype(np.uint8)
    image = np.broadcast_to(
        levels[None, :, None] if width > height else levels[:, None, None], (height, width, 3)
    )
    model = shaped('<geom type="plane" size="1 1 1"/>', kind=FLAT, image=image)
    middle = 192 * round(0.93 * count / 192) + 96  # texels, in the middle of a ramp
    along, texel = 2.0 * (middle + 0.5) / count - 1.0, 2.0 / count  # metres
    focal = 0.05 / (step * texel)  # from 5 cm above
    info = CameraInfo(width=32, height=24, fx=focal, fy=focal, cx=15.5, cy=11.5)
    raster = Raster(model)
    drawn(raster, PINHOLE, (along, 0.3, -0.05) if width > height else (0.3, along, -0.05), DOWN)
    colours = raster.draw(View(info), True, False, False).colours
    raster.close()
    assert colours is not None
    pixels = 11.5 - np.arange(24)[:, None] if width > height else np.arange(32)[None, :] - 15.5
    expected = np.broadcast_to(96.0 + step * pixels, (24, 32))
    np.testing.assert_allclose(colours[..., 1], expected, atol=1.5)


def test_texels_and_triangles_that_have_no_room_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each has a number: of 31 bits, and of 24 bits."""
    model = shaped(SHAPES["box"], kind=FLAT)
    monkeypatch.setattr("sims.cameras.packed.MOST_TRIANGLES", 192)  # of a box
    with pytest.raises(ValueError, match="fewer than 192 triangles in all, found 192"):
        Raster(model)

    monkeypatch.undo()
    library = next(iter(libraries().values()))
    texels = 2 + sum(
        library.raster_texel_count(int(width), int(height), int(cube))
        for width, height, cube in zip(
            model.tex_width, model.tex_height, model.tex_type != FLAT, strict=True
        )
    )
    monkeypatch.setattr("sims.cameras.texels.MOST_TEXELS", texels)
    Raster(model).close()
    monkeypatch.setattr("sims.cameras.texels.MOST_TEXELS", texels - 1)
    with pytest.raises(ValueError, match=r"texture ramps: expected fewer than 2³¹ texels"):
        Raster(model)


def test_a_texture_repeated_no_times_lies_once_on_a_surface() -> None:
    """As MuJoCo has it, also of fewer; here of each axis alone."""
    for repeat, same in (([0, 0], [1, 1]), ([0, 3], [1, 3]), ([2, -4], [2, 1])):
        one, other = (
            seen(shaped(SHAPES["plane"], kind=FLAT, texrepeat=times)) for times in (repeat, same)
        )
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("repeat", [[0, 0], [0, 2], [-3, -2]])
def test_textures_repeated_no_times_are_drawn_as_mujocos(shape: str, repeat: list[int]) -> None:
    """Meshes and height fields that are textured from above have a single texel's colour."""
    for uniform in (False, True):
        compare(shaped(SHAPES[shape], kind=FLAT, texuniform=uniform, texrepeat=repeat), levels=2.0)


def test_a_floor_from_below_is_see_through() -> None:
    """With three tenths of its opacity, drawn twice as all that is see-through; without depth."""
    box = '<geom type="box" size="3 3 .1" pos="0 0 1.1" rgba="0 0 1 1"/>'
    model = floor(body=box, ambient="1 1 1")
    model.geom_rgba[0] = (1, 0, 0, 1)
    raster = Raster(model)
    up = from_rpy(0.0, 0.5 * math.pi, 0.0)
    colours, depth, numbers = drawn(raster, PINHOLE, (0.0, 0.0, 1.5), up)
    assert colours is not None
    assert depth is not None
    inner = np.s_[40:140, 60:180]
    share = 255.0 * (1.0 - 0.7**2)
    expected = np.broadcast_to([share, 0.0, 255.0 - share], (100, 120, 3))
    np.testing.assert_allclose(colours[inner], expected, atol=1.5)
    np.testing.assert_allclose(depth[inner], 2.5, rtol=1e-5)
    assert numbers is not None
    assert (numbers == 0).all()
    above, _, _ = drawn(raster, PINHOLE, (0.0, 0.0, -0.5), DOWN)
    raster.close()
    assert above is not None
    assert (above == [255, 0, 0]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "turn"),
    [((-2.0, 0.3, 0.7), (0.0, 0.4, 0.1)), ((0.5, 1.0, 1.5), (0.2, 0.9, -0.6))],
)
def test_planes_from_behind_are_drawn_as_mujocos(place: Any, turn: Any) -> None:
    things = """
      <geom type="sphere" size=".5" pos="3 0 1" rgba=".9 .2 .2 1"/>
      <geom type="box" size=".3 .4 .5" pos="1 -1 .8" euler="0 20 30" rgba=".2 .8 .3 1"/>
    """
    light = '<light pos="0 0 3" dir=".4 0 -1" cutoff="60" castshadow="false"/>'
    model = floor(light, things, ambient=".3 .3 .3")
    raster, reference = Raster(model), OpenGL(model, (camera_info(PINHOLE),), 1)
    numbers, levels, _ = difference(
        drawn(reference, PINHOLE, place, from_rpy(*turn)),
        drawn(raster, PINHOLE, place, from_rpy(*turn)),
    )
    raster.close()
    reference.close()
    assert numbers > 0.99
    assert levels < 1.5


SHADED = """
<light type="{kind}" pos="1 1 4" dir="-.3 -.25 -1" cutoff="{cutoff}" exponent="0"/>
"""
PILLAR = '<geom type="box" size=".3 .3 .5" pos="0 0 .5"/>'


@pytest.mark.parametrize("kind", ["spot", "directional"])
def test_maps_without_pixels_throw_no_shadows(kind: str) -> None:
    """MuJoCo leaves a map's border out, which two pixels are; and a sun's may cover nothing."""
    light = SHADED.format(kind=kind, cutoff=40)
    none = seen(floor(light, PILLAR))
    assert (seen(floor(light, PILLAR, size=512)) != none).any()
    for size in (1, 2):
        np.testing.assert_array_equal(seen(floor(light, PILLAR, size=size)), none)
    if kind == "directional":
        covers_nothing = floor(light, PILLAR, visual='<map shadowclip="0"/>', size=512)
        np.testing.assert_array_equal(seen(covers_nothing), none)


def test_a_cone_that_widens_throws_the_shadows_of_the_wide_one() -> None:
    raster = Raster(floor(SHADED.format(kind="spot", cutoff=20), PILLAR, size=64))
    drawn(raster, PINHOLE, (0.0, 0.0, -3.0), DOWN)
    raster.model.light_cutoff[:] = 60.0
    wide = drawn(raster, PINHOLE, (0.0, 0.0, -3.0), DOWN).colours
    raster.close()
    expected = seen(floor(SHADED.format(kind="spot", cutoff=60), PILLAR, size=64))
    np.testing.assert_array_equal(wide, expected)


LAMP = """
<light type="spot" pos="0 0 2" dir="0 0 -1" diffuse="{colour}" specular="0 0 0" castshadow="false"
  cutoff="{cutoff}" exponent="{exponent}" attenuation="{fall}"/>
"""


def lamp(
    colour: str = "1 1 1", cutoff: float = 85, exponent: float = 0, fall: str = "1 0 0"
) -> str:
    return LAMP.format(colour=colour, cutoff=cutoff, exponent=exponent, fall=fall)


def angles() -> npt.NDArray[np.float64]:
    """Angles at the lamp, 2 m above the floor, of what the pixels of `seen` show."""
    info = camera_info(PINHOLE)
    rows, columns = np.mgrid[0 : info.height, 0 : info.width]
    aside = 3.0 * np.hypot((columns - info.cx) / info.fx, (rows - info.cy) / info.fy)
    return np.asarray(np.arctan2(aside, 2.0))


@pytest.mark.parametrize("exponent", [40.0, 100.0, 300.0, 1000.0, 1e30])
def test_a_spot_of_any_exponent_darkens_by_that_power_of_the_cosine(exponent: float) -> None:
    image, angle = seen(floor(lamp(exponent=exponent))), angles()
    assert image[89:91, 119:121].max() > 200  # below it
    nearer = np.maximum(angle - 0.15, 0.0)  # light is computed at the corners of cells of 0.2 m
    most = 255.0 * np.cos(nearer) ** min(exponent, 1e6) + 1.5
    assert (image.max(axis=2) <= most).all()


def test_a_light_that_falls_off_by_nothing_saturates() -> None:
    """As the limit of ever less: its colour everywhere in its cone, and no other."""
    for fall in ("0 0 0", "0 1e-30 0", "1e-4 0 0"):
        light = lamp(colour="1 0 .5", fall=fall)
        image = seen(floor(light))
        thrown = seen(floor(light.replace("false", "true"), size=64))
        np.testing.assert_array_equal(image, thrown)
        assert (image[angles() < 0.6] == [255, 0, 255]).all()


@pytest.mark.parametrize("cutoff", [120.0, 180.0, -5.0])
def test_a_spot_whose_cone_opengl_does_not_have_shines_to_all_sides(cutoff: float) -> None:
    """Of any exponent."""
    image = seen(floor(lamp(cutoff=cutoff, exponent=7, fall=".5 .2 .1")))
    away = 2.0 / np.cos(angles())
    expected = 255.0 * np.cos(angles()) / (0.5 + 0.2 * away + 0.1 * away**2)
    np.testing.assert_allclose(image[..., 0], expected, atol=2.0)


def test_colours_of_fog_and_lights_beyond_white_are_white() -> None:
    fog = '<rgba fog="{}"/><map fogstart="0" fogend=".6"/>'
    for beyond, within in (("2 -1 .5 1", "1 0 .5 1"), ("1e30 65536 -1e30 1", "1 1 0 1")):
        one, other = (
            seen(floor(ambient=".5 .5 .5", visual=fog.format(colour)), fog=True)
            for colour in (beyond, within)
        )
        np.testing.assert_array_equal(one, other)
    assert (seen(floor(lamp(colour="1e30 1e30 -1e30")))[80:100, 110:130] == [255, 255, 0]).all()


@pytest.mark.parametrize("edge", [0.2, 0.5])
def test_fog_that_ends_where_it_starts_is_a_wall(edge: float) -> None:
    """Clear before, nothing but fog behind: 3 m are 0.375 of the extent."""
    visual = f'<rgba fog="1 0 0 1"/><map fogstart="{edge}" fogend="{edge}"/>'
    image = seen(floor(ambient=".5 .5 .5", visual=visual), fog=True)
    assert (image == ([255, 0, 0] if edge < 0.375 else [127, 127, 127])).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("vis.quality", "shadowsize", -5), "shadowsize: expected 0 or more, found -5"),
        (("vis.quality", "numslices", -1), "numslices: expected 0 or more, found -1"),
        (("stat", "extent", math.inf), "extent: expected a number from 1e-9 m, found inf m"),
        (("", "light_attenuation", [1, -0.5, 0]), "light 0: attenuation: .* found 1 -0.5 0"),
        (("", "light_attenuation", [math.nan, 0, 0]), "light 0: attenuation: .* found nan 0 0"),
    ],
    ids=lambda value: value[1] if isinstance(value, tuple) else "",
)
def test_settings_without_a_meaning_are_refused(change: tuple[str, str, Any], words: str) -> None:
    """By both renderers, before they open anything."""
    model = floor(lamp())
    where, name, value = change
    owner = model
    for part in where.split(".") if where else ():
        owner = getattr(owner, part)
    if isinstance(value, list):
        getattr(owner, name)[0] = value
    else:
        setattr(owner, name, value)
    for stage in (Raster, lambda model: OpenGL(model, (camera_info(PINHOLE),), 1)):
        with pytest.raises(ValueError, match=words):
            stage(model)


@pytest.mark.parametrize("focal", [1e6, 1e12, 1e40])
def test_a_lens_of_any_focal_length_sees_what_is_ahead(focal: float) -> None:
    """The same by each instruction set, also where float32 does not tell its rays apart."""
    info = CameraInfo(width=40, height=3, fx=focal, fy=focal, cx=20.0, cy=1.0)
    for instructions in libraries():
        raster = Raster(floor(ambient=".5 .5 .5"), instructions=instructions)
        drawn(raster, PINHOLE, (0.1, 0.1, -3.0), DOWN)
        colours, depth, numbers = raster.draw(View(info), True, True, True)
        raster.close()
        assert colours is not None
        assert depth is not None
        np.testing.assert_array_equal(colours, np.full((3, 40, 3), 127))
        np.testing.assert_allclose(depth, np.full((3, 40), 3.0), rtol=1e-5)
        np.testing.assert_array_equal(numbers, np.zeros((3, 40)))


COLUMNS = "".join(
    f'<geom type="box" size="1 .1 5" pos="6 {0.2 * k} 0" rgba="{k % 7 / 7} {k % 5 / 5} .5 1"/>'
    for k in range(-30, 30)
)


def rows_of(raster: Raster, info: CameraInfo, shifts: list[float]) -> npt.NDArray[np.int32]:
    """Return the numbers that a camera sees whose rows are read while it moves to the right."""
    camera = mujoco.mj_name2id(raster.model, mujoco.mjtObj.mjOBJ_CAMERA, "free/pinhole")
    for shift in shifts:
        raster.keep(camera, np.array([0.0, -shift, 0.0, 1.0, 0.0, 0.0, 0.0]), 0.0)
    raster.look(camera, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    numbers = raster.draw(View(info), True, True, True).numbers
    assert numbers is not None
    return numbers


@pytest.fixture(scope="module")
def columns() -> Any:
    raster = Raster(shaped(COLUMNS))
    yield raster
    raster.close()


@settings(max_examples=12, deadline=None)
@given(height=st.integers(1, 90), poses=st.integers(2, 70))
def test_each_row_is_of_its_own_time_however_few_there_are(
    columns: Raster, height: int, poses: int
) -> None:
    """Of `height` rows, row v is of the share v / (height - 1) of the way, a single one of half."""
    info = CameraInfo(width=48, height=height, fx=40.0, fy=1e4, cx=24.0, cy=0.5 * height)
    shifts = np.linspace(-1.5, 1.5, poses).tolist()
    numbers = rows_of(columns, info, shifts)
    share = np.arange(height) / (height - 1) if height > 1 else np.array([0.5])
    seen_at = 5.0 * (np.arange(48) - 24.0) / 40.0 - 1.5 + 3.0 * share[:, None]  # to the right
    place = -seen_at / 0.2 + 30.5  # in boxes from the rightmost one
    sure = np.abs(place - np.rint(place)) > 0.01
    np.testing.assert_array_equal(numbers[sure], np.floor(place).astype(int)[sure])


@pytest.mark.parametrize(("height", "poses"), [(37, 29), (120, 22), (64, 50), (1024, 16)])
def test_no_row_is_drawn_twice_or_left_out(columns: Raster, height: int, poses: int) -> None:
    """Where a pose's row is a whole number but for rounding."""
    info = CameraInfo(width=16, height=height, fx=40.0, fy=1e4, cx=8.0, cy=0.5 * height)
    still = rows_of(columns, info, [0.3] * poses)
    np.testing.assert_array_equal(still, rows_of(columns, info, [0.3]))


def test_a_camera_that_turns_about_between_two_rows_draws_the_same_bytes_anywhere() -> None:
    model = shaped(COLUMNS + SHAPES["endless"])
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "free/pinhole")
    images = set()
    for instructions in libraries():
        raster = Raster(model, instructions=instructions)
        for turn in ((1, 0, 0, 0), (0.6, 0.8, 0, 0), (0, 0.6, 0.8, 0), (0, 0, 0, 1)):
            raster.keep(camera, np.array([0.0, 0.0, 1.0, *turn]), 0.0)
        raster.look(camera, np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        parts = raster.draw(View(camera_info(PINHOLE)), True, True, True)
        images.add(b"".join(part.tobytes() for part in parts if part is not None))
        raster.close()
    assert len(images) == 1
