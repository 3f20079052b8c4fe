"""Where the announced geometry says a point falls, the image shows it.

Defocus and shutter as functions of images.

Depth and object numbers agree with rays cast by the physics engine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import cv2
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from events import CameraInfo
from events.frames import from_rpy, rotate
from sims.cameras import (
    CameraRenderer,
    CameraSpec,
    Frame,
    add_free_camera,
    announcement,
    camera_info,
    model_to_bytes,
    pose_to_qpos,
)
from sims.cameras.development import Passes
from sims.cameras.optics import MOST, defocused, moments
from sims.worlds import TOURS
from tests.sims.cameras.scenes import ALL, CAMERAS, Scene, frames_of, renderer_of, scene

pytestmark = pytest.mark.usefixtures("draws")

Array = npt.NDArray[np.float64]
POSITION = (0.4, -0.3, -1.2)
ORIENTATION = (0.9, 0.15, -0.2, 0.35)
RADIUS = 28.0
"""Of a ball in the image, pixels."""
LENSLESS = [
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
    world.visual.quality.numslices = 80
    world.visual.quality.numstacks = 80
    for number, ((x, y, z), radius) in enumerate(zip(in_map, radii, strict=True)):
        world.worldbody.add_geom(
            name=f"ball_{number}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[x, -y, -z],
            size=[radius, 0, 0],
        )
    prefix = add_free_camera(world, "body", (spec,))
    renderer = renderer_of(model_to_bytes(world.compile()), (spec,), prefix, seed=0)
    frame = frames_of(renderer, 0, pose_to_qpos(POSITION, ORIENTATION), (spec.name,))[spec.name]
    renderer.close()
    assert frame.segmentation is not None
    assert frame.depth is not None
    np.testing.assert_allclose(
        rotation(frame.orientation), rotation(ORIENTATION) @ rotation(said.orientation), atol=1e-9
    )
    np.testing.assert_allclose(
        frame.position, rotation(ORIENTATION) @ said.position + POSITION, atol=1e-9
    )
    errors = []
    for number, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
        rows, columns = np.nonzero(frame.segmentation == number)
        assert len(rows) > 900, f"ball {number} is hidden"
        errors.append([columns.mean(), rows.mean()] - outline_centre(centre, radius, info))
        nearest = float(frame.depth[frame.segmentation == number].min())
        assert centre[2] - radius - 0.002 < nearest < centre[2] - 0.5 * radius
    return np.array(errors)


@pytest.mark.slow
@pytest.mark.parametrize("spec", LENSLESS, ids=lambda spec: spec.name)
def test_known_points_fall_on_their_pixels(spec: CameraSpec) -> None:
    """Balls at known places appear where announced intrinsics and mounting put them."""
    error = residuals(spec, announcement(spec, source="c", prefix="", parent_frame_id="b").info)
    length = np.linalg.norm(error, axis=1)
    assert length.max() < 0.1
    assert length.mean() < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.02


def test_a_principal_point_half_a_pixel_off_is_noticed() -> None:
    """The test above can tell (W - 1) / 2 from W / 2."""
    spec = LENSLESS[0]
    info = announcement(spec, source="c", prefix="", parent_frame_id="b").info
    off = CameraInfo(
        width=info.width, height=info.height, fx=info.fx, fy=info.fy,
        cx=info.width / 2, cy=info.height / 2,
    )  # fmt: skip
    assert np.abs(residuals(spec, off).mean(axis=0)).min() > 0.4


@pytest.mark.parametrize("sigma", [0.7, 1.5, 4.0])
def test_a_point_out_of_focus_is_a_gaussian(sigma: float) -> None:
    """Of the spread that is asked for, about where the point was."""
    point = np.zeros((61, 61), np.uint16)
    point[28:33, 28:33] = 65535  # five pixels wide, so that rounding doesn't eat the flanks
    blurred = defocused(point, sigma).astype(np.float64)
    weight = blurred.sum(0) / blurred.sum()
    place = np.arange(61)
    assert weight @ place == pytest.approx(30.0, abs=1e-6)
    variance = weight @ (place - 30.0) ** 2
    assert variance == pytest.approx(sigma**2 + (5**2 - 1) / 12, rel=0.05)


def test_no_blur_costs_nothing() -> None:
    image = np.zeros((4, 4), np.uint16)
    assert defocused(image, 0.0) is image


@pytest.mark.parametrize(
    ("shift", "count"), [(0.0, 1), (1.0, 1), (1.1, 3), (3.0, 3), (3.1, 5), (9.0, 9), (1e9, MOST)]
)
def test_moments_are_a_pixel_apart_at_most(shift: float, count: int) -> None:
    """As many as the motion needs, odd in number, up to a limit; centred on the exposure."""
    times = moments(0.02, shift)
    assert len(times) == count
    assert times[count // 2] == 0.0
    np.testing.assert_allclose(times, -np.array(times[::-1]), atol=1e-15)
    np.testing.assert_allclose(np.diff(times), 0.02 / count, rtol=1e-9)
    assert times[-1] + 0.02 / count / 2 == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("instructions", ["", "numpy"])
def test_the_mean_is_rounded_and_does_not_overflow(instructions: str) -> None:
    """Of as many images as may be, through a table."""
    codes = np.arange(256, dtype=np.int32)
    codes[253:] = 0, 65534, 65535
    values = np.array([[255, 255, 0], [255, 254, 0], [255, 254, 2]], np.uint8)
    passes = Passes(instructions)
    mean = passes.mean([row[None] for row in values], codes)
    assert mean.dtype == np.uint16
    np.testing.assert_array_equal(mean, [[65535, 65534, 1]])
    for count in range(1, 128):
        for light in range(0, count, 7):
            images = [np.full((1, 1), int(k < light), np.uint8) for k in range(count)]
            assert passes.mean(images, codes)[0, 0] == (2 * light + count) // (2 * count)
        assert passes.mean([np.full((1, 1), 255, np.uint8)] * count, codes)[0, 0] == 65535


@pytest.mark.parametrize("sigma", [0.7, 1.5, 4.0])
def test_defocus_has_no_say_in_the_instructions(sigma: float) -> None:
    """OpenCV's Gaussian of 16 bits is computed in whole numbers."""
    image = np.random.default_rng(1).integers(0, 65536, (61, 83, 3), np.uint16)
    quick = defocused(image, sigma)
    cv2.setUseOptimized(False)
    try:
        np.testing.assert_array_equal(defocused(image, sigma), quick)
    finally:
        cv2.setUseOptimized(True)


