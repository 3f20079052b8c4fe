"""AirSim's types of image, and a renderer that draws what the run's own cameras see."""

from __future__ import annotations

import math
from typing import Any

import cv2
import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import CameraInfo
from sims.cameras import CameraRenderer, CameraSpec, add_camera, model_to_bytes
from sims.cameras.optics import Lens
from sims.cameras.spec import camera_info
from sims.cameras.stage import Drawn
from sims.vehicle import attach_vehicle
from tests.sims.cameras.scenes import frames_of
from visnav_airsim import wire
from visnav_airsim.server.cameras import camera_of_file
from visnav_airsim.server.rendering import (
    SKY,
    Form,
    ImageType,
    Renderer,
    Seen,
    Wanted,
    as_colours,
    as_numbers,
    packed,
    palette,
    surface_normals,
)

WORLD = """
<mujoco>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".4 .6 .8" rgb2="0 0 0" width="64"
      height="64"/>
    <texture name="chess" type="2d" builtin="checker" rgb1=".2 .3 .4" rgb2=".8 .7 .6" width="64"
      height="64"/>
    <material name="chess" texture="chess" texrepeat="20 20"/>
  </asset>
  <worldbody>
    <light pos="0 0 9"/>
    <geom name="floor" type="plane" size="50 50 1" material="chess"/>
    <geom name="wall" type="box" size="1 3 3" pos="5 0 3" rgba=".9 .3 .2 1"/>
    <geom name="ball" type="sphere" size="0.4" pos="2 -0.5 1" rgba=".2 .8 .3 1"/>
  </worldbody>
</mujoco>
"""
CAMERAS = (
    CameraSpec(name="plain", width=64, height=48, images=("rgb", "depth", "segmentation")),
    CameraSpec(
        name="turned",
        width=50,
        height=70,
        fov=63.7,
        position=(0.1, -0.2, 0.03),
        orientation=(7.0, -21.3, 33.0),
        light=0.6,
        images=("rgb", "depth", "segmentation"),
    ),
    CameraSpec(
        name="calibrated",
        width=64,
        height=48,
        intrinsics=(40.0, 41.0, 30.5, 25.0),
        images=("rgb", "depth", "segmentation"),
    ),
)
LENS = CameraSpec(
    name="lens",
    width=64,
    height=48,
    lens=Lens(model="plumb_bob", coefficients=(-0.2, 0.05, 0.0, 0.0)),
    noise=9.0,
)


@pytest.fixture(scope="module")
def model() -> Any:
    spec = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(spec, "drone", (0.3, 0.2, -1.2), 0.4)
    for camera in (*CAMERAS, LENS):
        add_camera(spec, "drone/base_link", camera, "drone/")
    spec.worldbody.add_camera(name="spare")
    return spec.compile()


@pytest.fixture(scope="module")
def renderer(model: Any) -> Renderer:
    return Renderer(model_to_bytes(model), "spare", tuple(map(camera_info, (*CAMERAS, LENS))))


def wanted(model: Any, spec: CameraSpec, *forms: tuple[int, Form]) -> list[Wanted]:
    eye = camera_of_file(spec, model.body("drone/base_link").id).eye(0)
    return [Wanted(eye, ImageType(kind), form) for kind, form in forms]


def depths(image: Any, spec: CameraSpec) -> Any:
    """Return the numbers of an image that was taken as floats."""
    numbers = image[5:].reshape(-1, 5)[:, 1:].copy().view(">f4")
    return numbers.astype(np.float32).reshape(spec.height, spec.width)


