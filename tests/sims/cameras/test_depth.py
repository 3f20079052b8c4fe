"""Depth and object numbers agree with rays cast by the physics engine."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from events.frames import from_rpy, rotate
from sims.cameras import CameraRenderer, Frame, camera_info, pose_to_qpos
from sims.worlds import TOURS
from tests.sims.cameras.scenes import ALL, CAMERAS, Scene, scene

Array = npt.NDArray[np.float64]
LOOKS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
SOLIDS = np.array([0, 0, 0, 1, 0, 0], np.uint8)


@pytest.fixture(params=["hall", pytest.param("yard", marks=pytest.mark.slow)], scope="module")
def world(request: pytest.FixtureRequest) -> Iterator[tuple[Scene, CameraRenderer, str]]:
    built = scene(request.param)
    renderer = CameraRenderer(built.packed, CAMERAS, built.prefix, seed=0)
    yield built, renderer, request.param
    renderer.close()


def exposures(renderer: CameraRenderer, name: str) -> Iterator[Frame]:
    """Frames along the world's tour, looking ahead, tilted a little this way and that."""
    points = TOURS[name]
    for number, (a, b) in enumerate(pairwise(points)):
        yaw = math.atan2(b[1] - a[1], b[0] - a[0])
        turn = from_rpy(0.2 * math.cos(number), 0.15 * math.sin(number), yaw)
        yield renderer.render(0, pose_to_qpos(a, turn), ("all",))["all"]


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


def test_nothing_hit_is_infinite_and_has_no_number(
    world: tuple[Scene, CameraRenderer, str],
) -> None:
    """Depth is inf and the number -1 in the same pixels: in the sky, and only there."""
    _, renderer, name = world
    up = renderer.render(0, pose_to_qpos((0.0, 0.0, -1.5), from_rpy(0.0, 0.9, 0.3)), ("all",))
    frame = up["all"]
    assert frame.depth is not None
    assert frame.segmentation is not None
    nothing = np.isinf(frame.depth)
    np.testing.assert_array_equal(nothing, frame.segmentation == -1)
    assert nothing.any() == (name == "yard")


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
