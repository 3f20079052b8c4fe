"""Scenes of hostile numbers, drawn by a given build of the rasteriser (`test_hostile.py`).

``python -m tests.sims.cameras.hostile LIBRARY FIRST COUNT`` draws the scenes of seeds FIRST to
FIRST + COUNT - 1, and casts rays at hostile triangles, names each scene on stderr before, and
compares with an installed build.
"""

from __future__ import annotations

import ctypes
import functools
import math
import random
import sys
import warnings
from typing import Any

import mujoco
import numpy as np

from events import CameraInfo
from sims.cameras import raster as rasters
from sims.cameras.optics import pixel_rays
from sims.cameras.raster import Raster
from sims.cameras.stage import View
from sims.compiled import libraries
from tests.sims.triangles import meet

KINDS = ("plane", "box", "sphere", "ellipsoid", "cylinder", "capsule", "mesh", "hfield")
NUMBERS = (
    0.0, -0.0, 1e-45, 1e-30, 1e-6, 0.5, 1.0, 2.0, 100.0, 32767.5, 65536.0, 1e10, 2147483648.0,
    4294967296.0, 1e20, 1e30, 3e38, math.inf, math.nan,
)  # fmt: skip
SIDES = (1, 2, 3, 4, 7, 8, 31, 64, 65)


class Fog:
    """Dynamics of a world that stands still in fog, or without."""

    def __init__(self, fog: bool) -> None:
        self.fog = fog

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        pass


def number(pick: random.Random) -> float:
    """Return a number with which something may go wrong."""
    return pick.choice(NUMBERS) * pick.choice((1.0, 1.0, -1.0, pick.random()))


def spoil(pick: random.Random, array: Any, share: float) -> None:
    """Replace a share of an array's numbers by hostile ones."""
    flat = array.reshape(-1)
    with np.errstate(over="ignore", invalid="ignore"):
        for place in range(flat.size):
            if pick.random() < share:
                flat[place] = number(pick)


