"""What is left out of a drawing to save time changes none of its bits."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from sims.cameras import add_free_camera, model_from_bytes, model_to_bytes, pose_to_qpos
from sims.cameras.opengl import OpenGL
from sims.cameras.spec import camera_info
from sims.cameras.stage import Floats
from sims.worlds import TOURS
from tests.sims.cameras.scenes import WIDE, scene

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
        found = *stage.colour_and_depth(SIZE, True, True), stage.segmentation(SIZE)
        left_out += int((~stage._in_view(SIZE)).sum())
        with monkeypatch.context() as all_of_it:
            all_of_it.setattr(
                stage, "_in_view", lambda _, stage=stage: stage.model.geom_rbound > -1
            )
            whole = *stage.colour_and_depth(SIZE, True, True), stage.segmentation(SIZE)
        for a, b in zip(found, whole, strict=True):
            np.testing.assert_array_equal(a, b)
    assert left_out > 0
