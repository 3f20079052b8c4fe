"""Where the announced geometry says a point falls, the image shows it."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from events import CameraInfo
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    add_free_camera,
    announcement,
    model_to_bytes,
    pose_to_qpos,
)

Array = npt.NDArray[np.float64]
POSITION = (0.4, -0.3, -1.2)
ORIENTATION = (0.9, 0.15, -0.2, 0.35)
RADIUS = 28.0
"""Of a ball in the image, pixels."""
CAMERAS = [
    CameraSpec(name="square", images=("segmentation", "depth")),
    CameraSpec(name="vga", images=("segmentation", "depth"), width=640, height=480, fov=70.0),
    CameraSpec(
        name="tilted",
        images=("segmentation", "depth"),
        width=561,
        height=420,
        fov=100.0,
        position=(0.1, -0.2, 0.05),
        orientation=(10.0, -25.0, 40.0),
    ),
]


def rotation(quaternion: tuple[float, ...]) -> Array:
    """Rotation matrix of a quaternion w, x, y, z, written out apart from the code's own."""
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def balls(info: CameraInfo) -> tuple[Array, Array]:
    """Centres in the optical frame (n, 3) and radii (n,), metres; apart from each other."""
    random = np.random.default_rng(1)
    columns, rows = np.meshgrid(
        np.linspace(55, info.width - 56, 5), np.linspace(50, info.height - 51, 4)
    )
    columns = columns.ravel() + random.uniform(-8, 8, 20)
    rows = rows.ravel() + random.uniform(-8, 8, 20)
    depth = random.uniform(1.5, 6.0, 20)
    centres = np.stack(
        [(columns - info.cx) / info.fx * depth, (rows - info.cy) / info.fy * depth, depth], 1
    )
    return centres, RADIUS / info.fx * depth


def outline_centre(centre: Array, radius: float, info: CameraInfo) -> Array:
    """Column and row of the middle of a ball's outline, an ellipse.

    The outline's dual conic is K (r² I - c cᵀ) Kᵀ (Hartley and Zisserman, eq. 8.5).
    """
    k = info.matrix()
    conic = k @ (radius**2 * np.eye(3) - np.outer(centre, centre)) @ k.T
    return np.array([conic[0, 2] / conic[2, 2], conic[1, 2] / conic[2, 2]])


def residuals(spec: CameraSpec, info: CameraInfo) -> Array:
    """Seen minus expected, pixels, shape (n, 2); also checks each ball's depth."""
    said = announcement(spec, source="c", prefix="", parent_frame_id="body")
    centres, radii = balls(said.info)
    in_body = centres @ rotation(said.orientation).T + said.position
    in_map = in_body @ rotation(ORIENTATION).T + POSITION
    world = mujoco.MjSpec()
    world.visual.quality.numslices = 160
    world.visual.quality.numstacks = 160
    for number, ((x, y, z), radius) in enumerate(zip(in_map, radii, strict=True)):
        world.worldbody.add_geom(
            name=f"ball_{number}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[x, -y, -z],
            size=[radius, 0, 0],
        )
    prefix = add_free_camera(world, "body", (spec,))
    renderer = CameraRenderer(model_to_bytes(world.compile()), (spec,), prefix, seed=0)
    frame = renderer.render(0, pose_to_qpos(POSITION, ORIENTATION), (spec.name,))[spec.name]
    renderer.close()
    assert frame.segmentation is not None
    assert frame.depth is not None
    np.testing.assert_allclose(
        rotation(frame.orientation), rotation(ORIENTATION) @ rotation(said.orientation), atol=1e-9
    )
    np.testing.assert_allclose(
        frame.position, rotation(ORIENTATION) @ said.position + POSITION, atol=1e-9
    )
    found = []
    for number, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        rows, columns = np.nonzero(frame.segmentation == number)
        assert len(rows) > 900, f"ball {number} is hidden"
        found.append([columns.mean(), rows.mean()] - outline_centre(centre, radius, info))
        nearest = float(frame.depth[frame.segmentation == number].min())
        assert centre[2] - radius - 0.002 < nearest < centre[2] - 0.5 * radius
    return np.array(found)


@pytest.mark.parametrize("spec", CAMERAS, ids=lambda spec: spec.name)
def test_known_points_fall_on_their_pixels(spec: CameraSpec) -> None:
    """Balls at known places appear where announced intrinsics and mounting put them."""
    error = residuals(spec, announcement(spec, source="c", prefix="", parent_frame_id="b").info)
    length = np.linalg.norm(error, axis=1)
    assert length.max() < 0.1
    assert length.mean() < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.02


def test_a_principal_point_half_a_pixel_off_is_noticed() -> None:
    """The test above can tell (W - 1) / 2 from W / 2."""
    spec = CAMERAS[0]
    info = announcement(spec, source="c", prefix="", parent_frame_id="b").info
    off = CameraInfo(
        width=info.width, height=info.height, fx=info.fx, fy=info.fy,
        cx=info.width / 2, cy=info.height / 2,
    )  # fmt: skip
    assert np.abs(residuals(spec, off).mean(axis=0)).min() > 0.4
