"""The server's renderer draws what the run's own cameras see, to the byte."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sims.airsim.server.cameras import camera_of_file
from sims.airsim.server.image_types import Form, ImageType
from sims.airsim.server.rendering import Renderer, Wanted
from sims.cameras import CameraRenderer, CameraSpec, add_camera, model_to_bytes
from sims.cameras.lens import Lens
from sims.vehicle import attach_vehicle

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
    return Renderer(model_to_bytes(model), "spare", (80, 72))


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
        frame = own.render(5, qpos, (spec.name,))[spec.name]
        ids = np.arange(model.ngeom + 1, dtype=np.uint8)
        colour, depth, numbers, _ = renderer.take(5, qpos, ids, wanted(model, spec, *forms))
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
    depth, ideal, plain = renderer.take(0, model.qpos0, ids, pair)
    assert ideal.size == plain.size
    planes = np.diff(1.0 / depths(depth, LENS)[-6:], 2)  # of the floor, without distortion
    assert np.abs(planes).max() < 1e-5
    assert np.array_equal(ideal, renderer.take(0, model.qpos0, ids, [pair[1]])[0])


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_what_is_drawn_together_is_what_is_drawn_alone(
    model: Any, renderer: Renderer, data: st.DataObject
) -> None:
    kinds = st.sampled_from(ImageType)
    formats: st.SearchStrategy[Form] = st.sampled_from(["float", "rgb", "bgr", "png"])
    specs = st.sampled_from(CAMERAS)
    chosen = data.draw(st.lists(st.tuples(specs, kinds, formats), max_size=6))
    images = [each for spec, *what in chosen for each in wanted(model, spec, (what[0], what[1]))]
    ids = np.arange(model.ngeom + 1, dtype=np.uint8)
    together = renderer.take(0, model.qpos0, ids, images)
    assert len(together) == len(images)
    for image, each in zip(together, images, strict=True):
        pixels = each.eye.spec.width * each.eye.spec.height
        if each.form != "png":
            assert image.size == (5 * pixels + 5 if each.form == "float" else 3 * pixels)
        (alone,) = renderer.take(0, model.qpos0, ids, [each])
        assert np.array_equal(image, alone)
