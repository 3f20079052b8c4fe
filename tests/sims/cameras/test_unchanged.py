"""Cameras give the images that they gave before, to the byte, on every machine.

`unchanged.npz` holds them. Where a change of the drawing is wanted,
``python -m tests.sims.cameras.test_unchanged`` writes it anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from events.frames import from_rpy
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.spec import ImageKind
from tests.sims.cameras.scenes import frames_of

SAVED = Path(__file__).with_name("unchanged.npz")
KINDS: tuple[ImageKind, ...] = ("rgb", "grey", "depth", "segmentation")
CAMERAS = (
    CameraSpec(name="plain", images=KINDS, width=80, height=61, position=(0.0, 0.0, 0.0)),
    CameraSpec(name="one", images=KINDS, width=1, height=1),
    CameraSpec(
        name="spoilt", width=64, height=48, noise=3.0, depth_noise=0.002, blur=1.2, light=0.6
    ),
    CameraSpec(name="wide", images=("grey", "depth"), width=96, height=40, fov=150.0),
)
BALL, BOX, PLANE = (
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_PLANE,
)


def drawn() -> dict[str, npt.NDArray[Any]]:
    """Return the images of all cameras, moving, in a world of a floor, boxes and a ball."""
    world = mujoco.MjSpec()
    world.worldbody.add_light(pos=[0, 0, 4], dir=[0.3, 0.1, -1])
    world.worldbody.add_geom(type=PLANE, size=[20, 20, 1], rgba=[0.4, 0.5, 0.4, 1])
    world.worldbody.add_geom(type=BALL, size=[0.5, 0, 0], pos=[3, 0.7, 1], rgba=[0.9, 0.3, 0.2, 1])
    for k in range(-4, 5):
        world.worldbody.add_geom(
            type=BOX, size=[0.1, 0.2, 1.5], pos=[4, 0.8 * k, 1.5], rgba=[0.2, 0.4, 0.1 * (k + 4), 1]
        )
    prefix = add_free_camera(world, "free", CAMERAS)
    renderer = CameraRenderer(model_to_bytes(world.compile()), CAMERAS, prefix, seed=5)
    qpos = pose_to_qpos((0.1, 0.2, -1.2), from_rpy(0.1, -0.05, 0.2))
    qvel = np.array([1.0, 0.4, 0.2, 0.3, -0.2, 1.0])
    frames = frames_of(renderer, 123_456_789, qpos, tuple(spec.name for spec in CAMERAS), qvel)
    renderer.close()
    return {
        f"{name}_{kind}": image
        for name, frame in frames.items()
        for kind in KINDS
        if (image := getattr(frame, kind)) is not None
    }


def test_images_are_those_of_before() -> None:
    """Of every kind, with noise, blur and light, at odd sizes; none more and none less."""
    images = drawn()
    with np.load(SAVED) as saved:
        assert set(images) == set(saved)
        for name, image in images.items():
            np.testing.assert_array_equal(image, saved[name], err_msg=name)


if __name__ == "__main__":
    np.savez_compressed(SAVED, **drawn())  # type: ignore[arg-type]
