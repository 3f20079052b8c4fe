"""The rasteriser draws what MuJoCo's renderer draws, and the same bytes everywhere."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import msgspec
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from events import CameraInfo
from events.camera_info import DistortionModel
from events.frames import from_rpy
from sims.cameras import CameraSpec, GraphicsError, add_free_camera, pose_to_qpos
from sims.cameras.opengl import OpenGL
from sims.cameras.optics import Lens, pixel_rays
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import Drawn, Stage, View
from sims.compiled import libraries
from sims.worlds import TOURS, WORLDS
from tests.opencv import drawn_by_5
from tests.sims.cameras.scenes import fresh

HASHES = Path(__file__).with_name("raster.json")
"""Hash of all images of each world, on every machine. Where a change of the drawing is wanted,
``python -m tests.sims.cameras.test_raster`` writes it anew."""

PINHOLE = CameraSpec(name="pinhole", width=240, height=180, fov=85.0, position=(0.0, 0.0, 0.0))
FISHEYE = CameraSpec(
    name="fisheye",
    width=200,
    height=200,
    fov=190.0,
    position=(0.0, 0.0, 0.0),
    lens=Lens(model="equidistant", coefficients=(0.01, 0.002, 0.0, 0.0)),
)
SPECS = (PINHOLE, FISHEYE)
SLOW = pytest.mark.slow


def compiled(world: Any) -> Any:
    add_free_camera(world, "free", SPECS)
    return world.compile()


@cache
def model_of(name: str) -> Any:
    """Return the model of a world for the rasteriser alone: MuJoCo's renderer hides geoms in it."""
    return compiled(fresh(name))


def drawn(stage: Stage, spec: CameraSpec, place: Any, turn: Any) -> Drawn:
    camera = mujoco.mj_name2id(stage.model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{spec.name}")
    qpos = np.zeros(stage.model.nq)
    qpos[-7:] = pose_to_qpos(place, turn)
    stage.enter()
    stage.look(camera, qpos)
    return stage.draw(View(camera_info(spec)), True, True, True)


def places(name: str) -> Iterator[tuple[Any, Any]]:
    """Places along a world's tour, tilted this way and that."""
    for k, place in enumerate(TOURS[name]):
        yield place, from_rpy(0.1, 0.2 * math.cos(k), 0.9 * k)


def difference(one: Drawn, other: Drawn) -> tuple[float, float, float]:
    """Share of equal numbers; mean grey levels and greatest share of depth away from edges."""
    numbers, same = one.numbers, one.numbers == other.numbers
    assert numbers is not None
    assert one.colours is not None
    assert other.colours is not None
    assert one.depth is not None
    assert other.depth is not None
    edges = np.zeros(numbers.shape, np.uint8)
    edges[:, 1:] |= numbers[:, 1:] != numbers[:, :-1]
    edges[1:] |= numbers[1:] != numbers[:-1]
    inside = np.asarray(same) & (cv2.dilate(edges, np.ones((5, 5))) == 0)
    levels = np.abs(one.colours.astype(int) - other.colours)[inside]
    assert np.mean(np.isfinite(one.depth) == np.isfinite(other.depth)) > 0.98
    seen = inside & np.isfinite(one.depth) & np.isfinite(other.depth)
    apart = np.abs(one.depth[seen] - other.depth[seen]) / one.depth[seen]
    share = float(np.quantile(apart, 0.999)) if apart.size else 0.0  # a crease is no edge here
    return float(np.mean(same)), float(levels.mean()) if levels.size else 0.0, share


WORLD = [name if name == "hall" else pytest.param(name, marks=SLOW) for name in WORLDS]


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLD)
@pytest.mark.timeout(300)
def test_every_world_looks_as_mujoco_draws_it(name: str) -> None:
    model = compiled(fresh(name))
    raster, reference = Raster(model), OpenGL(model, tuple(map(camera_info, SPECS)), 1)
    for place, turn in itertools.islice(places(name), None, None, 3):
        numbers, levels, depth = difference(
            drawn(reference, PINHOLE, place, turn), drawn(raster, PINHOLE, place, turn)
        )
        assert numbers > 0.995
        assert levels < 3.0
        # Far ground is met at so flat an angle that a 32-bit direction decides about metres.
        assert depth < (3e-4 if name == "field" else 1e-4)
        numbers, levels, depth = difference(
            drawn(reference, FISHEYE, place, turn), drawn(raster, FISHEYE, place, turn)
        )
        assert numbers > 0.95  # drawn by way of a cube there, and at the pixel's own ray here
        assert levels < 6.0
        assert depth < 0.05
    raster.close()
    reference.close()


