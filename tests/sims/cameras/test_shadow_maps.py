"""A shadow map of parts, drawn at other times, is that of all geoms drawn together, to the bit."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from sims.cameras import CameraSpec, add_free_camera, pose_to_qpos
from sims.cameras.optics import Lens
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import View
from sims.compiled import libraries

FISHEYE = Lens(model="equidistant", coefficients=(0.01, 0.0, 0.0, 0.0))
CAMERAS = tuple(
    CameraSpec(name=name, width=64, height=48, fov=fov, position=(0.0, 0.0, 0.0), lens=lens)
    for name, fov, lens in (("pinhole", 90.0, None), ("fisheye", 150.0, FISHEYE))
)
VIEWS = {camera.name: View(camera_info(camera)) for camera in CAMERAS}
SHAPES = ("box", "sphere", "cylinder", "capsule", "ellipsoid")
FAR = (300.0, 1.0, 1.0)  # a place that no light's map shows


def scene(pick: Any, size: int, reach: float = 0.6) -> Any:
    """Return a model of bodies about a floor, under a sun, two spots, and a spot on a body."""
    spec = mujoco.MjSpec.from_string(f"""
<mujoco>
  <statistic extent="4"/>
  <visual><quality shadowsize="{size}" numslices="8" numstacks="6"/></visual>
  <worldbody>
    <light type="directional" pos="0 0 5" dir="-.3 -.2 -1"/>
    <light pos="1 1 4" dir="-.3 -.25 -1" cutoff="35"/>
    <light name="low" pos="0 0 .3" dir="1 .2 .1" cutoff="75"/>
    <geom type="plane" size="4 4 .1"/>
  </worldbody>
</mujoco>""")
    for number in range(7):
        body = spec.worldbody.add_body(name=f"body{number}")
        if number < 5:  # the others stand still until the model is changed
            body.add_freejoint()
        body.pos = pick.uniform((-2, -2, 0), (2, 2, 2))
        for _ in range(2):
            body.add_geom(
                type=getattr(mujoco.mjtGeom, f"mjGEOM_{pick.choice(SHAPES).upper()}"),
                size=pick.uniform(0.02, reach, 3),
                pos=pick.uniform(-0.3, 0.3, 3),
                quat=pick.normal(size=4),
                mass=1.0,
            )
        if number == 0:
            light = body.add_light(cutoff=40.0, dir=(0.3, 0.0, -1.0), pos=(0.0, 0.0, 1.0))
            light.mode = mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY
            light.targetbody = "body1"
    add_free_camera(spec, "free", CAMERAS)
    return spec.compile()


def maps(raster: Any) -> list[Any]:
    """Return a stage's shadow maps, shape (size, size) each."""
    shadows = raster._shadows
    size = shadows._size
    return [shadow.depth[: size * size].reshape(size, size) for shadow in shadows._maps]


def draw(raster: Any, qpos: Any, name: str = "pinhole") -> Any:
    """Return an image from above."""
    seen = qpos.copy()
    seen[-7:] = pose_to_qpos((-2.5, 0.0, -3.0), from_rpy(0.0, -0.8, 0.0))
    raster.look(raster.model.camera(f"free/{name}").id, seen)
    return raster.draw(VIEWS[name], True, False, False).colours


def together(raster: Any, qpos: Any, name: str) -> Any:
    """Draw all maps anew, of all geoms together, and an image by them."""
    for shadow in raster._shadows._maps:
        shadow.view = b""
    return draw(raster, qpos, name)


SETS = list(itertools.product(libraries(), ((1, 50), (3, 128))))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("instructions", "threads_and_size"), SETS)
def test_maps_of_parts_are_those_of_all(
    instructions: str,
    threads_and_size: tuple[int, int],
    seed: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Geoms move, rest, vanish, come back and turn see-through; lights move, too."""
    monkeypatch.setattr("sims.cameras.shadows.PAUSE", 2)
    pick, (threads, size) = np.random.default_rng(seed), threads_and_size
    model = scene(pick, size, 0.03 if seed == 1 else 0.6)
    parts, whole = (Raster(model, None, threads, instructions) for _ in range(2))
    qpos, redrawn = model.qpos0.copy(), 0
    for _ in range(16):
        before = parts._shadows.still_version
        for body in np.flatnonzero(pick.random(5) < pick.choice((0.1, 0.5))):
            place = pick.uniform((-3, -3, 0), (3, 3, 3)) if pick.random() < 0.8 else FAR
            qpos[7 * body : 7 * body + 7] = *place, *pick.normal(size=4)
        if pick.random() < 0.3:
            model.geom_rgba[pick.integers(model.ngeom), 3] = pick.choice((0.0, 0.5, 1.0))
        if pick.random() < 0.2:
            model.body_pos[-2] = pick.uniform((-2, -2, 0), (2, 2, 2))  # of body 6
        if pick.random() < 0.2:
            model.light("low").pos[:] = pick.uniform((-1, -1, 0.1), (1, 1, 2))
        name = str(pick.choice(list(VIEWS)))
        images = draw(parts, qpos, name), together(whole, qpos, name)
        for one, other in zip(maps(parts), maps(whole), strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(*images)
        # Now that nothing moves, light on all vertices is kept, and not computed where it is seen.
        np.testing.assert_array_equal(images[0], draw(parts, qpos, name))
        redrawn += parts._shadows.still_version > before
    assert 0 < redrawn < 16
    parts.close()
    whole.close()


def test_what_does_not_change_is_not_drawn() -> None:
    """Neither a map that shows all as it is, nor a pixel that no moving geom covers."""
    model = scene(np.random.default_rng(0), 128)
    raster, qpos = Raster(model), model.qpos0.copy()
    for height in (1.0, 1.1, 1.2):  # drawn whole, then what stands still, then what moves
        qpos[2] = height
        draw(raster, qpos)
    for shadow in raster._shadows._maps:
        shadow.depth[:] = 7.0
    draw(raster, qpos)
    assert all((shown == 7.0).all() for shown in maps(raster)[:3])
    qpos[2] = 1.3
    draw(raster, qpos)
    for shadow, shown in list(zip(raster._shadows._maps, maps(raster), strict=True))[:3]:
        left, right, top, bottom = np.moveaxis(shadow.covered, -1, 0)
        assert 0.2 < (shown == 7.0).mean() < 1.0
        assert ((right - left) * (bottom - top) > 0).sum() <= 2
    qpos[:3] = FAR
    draw(raster, qpos)
    assert not any(shadow.covered.any() for shadow in raster._shadows._maps[:3])
    raster.close()