LOOKS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
SOLIDS = np.array([0, 0, 0, 1, 0, 0], np.uint8)


@pytest.fixture(params=["hall", pytest.param("yard", marks=pytest.mark.slow)], scope="module")
def world(
    request: pytest.FixtureRequest, draws: str
) -> Iterator[tuple[Scene, CameraRenderer, str]]:
    built = scene(request.param)
    renderer = renderer_of(built.packed, CAMERAS, built.prefix, seed=0)
    yield built, renderer, request.param
    renderer.close()


def exposures(renderer: CameraRenderer, name: str) -> Iterator[Frame]:
    """Frames along the world's tour, looking ahead, tilted a little this way and that."""
    points = TOURS[name]
    for number, (a, b) in enumerate(pairwise(points)):
        yaw = math.atan2(b[1] - a[1], b[0] - a[0])
        turn = from_rpy(0.2 * math.cos(number), 0.15 * math.sin(number), yaw)
        yield frames_of(renderer, 0, pose_to_qpos(a, turn), ("all",))["all"]


def cast(built: Scene, frame: Frame, columns: Any, rows: Any, group: Any) -> tuple[Array, Any]:
    """Planar depth (inf if none) and geom along the rays of some pixels."""
    info = camera_info(ALL)
    optical = np.stack(
        [(columns - info.cx) / info.fx, (rows - info.cy) / info.fy, np.ones(len(rows))], 1
    )
    rays = np.array([rotate(frame.orientation, tuple(ray)) for ray in optical.tolist()])
    rays[:, 1:] *= -1.0
    origin = np.array(frame.position) * (1.0, -1.0, -1.0)
    geoms, distance = np.empty(len(rays), np.int32), np.empty(len(rays))
    mujoco.mj_multiRay(
        built.model, built.data, origin, rays.ravel(), group, True, -1, geoms, distance, None,
        len(rays), 1e6,
    )  # fmt: skip
    # The rays reach to depth 1, so a distance in their lengths is the planar depth.
    return np.where(distance < 0, np.inf, distance), geoms