SHAPES = {
    "plane": '<geom type="plane" size="2 1.5 .1"/>',
    "endless": '<geom type="plane" size="0 0 .1"/>',
    "box": '<geom type="box" size="1 .5 .3"/>',
    "mesh": '<geom type="mesh" mesh="block"/>',
    "sphere": '<geom type="sphere" size=".5"/>',
    "ellipsoid": '<geom type="ellipsoid" size=".8 .5 .4"/>',
    "cylinder": '<geom type="cylinder" size=".5 .7"/>',
    "capsule": '<geom type="capsule" size=".5 .7"/>',
    "hfield": '<geom type="hfield" hfield="hill"/>',
}
SCENE = """
<mujoco>
  <visual><headlight ambient="{ambient}" diffuse=".3 .3 .3" specular="{shine}"/></visual>
  <asset>
    <mesh name="block" vertex="-1 -.5 -.3 1 -.5 -.3 -1 .5 -.3 1 .5 -.3 -1 -.5 .3 1 -.5 .3 -1 .5 .3
      1 .5 .3"/>
    <hfield name="hill" nrow="3" ncol="3" size="1 .7 .3 .1" elevation="0 0 0 0 1 0 0 0 0"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2=".1 .1 .2" width="64"
      height="384"/>
  </asset>
  <worldbody>{body}</worldbody>
</mujoco>
"""
LAMPS = """
<light type="spot" pos="-2 -1 3" dir=".6 .3 -1" cutoff="40" exponent="8" attenuation="1 .1 .02"/>
<light type="directional" dir="1 -.3 -1" diffuse=".4 .3 .2" specular=".5 .5 .5"/>
"""
AROUND = (
    ((-2.2, 0.3, -0.2), (0.0, 0.0, 0.0)),
    ((0.2, 2.2, -0.4), (0.0, 0.0, -0.5 * math.pi)),
    ((-1.5, -1.2, -1.4), (0.0, -0.6, 0.7)),
)


def ramps(cube: bool) -> npt.NDArray[np.uint8]:
    """Return a texture whose red says the column, whose green the row, and whose blue the side."""
    at = np.arange(128) * 2
    image = np.stack(np.broadcast_arrays(at[None, :], at[:, None], np.uint8(128)), -1)
    if not cube:
        return image.astype(np.uint8)
    sides = [np.concatenate([image[..., :2], image[..., 2:] * 0 + 40 * k], -1) for k in range(6)]
    return np.concatenate(sides).astype(np.uint8)


def shaped(body: str, ambient: str = "1 1 1", shine: str = "0 0 0", **material: Any) -> Any:
    """Return a model of some geoms, textured if `kind` says how."""
    world = mujoco.MjSpec.from_string(SCENE.format(body=body, ambient=ambient, shine=shine))
    if (kind := material.pop("kind", None)) is not None:
        image = material.pop("image", ramps(kind == mujoco.mjtTexture.mjTEXTURE_CUBE))
        texture = world.add_texture(
            name="ramps", type=kind, width=image.shape[1], height=len(image), nchannel=3
        )
        texture.data = image.tobytes()
        added = world.add_material(name="ramps", specular=0.0, **material)
        textures = list(added.textures)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ramps"
        added.textures = textures
        for geom in world.geoms:
            geom.material = "ramps"
    return compiled(world)


