"""The built-in worlds with a free camera in them, each built once for all tests."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import mujoco

from sims.cameras import CameraRenderer, CameraSpec, Frame, add_free_camera, model_to_bytes
from sims.cameras.renderer import Shot
from sims.cameras.stage import RendererName
from sims.worlds import load_world

ALL = CameraSpec(
    name="all",
    images=("rgb", "grey", "depth", "segmentation"),
    width=320,
    height=240,
    position=(0.0, 0.0, 0.0),
)
WIDE = CameraSpec(name="wide", position=(0.0, 0.0, 0.0))
NOISY = CameraSpec(
    name="noisy",
    images=("rgb", "depth"),
    width=160,
    height=120,
    position=(0.0, 0.0, 0.0),
    noise=4.0,
    depth_noise=0.002,
)
CAMERAS = (ALL, WIDE, NOISY)


draws: RendererName = "raster"
"""What draws in tests; the fixture of this name gives each in turn."""


def renderer_of(
    packed: bytes, cameras: tuple[CameraSpec, ...], prefix: str, seed: int = 0
) -> CameraRenderer:
    """Return a renderer of cameras of a model."""
    return CameraRenderer(packed, cameras, prefix, seed=seed, renderer=draws)


class Scene(NamedTuple):
    model: Any
    data: Any
    prefix: str
    packed: bytes


@cache
def _built(name: str) -> Any:
    return load_world(name)


def fresh(name: str) -> Any:
    """Return a world to change at will; drawing its textures, which takes long, is done once."""
    return _built(name).copy()


@cache
def scene(name: str) -> Scene:
    """Return a world by its name, with the cameras above on a free body."""
    world = fresh(name)
    prefix = add_free_camera(world, "free", CAMERAS)
    model = world.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return Scene(model, data, prefix, model_to_bytes(model))


def frames_of(
    renderer: CameraRenderer, stamp: int, qpos: Any, names: tuple[str, ...], qvel: Any = None
) -> dict[str, Frame]:
    """Expose some cameras at a single state."""
    shots = []
    for name in names:
        spec, _ = renderer._cameras[name]
        exposure = float(spec.reference_exposure if spec.auto_exposure else spec.exposure)
        shots.append(Shot(name, stamp, qpos, qvel, exposure=exposure, gain=spec.gain))
    return dict(zip(names, renderer.expose(tuple(shots)), strict=True))