def model_of(pick: random.Random) -> Any:
    """Return a model of a few geoms, lights and textures, with hostile numbers in some of them.

    Lights have none yet: a stage refuses some of them.
    """
    world = mujoco.MjSpec()
    kinds = mujoco.mjtTexture
    quality = world.visual.quality
    quality.shadowsize = pick.choice((0, 1, 2, 3, 16, 100))
    quality.numslices, quality.numstacks = pick.choice((3, 8)), pick.choice((2, 5))
    quality.numquads = pick.choice((1, 3))
    for k in range(3):
        kind = pick.choice((kinds.mjTEXTURE_2D, kinds.mjTEXTURE_CUBE, kinds.mjTEXTURE_SKYBOX))
        width = pick.choice(SIDES)
        flat = kind == kinds.mjTEXTURE_2D
        height = pick.choice(SIDES) if flat else pick.choice((1, 6)) * width
        if flat and pick.random() < 0.1:
            width, height = pick.choice(((40000, 1), (1, 32768), (65537, 1), (3, 70001)))
        channels = pick.choice((1, 3, 4))
        texture = world.add_texture(
            name=f"t{k}", type=kind, width=width, height=height, nchannel=channels
        )
        texture.data = pick.randbytes(width * height * channels)
        material = world.add_material(name=f"m{k}", texuniform=pick.random() < 0.5)
        textures = list(material.textures)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"t{k}"
        material.textures = textures
    points = np.array([pick.uniform(-1.0, 1.0) for _ in range(24)])
    world.add_mesh(name="mesh", uservert=points.tolist())
    if pick.random() < 0.5:
        channels = pick.choice((3, 4))
        colours = world.add_texture(
            name="mesh.colours", type=kinds.mjTEXTURE_2D, width=3, height=3, nchannel=channels
        )
        colours.data = pick.randbytes(9 * channels)
    world.add_text(name="geom_user", data="double_sided alpha_cutoff")
    heights = [pick.random() for _ in range(6)]
    world.add_hfield(name="hill", size=[1, 0.7, 0.3, 0.1], nrow=2, ncol=3, userdata=heights)
    for _ in range(pick.randint(1, 6)):
        kind = pick.choice(KINDS)
        geom = world.worldbody.add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=[pick.choice((0.1, 0.5, 1.0, 30.0)) for _ in range(3)],
            pos=[pick.uniform(-2.0, 2.0) for _ in range(3)],
            euler=[pick.choice((0.0, 90.0, pick.uniform(0.0, 360.0))) for _ in range(3)],
            rgba=[pick.random(), pick.random(), pick.random(), pick.choice((1.0, 1.0, 0.4))],
            userdata=[pick.choice((0.0, 1.0)), pick.choice((0.0, 0.0, 0.5, pick.random()))],
        )
        if kind == "mesh":
            geom.meshname = "mesh"
        elif kind == "hfield":
            geom.hfieldname = "hill"
        elif kind == "plane" and pick.random() < 0.5:
            geom.size = [pick.choice((0.0, 1.0)), pick.choice((0.0, 1.0)), 1.0]
        if pick.random() < 0.7:
            geom.material = f"m{pick.randrange(3)}"
    types = mujoco.mjtLightType
    for _ in range(pick.randint(0, 3)):
        world.worldbody.add_light(
            type=pick.choice((types.mjLIGHT_SPOT, types.mjLIGHT_DIRECTIONAL, types.mjLIGHT_POINT)),
            pos=[pick.uniform(-2.0, 2.0) for _ in range(3)],
            dir=[pick.choice((0.0, pick.uniform(-1.0, 1.0))), pick.uniform(-1.0, 1.0), -1.0],
            castshadow=pick.random() < 0.7,
        )
    body = world.worldbody.add_body(pos=[pick.uniform(-3.0, 3.0) for _ in range(3)])
    body.add_camera(name="eye", quat=[pick.gauss(0.0, 1.0) for _ in range(4)])
    body.add_camera(name="later", quat=[pick.gauss(0.0, 1.0) for _ in range(4)])
    model = world.compile()
    spoiled = {
        "mat": ("emission", "specular", "shininess", "rgba", "texrepeat"),
        "geom": ("rgba", "size", "pos", "quat", "user"),
    }
    what = pick.choice((*spoiled, "mat", "places", "visual", "mesh", "none"))
    share = pick.choice((0.1, 0.5))
    for field in spoiled.get(what, ()):
        spoil(pick, getattr(model, f"{what}_{field}"), share)
    if what == "places":
        spoil(pick, model.body_pos[1:], share)
        spoil(pick, model.light_pos, share)
        spoil(pick, model.light_dir, share)
        spoil(pick, model.cam_pos, 0.1)
    elif what == "mesh":
        spoil(pick, model.mesh_vert, 0.1)
        spoil(pick, model.mesh_normal, 0.1)
        spoil(pick, model.hfield_data, share)
    elif what == "visual":
        visual, stat = model.vis, model.stat
        stat.extent = pick.choice((1e-6, 1.0, 1e10, 1e38, 1e300))
        visual.map.fogstart, visual.map.fogend = number(pick), number(pick)
        visual.map.shadowclip = number(pick)
        spoil(pick, visual.rgba.fog, 0.7)
        spoil(pick, visual.headlight.ambient, share)
        spoil(pick, visual.headlight.diffuse, share)
        visual.headlight.active = pick.randrange(2)
    return model