@pytest.mark.parametrize("spec", CAMERAS, ids=lambda spec: spec.name)
def test_a_camera_of_the_file_gives_the_same_bytes(
    model: Any, renderer: Renderer, spec: CameraSpec
) -> None:
    own = CameraRenderer(model_to_bytes(model), CAMERAS, "drone/", seed=1)
    forms: list[tuple[int, Form]] = [(0, "rgb"), (1, "float"), (7, "rgb"), (0, "bgr")]
    for turn in (0.0, 0.8):
        qpos = model.qpos0.copy()
        qpos[3:7] = math.cos(turn), math.sin(turn), 0.1, 0.0
        frame = frames_of(own, 5, qpos, (spec.name,))[spec.name]
        ids = np.arange(model.ngeom + 1, dtype=np.uint8)
        colour, depth, numbers, _ = renderer.render(5, qpos, ids, wanted(model, spec, *forms))
        assert frame.rgb is not None
        assert frame.depth is not None
        assert frame.segmentation is not None
        assert len(np.unique(frame.rgb)) > 20
        assert np.array_equal(colour.reshape(frame.rgb.shape), frame.rgb)
        assert np.array_equal(depths(depth, spec), np.minimum(frame.depth, 65504.0))
        expected = np.where(frame.segmentation < 0, model.ngeom, frame.segmentation)
        assert np.array_equal(numbers.reshape(frame.rgb.shape)[..., 0], expected)
    own.close()


def test_lens_and_noise_are_left_out(model: Any, renderer: Renderer) -> None:
    ids = np.zeros(model.ngeom + 1, np.uint8)
    pair = [*wanted(model, LENS, (1, "float"), (0, "rgb")), *wanted(model, CAMERAS[0], (0, "rgb"))]
    depth, ideal, plain = renderer.render(0, model.qpos0, ids, pair)
    assert ideal.size == plain.size
    planes = np.diff(1.0 / depths(depth, LENS)[-6:], 2)  # of the floor, without distortion
    assert np.abs(planes).max() < 1e-5
    assert np.array_equal(ideal, renderer.render(0, model.qpos0, ids, [pair[1]])[0])


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_what_is_drawn_together_is_what_is_drawn_alone(
    model: Any, renderer: Renderer, data: st.DataObject
) -> None:
    kinds = st.sampled_from(ImageType)
    formats: st.SearchStrategy[Form] = st.sampled_from(["float", "rgb", "bgr", "png"])
    specs = st.sampled_from(CAMERAS)
    chosen = data.draw(st.lists(st.tuples(specs, kinds, formats), max_size=6))
    images = [
        requested for spec, *what in chosen for requested in wanted(model, spec, (what[0], what[1]))
    ]
    ids = np.arange(model.ngeom + 1, dtype=np.uint8)
    together = renderer.render(0, model.qpos0, ids, images)
    assert len(together) == len(images)
    for image, request in zip(together, images, strict=True):
        pixels = request.eye.spec.width * request.eye.spec.height
        if request.form != "png":
            assert image.size == (5 * pixels + 5 if request.form == "float" else 3 * pixels)
        (alone,) = renderer.render(0, model.qpos0, ids, [request])
        assert np.array_equal(image, alone)


INFO = CameraInfo.from_fov(16, 12, math.radians(90.0))
RAYS = INFO.unproject(np.mgrid[0:12, 0:16][::-1].reshape(2, -1).T).reshape(12, 16, 3)
"""Unit rays of all pixels."""


def seen(
    depth: npt.NDArray[np.float32] | None = None,
    colours: npt.NDArray[np.uint8] | None = None,
    numbers: npt.NDArray[np.int32] | None = None,
) -> Seen:
    ids = np.array([7, 0, 255, 0], np.uint8)
    return Seen(Drawn(colours, depth, numbers), INFO, ids, np.eye(3))


def plane(normal: npt.NDArray[np.float64], distance: float) -> npt.NDArray[np.float32]:
    """Return the planar depth of a plane at a distance; ``inf`` where no ray meets it."""
    facing = RAYS @ -normal
    with np.errstate(divide="ignore"):
        depth = np.where(facing > 0.0, distance / facing, np.inf) * RAYS[..., 2]
    return depth.astype(np.float32)


def test_ids_have_colours_of_their_own_and_none_is_black() -> None:
    colours = palette()
    assert len({tuple(colour) for colour in colours.tolist()}) == 256
    assert colours[[0, 1, 2, 4, 8]].tolist() == [
        [0, 0, 0],
        [128, 0, 0],
        [0, 128, 0],
        [0, 0, 128],
        [64, 0, 0],
    ]


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (ImageType.DEPTH_PLANAR, 4.0),
        (ImageType.DEPTH_VIS, 0.04),
        (ImageType.DISPARITY, 0.125 / 4.0),
    ],
)
def test_numbers_of_depth(kind: ImageType, expected: float) -> None:
    depth = np.full((12, 16), 4.0, np.float32)
    numbers = as_numbers(kind, seen(depth))
    assert numbers.dtype == np.float32
    assert numbers == pytest.approx(np.full((12, 16), expected))
    grey = min(round(expected * 255), 255)
    assert (as_colours(kind, seen(depth)) == grey).all()