def compare(model: Any, levels: float, numbers: float = 0.99) -> None:
    raster, reference = Raster(model), OpenGL(model, (camera_info(PINHOLE),), 1)
    for place, turn in AROUND:
        differences = difference(
            drawn(reference, PINHOLE, place, from_rpy(*turn)),
            drawn(raster, PINHOLE, place, from_rpy(*turn)),
        )
        assert differences[0] >= numbers
        assert differences[1] <= levels
        assert differences[2] < 1e-3  # MuJoCo's depth buffer, close by
    raster.close()
    reference.close()


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", *(pytest.param(n, marks=SLOW) for n in SHAPES)])
def test_textures_lie_on_shapes_as_mujoco_lays_them(shape: str) -> None:
    flat, cube = mujoco.mjtTexture.mjTEXTURE_2D, mujoco.mjtTexture.mjTEXTURE_CUBE
    for uniform in (False, True):
        for repeat in ([1, 1], [3, 2]):
            compare(
                shaped(SHAPES[shape], kind=flat, texuniform=uniform, texrepeat=repeat), levels=2.0
            )
        if shape != "endless":  # a cube about a plane without end says nothing
            compare(shaped(SHAPES[shape], kind=cube, texuniform=uniform), levels=3.0)


# On a plane without end light is computed at vertices of other places.
@pytest.mark.parametrize(
    "shape", ["sphere", *(pytest.param(n, marks=SLOW) for n in SHAPES if n != "endless")]
)
def test_lights_shine_as_mujocos(shape: str) -> None:
    """Spot, sun and headlight, with gloss."""
    compare(shaped(LAMPS + SHAPES[shape], ambient=".2 .2 .2", shine=".4 .4 .4"), levels=2.0)


def test_a_point_light_shines_to_all_sides_and_falls_off() -> None:
    """As OpenGL's equations have it; MuJoCo's renderer leaves such lights dark."""
    lamp = (
        '<light type="point" pos="0 0 2" diffuse=".9 .6 .3" specular="0 0 0" attenuation="1 0 .5"/>'
    )
    floor = '<geom type="plane" size="4 4 .1" rgba="1 1 1 1"/>'
    scene = SCENE.replace(".3 .3 .3", "0 0 0").format(
        body=lamp + floor, ambient="0 0 0", shine="0 0 0"
    )
    world = mujoco.MjSpec.from_string(scene)
    world.visual.quality.numquads = 64  # light is computed at the corners of cells
    raster = Raster(compiled(world))
    turn = from_rpy(0.0, -0.5 * math.pi, 0.0)  # looking down
    image, depth, _ = drawn(raster, PINHOLE, (0.0, 0.0, -3.0), turn)
    assert image is not None
    assert depth is not None
    info = camera_info(PINHOLE)
    for row, column in ((90, 120), (30, 60), (150, 200)):
        place = (np.array([column, row]) - (info.cx, info.cy)) / (info.fx, info.fy) * 3.0
        distance = math.hypot(2.0, *place)
        expected = np.array([0.9, 0.6, 0.3]) * (2.0 / distance) / (1.0 + 0.5 * distance**2)
        np.testing.assert_allclose(image[row, column], 255.0 * expected, atol=1.5)
    raster.close()


@pytest.mark.slow
def test_what_is_see_through_is_blended_and_has_no_depth() -> None:
    """Its number is the nearest."""
    behind = '<geom type="box" size=".1 9 9" pos="5 0 1" rgba="1 0 0 1"/>'
    balls = "".join(
        f'<geom type="sphere" size=".4" pos="{0.3 * k} {y} 0.2" rgba="0 1 .2 .{k + 2}"/>'
        for k, y in enumerate((-0.6, -0.2, 0.2, 0.6))
    )
    model = shaped(LAMPS + behind + balls)
    compare(model, levels=1.0)
    raster = Raster(model)
    depth, numbers = drawn(raster, PINHOLE, (-3.0, 0.0, -0.2), (1.0, 0.0, 0.0, 0.0))[1:]
    assert depth is not None
    assert numbers is not None
    assert {*np.unique(numbers).tolist()} == {0, 1, 2, 3, 4}
    np.testing.assert_allclose(depth, 7.9, rtol=1e-6)
    raster.close()


