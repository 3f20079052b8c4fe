"""Lights of users' models throw the shadows that these ask for, as rays of MuJoCo find them."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from sims.cameras import CameraSpec
from sims.cameras.optics import pixel_rays
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import View
from tests.sims.cameras.test_raster import PINHOLE, SPECS, compiled, drawn

SHADED = """
<mujoco>
  <statistic extent="8"/>
  <visual>
    <headlight ambient=".2 .2 .2" diffuse="0 0 0" specular="0 0 0"/>
    <quality shadowsize="{size}"/>
  </visual>
  <worldbody>
    <light type="{kind}" pos="1 1 4" dir="-.3 -.25 -1" diffuse=".8 .8 .8" specular="0 0 0"
      cutoff="50" exponent="0" attenuation="1 0 0" castshadow="{casts}"/>
    <geom type="plane" size="4 4 .1" rgba="1 1 1 1"/>
    <geom type="box" size=".3 .3 .5" pos="0 0 .5" rgba="1 1 1 1"/>
    <geom type="sphere" size=".4" pos="1 -.8 .8" rgba="1 1 1 1"/>
    <geom type="cylinder" size=".1 1" pos="-.8 .8 1" rgba="1 1 1 1"/>
  </worldbody>
</mujoco>
"""


def shadowed(spec: CameraSpec, kind: str, casts: bool = True, size: int = 4096) -> tuple[Any, Any]:
    """Return a stage and its images of shadows, from above and aside."""
    text = SHADED.format(kind=kind, casts=str(casts).lower(), size=size)
    raster = Raster(compiled(mujoco.MjSpec.from_string(text)))
    return raster, drawn(raster, spec, (-2.6, 0.4, -2.5), from_rpy(0.1, -0.8, -0.1))


@pytest.mark.slow
@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("kind", ["spot", "directional"])
def test_shadows_lie_where_the_light_does_not_arrive(kind: str, spec: CameraSpec) -> None:
    """On the floor and on the bodies, which throw none on the sides that face the light."""
    raster, (image, depth, _) = shadowed(spec, kind)
    data = raster._data
    camera = mujoco.mj_name2id(raster.model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{spec.name}")
    axes = data.cam_xmat[camera].reshape(3, 3) * (1.0, -1.0, -1.0)  # right, down, ahead
    rays = pixel_rays(camera_info(spec)).reshape(-1, 3)
    towards = -np.array([-0.3, -0.25, -1.0]) / np.linalg.norm([0.3, 0.25, 1.0])
    body, wrong, dark, count = np.zeros(1, np.int32), 0, 0, 0
    for pixel in range(0, len(rays), 7):
        distance = depth.ravel()[pixel]
        if not np.isfinite(distance):
            continue
        ray = rays[pixel] / rays[pixel][2] * distance
        point = data.cam_xpos[camera] + axes @ ray
        way = towards if kind == "directional" else np.array([1.0, 1.0, 4.0]) - point
        way = way / np.linalg.norm(way)
        if kind == "spot" and way @ towards < math.cos(math.radians(45.0)):
            continue  # near the end of its cone, and beyond
        normal = np.zeros(3)
        way_in, before = axes @ ray, point - 1e-3 * axes @ ray
        mujoco.mj_ray(raster.model, data, before, way_in, None, 1, -1, body, normal)
        facing = normal @ way
        if 0.0 < facing < 0.2:
            continue  # hardly lit, or not
        hit = mujoco.mj_ray(raster.model, data, point + 2e-3 * normal, way, None, 1, -1, body)
        reached = facing > 0.0 and hit < 0.0
        light = 0.2 + 0.8 * max(facing, 0.0)
        wrong += (image.reshape(-1, 3)[pixel, 0] / 255.0 > 0.5 * (0.2 + light)) != reached
        dark += not reached
        count += 1
    assert count > 1000
    assert dark > 0.05 * count
    assert wrong < 0.02 * count  # pixels on a shadow's edge
    raster.close()


def test_shadows_are_those_that_the_model_asks_for() -> None:
    seen = shadowed(PINHOLE, "spot")[1].colours
    none = shadowed(PINHOLE, "spot", casts=False)[1].colours
    np.testing.assert_array_equal(none, shadowed(PINHOLE, "spot", size=0)[1].colours)
    assert (seen.astype(int) <= none.astype(int) + 1).all()  # two ways to round
    assert (seen < 0.5 * none).any()


def test_shadows_move_with_what_throws_them_and_stay_while_rows_roll() -> None:
    raster, first = shadowed(PINHOLE, "directional")
    camera = mujoco.mj_name2id(raster.model, mujoco.mjtObj.mjOBJ_CAMERA, "free/pinhole")
    for _ in range(3):
        raster.keep(camera, raster._data.qpos.copy(), 0.0)
    again = raster.draw(View(camera_info(PINHOLE)), True, True, True)
    np.testing.assert_array_equal(first.colours, again.colours)
    raster.model.geom_pos[1, 0] += 0.5
    moved = drawn(raster, PINHOLE, (-2.6, 0.4, -2.5), from_rpy(0.1, -0.8, -0.1))
    anew = Raster(raster.model)
    np.testing.assert_array_equal(
        moved.colours,
        drawn(anew, PINHOLE, (-2.6, 0.4, -2.5), from_rpy(0.1, -0.8, -0.1)).colours,
    )
    assert (moved.colours != first.colours).any()
    raster.close()
    anew.close()