def test_perspective_depth_is_measured_along_the_ray() -> None:
    depths = as_numbers(ImageType.DEPTH_PERSPECTIVE, seen(np.full((12, 16), 4.0, np.float32)))
    assert depths[..., None] * RAYS[..., 2:] == pytest.approx(4.0, rel=1e-6)


def test_the_sky_is_far_white_and_has_neither_disparity_nor_normal() -> None:
    sky = seen(np.full((12, 16), np.inf, np.float32), numbers=np.full((12, 16), -1, np.int32))
    for kind, number in {1: SKY, 2: SKY, 3: 1.0, 4: 0.0, 5: 0.0, 6: 0.0, 7: 0.0}.items():
        numbers = as_numbers(ImageType(kind), sky)
        assert numbers == pytest.approx(np.full((12, 16), number), abs=1e-5), kind
    assert (as_colours(ImageType.DEPTH_VIS, sky) == 255).all()
    assert not as_colours(ImageType.SURFACE_NORMALS, sky).any()


def test_segmentation_shows_ids_by_colour_and_infrared_by_grey() -> None:
    numbers = np.zeros((12, 16), np.int32)
    numbers[0], numbers[1] = 2, -1
    image = seen(numbers=numbers)
    assert (as_colours(ImageType.SEGMENTATION, image)[2:] == palette()[7]).all()
    assert as_colours(ImageType.INFRARED, image)[:3, 0].tolist() == [[255] * 3, [0] * 3, [7] * 3]
    assert as_numbers(ImageType.INFRARED, image)[0] == pytest.approx(np.ones(16))


@given(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(0.05, 100.0))
def test_a_plane_has_one_normal(tilt: float, turn: float, distance: float) -> None:
    normal = -np.array([math.sin(turn), math.cos(turn) * math.sin(tilt), math.cos(turn)])
    normal[2] *= math.cos(tilt)
    depth = plane(normal, distance)
    whole = np.isfinite(depth)
    whole &= cv2.erode(whole.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0
    normals = surface_normals(depth, INFO)[whole]
    assert np.abs(normals - normal).max(initial=0.0) < 1e-3


def test_at_a_crease_each_pixel_has_the_normal_of_its_own_surface() -> None:
    floor, wall = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    below, ahead = plane(floor, 1.5), plane(wall, 4.0)
    normals = surface_normals(np.minimum(below, ahead), INFO)
    expected = np.where((below < ahead)[..., None], floor, wall)
    assert normals == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_the_smallest_images_have_normals_too(width: int, height: int) -> None:
    info = CameraInfo.from_fov(width, height, 1.0)
    normals = surface_normals(np.full((height, width), 3.0, np.float32), info)
    assert normals == pytest.approx(np.broadcast_to([0.0, 0.0, -1.0], (height, width, 3)))


def test_normals_are_coloured_by_their_axes_in_the_map() -> None:
    toward = seen(np.full((12, 16), 3.0, np.float32))
    ahead_is_north = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    colours = as_colours(ImageType.SURFACE_NORMALS, toward._replace(turn=ahead_is_north))
    assert (colours == [0, 128, 128]).all()


@pytest.mark.parametrize("form", ["rgb", "bgr", "png", "float"])
def test_an_image_can_be_unpacked(form: Form) -> None:
    colours = np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8)
    buffer = packed(ImageType.SCENE, seen(colours=colours), form)
    if form == "float":
        (reply,) = wire.Decoder().feed(b"\x94\x01\x00\xc0" + buffer.tobytes())
        assert isinstance(reply, wire.Reply)
        assert reply.result == pytest.approx(colours[..., 0].ravel() / 255.0)
        return
    if form == "png":
        image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert (image[..., 3] == 255).all()
        bgr = image[..., :3]
    else:
        bgr = buffer.reshape(12, 16, 3)
    assert np.array_equal(bgr, colours if form == "rgb" else colours[..., ::-1])
