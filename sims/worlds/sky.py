"""A sky with clouds, as the six faces of a cube around the world."""

from __future__ import annotations

from typing import Any

import cv2
import mujoco
import numpy as np

from sims.worlds.patterns import Image, fractal, mix, smooth, to_bytes

SIZE = 384


def add_sky(spec: Any, random: np.random.Generator, night: bool = False) -> None:
    """Give the world a sky: haze at the horizon, blue above, clouds that lie in one plane.

    By night all of that is hardly seen, before a few stars.
    """
    clouds = fractal((1024, 1024), random, coarse=200, fine=6, gain=0.62)
    faces = np.concatenate([_face(axes, clouds) for axes in _AXES], 0)
    if night:
        stars = random.uniform(size=faces.shape[:2]) > 0.9993
        faces = mix(faces * (0.05, 0.06, 0.09), (0.75, 0.78, 0.82), stars.astype(np.float32))
    texture = spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=SIZE, height=6 * SIZE, nchannel=3
    )
    texture.data = to_bytes(faces).tobytes()


# Each face in GL's order (+x -x +y -y +z -z, where y is up and z is our west): its middle, its
# right, its down, by OpenGL 4.6's table 8.19.
_AXES = (
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


def _face(axes: tuple[tuple[int, int, int], ...], clouds: Image) -> Image:
    middle, right, down = (np.array(axis, np.float32) for axis in axes)
    place = (np.arange(SIZE, dtype=np.float32) + 0.5) / SIZE * 2.0 - 1.0
    ray = middle + place[None, :, None] * right + place[:, None, None] * down
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    height = ray[..., 1]
    up = smooth(-0.02, 0.65, height)
    sky = mix(np.full((SIZE, SIZE, 3), (0.80, 0.84, 0.86), np.float32), (0.33, 0.52, 0.76), up)
    # Clouds lie in a plane above; the 0.12 keeps those at the horizon from shrinking to nothing.
    flat = np.maximum(height, 0.0) + 0.12
    u, v = 512.0 + 150.0 * ray[..., 0] / flat, 512.0 + 150.0 * ray[..., 2] / flat
    body = cv2.remap(clouds, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    cover = smooth(0.15, 1.1, body) * smooth(-0.02, 0.1, height)
    light = np.clip(0.93 - 0.10 * smooth(0.8, 2.4, body), 0.0, 1.0)[..., None]
    return mix(sky, np.asarray(light * (1.0, 1.0, 1.0), dtype=np.float32), cover * 0.92)