def test_only_the_front_is_drawn_of_what_is_see_through() -> None:
    """As MuJoCo does, which draws it twice."""
    ball = '<geom type="sphere" size=".5" euler="0 70 20" rgba=".3 .8 .8 .5"/>'
    model = shaped(ball, ambient=".1 .1 .1", shine=".4 .4 .4")
    raster, reference = Raster(model), OpenGL(model, (camera_info(PINHOLE),), 1)
    near, ahead = (-1.5, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    ours, theirs = (drawn(stage, PINHOLE, near, ahead) for stage in (raster, reference))
    assert ours.colours is not None
    assert theirs.colours is not None
    inside = cv2.erode(np.asarray(theirs.numbers == 0, np.uint8), np.ones((5, 5))) > 0
    apart = np.abs(ours.colours.astype(int) - theirs.colours)[inside]
    assert apart.mean() <= 1.0
    raster.close()
    reference.close()


PLATE = """
<mujoco>
  <visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody><geom type="box" size=".01 .4 .3" pos="3 0 0" rgba="1 1 1 1"/></worldbody>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("roll", [0.0, 0.2, 0.7])
def test_a_plate_gives_the_light_of_its_area(spec: CameraSpec, roll: float) -> None:
    """Wherever between the pixels its outline runs."""
    raster = Raster(compiled(mujoco.MjSpec.from_string(PLATE)))
    light = []
    for shift in np.arange(8) * 0.003:  # a pixel is 0.018 at its distance, or 0.05
        image = drawn(raster, spec, (0.0, shift, 1.7 * shift), from_rpy(roll, 0.0, 0.0))[0]
        assert image is not None
        light.append(float(((image[..., 0] / 255.0) ** 2).sum()))
    assert np.ptp(light) < (0.008 if spec is PINHOLE else 0.03) * np.mean(light)
    if spec is PINHOLE:
        pixels = 0.8 * 0.6 * (camera_info(spec).fx / 2.99) ** 2
        np.testing.assert_allclose(light, pixels, rtol=0.005)
    raster.close()


def finer(info: CameraInfo, samples: int) -> View:
    """Return a view with squares of so many pixels a side in place of each."""
    size = {name: getattr(info, name) * samples for name in ("width", "height", "fx", "fy")}
    centre = {name: (getattr(info, name) + 0.5) * samples - 0.5 for name in ("cx", "cy")}
    return View(msgspec.structs.replace(info, **size, **centre))


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(width=st.integers(40, 500), ratio=st.floats(0.6, 1.6), far=st.floats(2.0, 12.0))
@example(width=333, ratio=1.04, far=6.0)
def test_textures_of_any_size_stay_in_place_in_the_distance(
    width: int, ratio: float, far: float
) -> None:
    """Where texels are smaller than pixels, they are where sixty-four smaller pixels see them."""
    spots = np.random.default_rng(1).uniform(0, 255, (9, 9, 3)).astype(np.uint8)
    image: Any = cv2.resize(spots, (width, round(width * ratio)), interpolation=cv2.INTER_CUBIC)
    body = f'<geom type="box" size=".01 1.2 1" pos="{far} 0 0"/>'
    raster = Raster(shaped(body, kind=mujoco.mjtTexture.mjTEXTURE_2D, image=image))
    seen, _, numbers = drawn(raster, PINHOLE, (0.0, 0.0, 0.0), from_rpy(0.0, 0.0, 0.0))
    many: Any = raster.draw(finer(camera_info(PINHOLE), 8), True, False, False).colours
    raster.close()
    squares = many.reshape(PINHOLE.height, 8, PINHOLE.width, 8, 3).mean(axis=(1, 3))
    inside = cv2.erode((np.asarray(numbers) >= 0).astype(np.uint8), np.ones((7, 7))) > 0
    slopes = [np.gradient(squares, axis=axis)[inside].ravel() for axis in (0, 1)]
    shift = np.linalg.lstsq(np.stack(slopes, 1), (squares - seen)[inside].ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
def test_outlines_and_textures_are_near_the_mean_of_many_samples(spec: CameraSpec) -> None:
    info, samples = camera_info(spec), 4
    raster = Raster(model_of("hall"))
    at_edges, elsewhere = [], []
    for place, turn in itertools.islice(places("hall"), None, None, 3):
        image, _, numbers = drawn(raster, spec, place, turn)
        many = raster.draw(finer(info, samples), True, False, False).colours
        assert image is not None
        assert many is not None
        assert numbers is not None
        squares = many.reshape(info.height, samples, info.width, samples, 3).astype(float) ** 2
        apart = np.abs(image - np.sqrt(squares.mean(axis=(1, 3)))).mean(axis=-1)
        edges = np.zeros(numbers.shape, bool)
        edges[:, 1:] |= numbers[:, 1:] != numbers[:, :-1]
        edges[1:] |= numbers[1:] != numbers[:-1]
        at_edges.append(apart[edges].mean())
        elsewhere.append(apart[~edges].mean())
    assert np.mean(elsewhere) < 3.5
    assert np.mean(at_edges) < 7.0
    raster.close()


@cache
def swarm() -> tuple[Raster, npt.NDArray[Any], npt.NDArray[Any]]:
    """Return a stage at rest among small balls on all sides, their middles seen and their radii."""
    random = np.random.default_rng(4)
    middles = random.normal(size=(60, 3))
    middles *= random.uniform(0.8, 5.0, (60, 1)) / np.linalg.norm(middles, axis=1)[:, None]
    radii = random.uniform(0.03, 0.3, 60)
    balls = "".join(
        f'<geom type="sphere" size="{r}" pos="{x} {y} {z}"/>'
        for (x, y, z), r in zip(middles, radii, strict=True)
    )
    raster = Raster(shaped(balls))
    drawn(raster, PINHOLE, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    # Ahead is MuJoCo's x, to the left its y, and up its z.
    return raster, middles @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), radii


@pytest.mark.slow
@given(
    model=st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant"]),
    bend=st.tuples(*[st.floats(-0.08, 0.08)] * 4),
    size=st.tuples(st.integers(20, 160), st.integers(20, 160)),
    focal=st.floats(15.0, 400.0),
    stretch=st.floats(0.8, 1.25),
    middle=st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9)),
)
@example(
    model="equidistant",
    bend=(0.0, 0.01171875, 0.0, 0.0),
    size=(112, 85),
    focal=15.0,
    stretch=1.0,
    middle=(0.25, 0.25),
)
@settings(max_examples=60, deadline=None)
def test_no_pixel_of_small_triangles_is_missed_by_any_lens(
    model: DistortionModel,
    bend: tuple[float, ...],
    size: tuple[int, int],
    focal: float,
    stretch: float,
    middle: tuple[float, float],
) -> None:
    """Where a ray meets a ball, the ball is drawn or what is before it."""
    raster, middles, radii = swarm()
    k1, k2, k3, k4 = bend
    if model != "equidistant":
        bend = k1, k2, 0.02 * k3, 0.02 * k4, 0.0
    if model == "rational_polynomial":
        bend = *bend, 0.1, 0.02, 0.0
    width, height = size
    info = CameraInfo(
        width=width,
        height=height,
        fx=focal,
        fy=focal * stretch,
        cx=middle[0] * width,
        cy=middle[1] * height,
        distortion_model=model,
        distortion=bend,
    )
    _, depth, numbers = raster.draw(View(info), False, True, True)
    assert depth is not None
    assert numbers is not None
    rays = pixel_rays(info).reshape(-1, 3)
    along = rays @ middles.T
    aside = np.sqrt(np.maximum((middles**2).sum(axis=1) - along**2, 0.0))
    met = (along > 0.0) & (aside < 0.93 * radii)  # triangles are within their ball
    distance = np.where(met, along, np.inf).min(axis=1)
    wanted = np.isfinite(distance)
    assert (numbers.ravel()[wanted] >= 0).all()
    ahead = wanted & (rays[:, 2] > 0.01)
    assert (depth.ravel()[ahead] <= (distance * rays[:, 2])[ahead] + 1e-4).all()


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
def test_some_rows_are_those_of_the_whole_image(spec: CameraSpec) -> None:
    raster = Raster(model_of("hall"))
    place, turn = next(places("hall"))
    whole = drawn(raster, spec, place, turn)
    for first, last in ((0, 1), (7, 60), (spec.height - 17, spec.height)):
        part = raster.draw(View(camera_info(spec)), True, True, True, (first, last))
        for image, rows in zip(whole, part, strict=True):
            assert image is not None
            np.testing.assert_array_equal(image[first:last], rows)
    raster.close()


def test_each_image_is_the_same_alone() -> None:
    raster = Raster(model_of("hall"))
    whole = drawn(raster, PINHOLE, *next(places("hall")))
    for wanted in itertools.product((False, True), repeat=3):
        colour, depth, numbers = wanted
        drawn_alone = raster.draw(View(camera_info(PINHOLE)), colour, depth, numbers)
        for alone, image, asked in zip(drawn_alone, whole, wanted, strict=True):
            assert (alone is not None) == asked
            if alone is not None and image is not None:
                np.testing.assert_array_equal(alone, image)
    raster.close()


def hash_of(name: str, instructions: str, threads: int = 1) -> str:
    model, total = model_of(name), hashlib.sha256()
    raster = Raster(model, threads=threads, instructions=instructions)
    for place, turn in itertools.islice(places(name), 9):
        for spec in SPECS:
            for image in drawn(raster, spec, place, turn):
                assert image is not None
                total.update(image.tobytes())
    raster.close()
    return total.hexdigest()


def test_panes_behind_each_other_are_mixed_from_the_back_by_any_number_of_threads() -> None:
    """Each thread takes some of them."""
    panes = "".join(
        f'<geom type="box" size=".01 1 1" pos="{2 + 0.2 * k} 0 0" '
        f'rgba="{k % 2} {k % 3 / 2} {k % 5 / 4} .5"/>'
        for k in range(9)
    )
    xml = f"<mujoco><worldbody>{panes}</worldbody></mujoco>"
    model = compiled(mujoco.MjSpec.from_string(xml))
    images = []
    for threads in (1, 2, 5):
        raster = Raster(model, threads=threads)
        images.append(drawn(raster, PINHOLE, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        raster.close()
    for other in images[1:]:
        for image, same in zip(images[0], other, strict=True):
            assert image is not None
            np.testing.assert_array_equal(image, same)


@drawn_by_5
@pytest.mark.parametrize("name", WORLD)
@pytest.mark.timeout(300)
def test_the_bytes_are_those_of_every_machine(name: str) -> None:
    """With each instruction set that this one has, and by any number of threads."""
    saved = json.loads(HASHES.read_text(encoding="utf-8"))
    hashes = {hash_of(name, library) for library in libraries()} | {
        hash_of(name, "", k) for k in (2, 5, 99)
    }
    assert hashes == {saved[name]}


def test_what_it_cannot_draw_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    world = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" '
        'radius=".01" dim="2"><edge equality="true"/></flexcomp></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match=r'without flex, found 1; "mujoco" draws them'):
        Raster(compiled(world))
    monkeypatch.setattr("sims.cameras.raster.libraries", dict)
    with pytest.raises(GraphicsError, match=r'apt-get install g\+\+.* or say renderer = "mujoco"'):
        Raster(compiled(mujoco.MjSpec()))


if __name__ == "__main__":
    text = json.dumps({name: hash_of(name, "") for name in WORLDS}, indent=2)
    HASHES.write_text(text + "\n", encoding="utf-8")
