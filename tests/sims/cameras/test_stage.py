"""What is left out of a drawing to save time changes none of its bits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from events.frames import from_rpy
from sims.cameras import add_free_camera, model_from_bytes, model_to_bytes, pose_to_qpos
from sims.cameras.opengl import OpenGL
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import Drawn, Floats, View
from sims.worlds import TOURS
from tests.sims.cameras.scenes import WIDE, scene
from tests.sims.cameras.test_raster import PINHOLE, SPECS, shaped

SIZE = (90, 160)


def glass() -> bytes:
    """Return a world with a see-through ball, a plane, a height field and a sky."""
    world = mujoco.MjSpec()
    world.worldbody.add_light(pos=[0, 0, 4], dir=[0.3, 0.1, -1])
    world.add_texture(
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.3, 0.5, 0.7],
        rgb2=[0.1, 0.1, 0.2],
        width=32,
        height=32,
    )
    world.add_hfield(name="hills", size=[3, 3, 0.5, 0.1], nrow=2, ncol=2, userdata=[0, 1, 1, 0])
    kinds = mujoco.mjtGeom
    world.worldbody.add_geom(type=kinds.mjGEOM_PLANE, size=[0, 0, 1])
    world.worldbody.add_geom(type=kinds.mjGEOM_HFIELD, hfieldname="hills", pos=[4, -3, 0])
    for k in range(8):
        at = [3 * math.cos(k), 3 * math.sin(k), 0.8]
        world.worldbody.add_geom(
            type=kinds.mjGEOM_SPHERE, size=[0.7, 0, 0], pos=at, rgba=[1, 0, 0, 0.1 + 0.3 * (k % 4)]
        )
    add_free_camera(world, "free", (WIDE,))
    return model_to_bytes(world.compile())


def views(name: str) -> Iterator[tuple[OpenGL, int, Floats]]:
    """Return a stage, its camera, and states along the world's tour."""
    model = model_from_bytes(glass() if name == "glass" else scene(name).packed)
    stage = OpenGL(model, (camera_info(WIDE),), 1)
    stage.enter()
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "free/wide")
    for k, place in enumerate(TOURS.get(name, ((0.0, 0.0, -0.6), (-1.0, 1.0, -2.0)) * 4)):
        yield stage, camera, pose_to_qpos(place, from_rpy(0.3, 0.4 * math.cos(k), 0.9 * k))
    stage.close()


WORLDS = ["glass", "hall", pytest.param("yard", marks=pytest.mark.slow)]


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_depth_alone_is_that_beside_colours(world: str) -> None:
    """It is drawn without textures, lights and sky, and stays the same to the bit."""
    for stage, camera, qpos in views(world):
        stage.look(camera, qpos)
        _, beside = stage.colour_and_depth(SIZE, colour=True, depth=True)
        _, alone = stage.colour_and_depth(SIZE, colour=False, depth=True)
        assert beside is not None
        assert alone is not None
        assert np.isfinite(alone).any()
        np.testing.assert_array_equal(alone, beside)


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("aimed", [False, True])
def test_what_is_out_of_view_is_not_missed(
    world: str, aimed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colours, depth and numbers are those of a drawing of everything, with any frame."""
    left_out = 0
    for stage, camera, qpos in views(world):
        stage.look(camera, qpos)
        if aimed:
            turn = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
            stage.aim(turn, -0.3, 1.1, -0.9, 0.2)
        images = *stage.colour_and_depth(SIZE, True, True), stage.segmentation(SIZE)
        left_out += int((~stage._in_view(SIZE)).sum())
        with monkeypatch.context() as all_of_it:
            all_of_it.setattr(
                stage, "_in_view", lambda _, stage=stage: stage.model.geom_rbound > -1
            )
            whole = *stage.colour_and_depth(SIZE, True, True), stage.segmentation(SIZE)
        for a, b in zip(images, whole, strict=True):
            np.testing.assert_array_equal(a, b)
    assert left_out > 0


CHANGING = """
<light type="directional" dir="1 -.3 -1" diffuse=".8 .6 .4" specular="0 0 0"/>
<light type="spot" pos="-1 1 3" dir=".3 -.3 -1" castshadow="false" specular="0 0 0"/>
<geom type="plane" size="4 4 .1" pos="0 0 -1"/>
<body><joint axis=".2 .3 1"/><geom type="box" size=".6 .5 .4" mass="1"/></body>
<geom type="sphere" size=".3" pos="-.8 .6 .2" rgba=".2 .4 .9 .5"/>
"""


class Changes:
    """A lamp that dims, a ball that becomes see-through and a box that changes its colour."""

    fog = False

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        model.light_diffuse[1] = 0.5 + 0.4 * math.sin(seconds)
        box, ball = model.geom_rgba[-2:]
        box[0], ball[3] = 0.5 + 0.4 * math.cos(seconds), min(1.0, 0.6 + 0.5 * math.sin(seconds))


SHOTS = st.tuples(
    st.sampled_from((0.0, 0.3, 1.5, -2.0)),  # the box's angle, radians
    st.sampled_from((0.0, 1.0, 2.5)),  # seconds
    st.sampled_from(SPECS),
    st.booleans(),  # by a rolling shutter
    st.sampled_from(((True, True, True), (True, False, False), (False, True, False))),
)


@settings(max_examples=20, deadline=None)
@given(shots=st.lists(SHOTS, min_size=2, max_size=5))
@example(shots=[(angle, 0.0, PINHOLE, False, (True, True, True)) for angle in (0.0, 1.5)])
def test_an_image_does_not_depend_on_those_drawn_before(shots: list[Any]) -> None:
    """The light of what moves is that of where it is now, too."""
    model = shaped(CHANGING)

    def seen(stage: Raster, shot: Any) -> Drawn:
        angle, seconds, lens, rolling, wanted = shot
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{lens.name}")
        qpos = np.array([angle, *pose_to_qpos((-2.2, 0.3, -0.2), from_rpy(0.0, 0.0, 0.0))])
        for late in (-0.2, 0.2) if rolling else ():
            stage.keep(camera, qpos + np.eye(len(qpos))[0] * late, seconds + late)
        stage.look(camera, qpos, seconds)
        return stage.draw(View(camera_info(lens)), *wanted)

    raster, other = Raster(model, Changes()), Raster(model, Changes())
    *_, last = (seen(raster, shot) for shot in shots)
    for image, alone in zip(last, seen(other, shots[-1]), strict=True):
        assert (image is None) == (alone is None)
        if image is not None and alone is not None:
            np.testing.assert_array_equal(image, alone)
    raster.close()
    other.close()