def inside(frame: Frame) -> npt.NDArray[np.bool_]:
    """Pixels whose neighbourhood is one face of one thing: no silhouettes, no creases."""
    assert frame.depth is not None
    assert frame.segmentation is not None
    # 1/z is linear in the pixel on any plane, so its second differences vanish there.
    inverse = 1.0 / frame.depth.astype(np.float64)
    flat = np.zeros(inverse.shape, bool)
    middle = inverse[1:-1, 1:-1]
    bend = np.maximum(
        np.abs(inverse[:-2, 1:-1] + inverse[2:, 1:-1] - 2 * middle),
        np.abs(inverse[1:-1, :-2] + inverse[1:-1, 2:] - 2 * middle),
    )
    number = frame.segmentation
    same = np.ones(middle.shape, bool)
    for down in range(3):
        for right in range(3):
            height, width = middle.shape
            same &= number[down : down + height, right : right + width] == number[1:-1, 1:-1]
    flat[1:-1, 1:-1] = same & (bend < 1e-3 * middle) & np.isfinite(frame.depth[1:-1, 1:-1])
    return flat


@pytest.mark.slow
def test_depth_lies_on_the_true_surfaces(world: tuple[Scene, CameraRenderer, str]) -> None:
    """Every pixel inside a face, to 15 m, is within 5 mm of where its ray hits."""
    built, renderer, name = world
    random = np.random.default_rng(0)
    errors, share = [], []
    for frame in exposures(renderer, name):
        assert frame.depth is not None
        usable = inside(frame)
        share.append(usable[np.isfinite(frame.depth)].mean())
        rows, columns = np.nonzero(usable & (frame.depth < 15.0))
        chosen = random.choice(len(rows), 500, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        true, _ = cast(built, frame, columns, rows, LOOKS)
        errors.append(frame.depth[rows, columns] - true)
    error = np.abs(np.concatenate(errors))
    assert np.mean(share) > 0.6
    assert error.max() < 0.005


@pytest.mark.slow
def test_nothing_hit_is_infinite_and_has_no_number(
    world: tuple[Scene, CameraRenderer, str],
) -> None:
    """Depth is inf and the number -1 in the same pixels: in the sky, and only there."""
    _, renderer, name = world
    up = frames_of(renderer, 0, pose_to_qpos((0.0, 0.0, -1.5), from_rpy(0.0, 0.9, 0.3)), ("all",))
    frame = up["all"]
    assert frame.depth is not None
    assert frame.segmentation is not None
    nothing = np.isinf(frame.depth)
    np.testing.assert_array_equal(nothing, frame.segmentation == -1)
    assert nothing.any() == (name == "yard")


@pytest.mark.slow
def test_numbers_are_those_of_the_geoms_that_are_hit(
    world: tuple[Scene, CameraRenderer, str],
) -> None:
    """A pixel's number is the geom a collision would name there: the solid behind the look."""
    built, renderer, name = world
    random = np.random.default_rng(0)
    agree = []
    for frame in exposures(renderer, name):
        assert frame.segmentation is not None
        rows, columns = np.nonzero(inside(frame))
        chosen = random.choice(len(rows), 200, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        _, geoms = cast(built, frame, columns, rows, LOOKS)
        for number, geom in zip(frame.segmentation[rows, columns], geoms, strict=True):
            seen = built.model.geom(int(number)).name
            hit = built.model.geom(int(geom)).name
            agree.append(seen == hit.removesuffix(".look"))
    assert np.mean(agree) == 1.0


def test_what_is_seen_is_what_is_felt(world: tuple[Scene, CameraRenderer, str]) -> None:
    """Solids stand where their looks are: rays meet both at the same range (leaves excepted)."""
    built, renderer, name = world
    random = np.random.default_rng(0)
    differences = []
    for frame in exposures(renderer, name):
        rows, columns = np.nonzero(inside(frame))
        chosen = random.choice(len(rows), 300, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        look, geoms = cast(built, frame, columns, rows, LOOKS)
        solid, _ = cast(built, frame, columns, rows, SOLIDS)
        names = [built.model.geom(int(geom)).name for geom in geoms]
        hard = np.array(["crown" not in n and "top" not in n for n in names])
        differences.append((solid - look)[hard])
    difference = np.abs(np.concatenate(differences))
    assert np.quantile(difference, 0.99) < 0.03