def lens_of(seed: int) -> CameraInfo:
    """Return a camera of few pixels with any lens."""
    pick = random.Random(seed)
    width, height = pick.choice((1, 2, 7, 40, 64)), pick.choice((1, 2, 9, 33, 48))
    focal = pick.choice((1e-6, 0.3, 20.0, 60.0, 1e6, 1e40))
    model: Any = pick.choice(("plumb_bob", "plumb_bob", "equidistant", "rational_polynomial"))
    bend = [pick.choice((0.0, pick.uniform(-0.2, 0.2))) for _ in range(8)]
    if model != "plumb_bob":
        focal = pick.choice((5.0, 20.0, 60.0))
    return CameraInfo(
        width=width,
        height=height,
        fx=focal,
        fy=focal * pick.choice((0.3, 1.0)),
        cx=pick.choice((0.5 * width, -1e4, 3.0)),
        cy=pick.choice((0.5 * height, 1e4, 2.0)),
        distortion_model=model,
        distortion=tuple(bend[: {"plumb_bob": 5, "equidistant": 4}.get(model, 8)])
        if model != "plumb_bob" or pick.random() < 0.3
        else (0.0,) * 5,
    )


def images_of(seed: int, instructions: str) -> list[bytes]:
    """Return the images of the scene of a seed as the library of a name draws them."""
    pick = random.Random(seed)
    model = model_of(pick)
    stage = Raster(model, Fog(pick.random() < 0.4), pick.choice((1, 3)), instructions)
    if pick.random() < 0.4:
        for field in ("attenuation", "cutoff", "exponent", "diffuse", "ambient", "specular"):
            spoil(pick, getattr(model, f"light_{field}"), 0.3)
    images = []
    for _ in range(4):
        info, qpos = lens_of(pick.randrange(60)), np.zeros(0)
        cameras = [pick.randrange(2) for _ in range(pick.choice((0, 0, 2, 3, 5, 60)))]
        for camera in cameras:
            stage.keep(camera, qpos, 0.0)
        stage.look(pick.randrange(2), qpos, 0.0, pick.choice((1.0, 1.0, 1e30)))
        colour, depth, numbers = (pick.random() < 0.8 for _ in range(3))
        drawn = stage.draw(View(info), colour, depth, numbers)
        images += [image.tobytes() for image in drawn if image is not None]
    stage.close()
    return images


def hits_of(seed: int, library: Any) -> bytes:
    """Return what rays of hostile numbers meet of such triangles, at such poses."""
    pick = random.Random(seed)
    count = pick.choice((0, 1, 3, 40, 400))
    numbers = np.random.default_rng(seed)
    points = numbers.uniform(-2.0, 2.0, (3 * count + 3, 3)).astype(np.float32)
    corners = numbers.integers(0, len(points), (count, 3), np.int32)
    positions, turns = numbers.uniform(-3.0, 3.0, (4, 3)), np.tile(np.eye(3), (4, 1, 1))
    origin, directions = numbers.uniform(-3.0, 3.0, 3), numbers.standard_normal((60, 3))
    for array, share in ((points, 0.05), (positions, 0.1), (turns, 0.02), (directions, 0.2)):
        spoil(pick, array, pick.choice((0.0, share)))
    spoil(pick, origin, pick.choice((0.0, 0.0, 0.2)))
    met = meet(
        library, points, corners, origin, directions, positions, turns, moves=pick.randrange(5)
    )
    return b"".join(part.tobytes() for part in met)


def main(path: str, first: int, count: int) -> int:
    """Draw the scenes; return 1 if an image differs from that of an installed build."""
    builds = libraries()
    installed = list(builds)
    checked = ctypes.CDLL(path)
    checked.raster_new.restype = checked.rays_new.restype = ctypes.c_void_p
    builds["checked"] = checked
    vars(rasters)["pixel_rays"] = functools.cache(pixel_rays)
    warnings.simplefilter("error")
    same = True
    for seed in range(first, first + count):
        print(f"scene {seed}", file=sys.stderr, flush=True)
        name = installed[seed % len(installed)]
        if images_of(seed, name) != images_of(seed, "checked"):
            print(f"scene {seed}: {name} draws other bytes", file=sys.stderr)
            same = False
        if hits_of(seed, builds[name]) != hits_of(seed, checked):
            print(f"scene {seed}: {name} meets others", file=sys.stderr)
            same = False
    return int(not same)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
