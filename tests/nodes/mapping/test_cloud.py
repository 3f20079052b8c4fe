"""Points from depth, and one point in each voxel: held against doing it one by one.

What is written as PLY is what others read.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraInfo
from nodes.mapping import VoxelCloud, back_project, rays_of, read_ply, write_ply

INFO = CameraInfo.from_fov(64, 48, math.radians(80.0))

Array = npt.NDArray[Any]


def measured(seed: int, count: int, spread: float = 0.4) -> tuple[Array, Array, Array]:
    """Points, colours and distances; some of the distances are equal."""
    random = np.random.default_rng(seed)
    return (
        random.uniform(-spread, spread, (count, 3)),
        random.integers(0, 256, (count, 3), dtype=np.uint8),
        random.integers(1, 40, count).astype(np.float32),
    )


def one_by_one(frames: list[tuple[Array, Array, Array]], voxel: float) -> dict[Any, Any]:
    """Distance, point and colour by voxel, the slow way."""
    held: dict[Any, Any] = {}
    for points, colours, distances in frames:
        for point, colour, distance in zip(points, colours, distances, strict=True):
            key = tuple(math.floor(c / voxel) for c in point)
            if key not in held or distance < held[key][0]:
                held[key] = distance, tuple(point.astype(np.float32)), tuple(colour)
    return held


def content(cloud: VoxelCloud) -> set[Any]:
    return set(zip(map(tuple, cloud.points), map(tuple, cloud.colours), strict=True))


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 60)), max_size=6),
    st.sampled_from([0.05, 0.13, 0.3]),
)
def test_each_voxel_holds_the_point_measured_from_nearest(
    frames: list[tuple[int, int]], voxel: float
) -> None:
    """Within a frame and from frame to frame; the first, of those from equally near."""
    batches = [measured(*frame) for frame in frames]
    cloud = VoxelCloud(voxel)
    for batch in batches:
        cloud.add(*batch)
    held = one_by_one(batches, voxel)
    assert len(cloud) == len(held)
    assert content(cloud) == {(point, colour) for _, point, colour in held.values()}
    assert (np.diff(cloud.keys) > 0).all()


def test_memory_follows_the_voxels_not_the_points() -> None:
    """A thousand looks at the same metre of wall take no more room than one."""
    cloud = VoxelCloud(0.05)
    random = np.random.default_rng(0)
    for _ in range(1000):
        points = random.uniform(0.0, 0.999, (200, 3)) * (1.0, 1.0, 0.0)
        cloud.add(points, np.zeros((200, 3), np.uint8), np.ones(200, np.float32))
    assert len(cloud) == 400
    assert cloud._points.nbytes + cloud._colours.nbytes < 100_000
    assert cloud.points.shape == cloud.colours.shape == (400, 3)


def test_two_surfaces_in_one_voxel_are_not_averaged() -> None:
    """Every point of the cloud is one that was measured: it lies on either face of a step."""
    random = np.random.default_rng(0)
    points = random.uniform(0.0, 1.0, (5000, 3))
    points[:, 2] = np.where(random.random(5000) < 0.5, 0.51, 0.54)
    cloud = VoxelCloud(0.1)
    cloud.add(points, np.zeros((5000, 3), np.uint8), random.random(5000).astype(np.float32))
    assert set(np.unique(cloud.points[:, 2])) == {np.float32(0.51), np.float32(0.54)}


def test_voxels_do_not_join_across_the_origin() -> None:
    """-0.01 and 0.01 are in different ones, on each axis."""
    cloud = VoxelCloud(0.05)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    cloud.add(0.01 * signs, np.zeros((8, 3), np.uint8), np.ones(8, np.float32))
    assert len(cloud) == 8


def test_points_too_far_to_number_are_refused() -> None:
    cloud = VoxelCloud(0.001)
    far = np.array([[0.0, 0.0, 0.0], [0.0, -1100.0, 0.0]])
    with pytest.raises(ValueError, match=r"within 1048.58 m of the origin, found \[ +0. +-1100."):
        cloud.add(far, np.zeros((2, 3), np.uint8), np.ones(2, np.float32))
    with pytest.raises(ValueError, match="points: expected them within"):
        cloud.add(np.full((1, 3), np.nan), np.zeros((1, 3), np.uint8), np.ones(1, np.float32))
    assert len(cloud) == 0
    with pytest.raises(ValueError, match="voxel: expected an edge above 0 m, found 0"):
        VoxelCloud(0.0)


@pytest.mark.parametrize("stride", [1, 2, 3, 7])
def test_pixels_fall_back_on_themselves(stride: int) -> None:
    """A point made from a pixel and its depth projects onto that pixel."""
    random = np.random.default_rng(0)
    depth = random.uniform(0.5, 9.0, (48, 64)).astype(np.float32)[::stride, ::stride]
    points, seen = back_project(depth, rays_of(INFO, stride), 10.0)
    assert seen.all()
    columns = INFO.fx * points[:, 0] / points[:, 2] + INFO.cx
    rows = INFO.fy * points[:, 1] / points[:, 2] + INFO.cy
    expected = np.mgrid[0:48:stride, 0:64:stride]
    np.testing.assert_allclose(rows, expected[0].ravel(), atol=1e-4)
    np.testing.assert_allclose(columns, expected[1].ravel(), atol=1e-4)
    np.testing.assert_array_equal(points[:, 2], depth.ravel())


def test_a_lens_that_distorts_is_allowed_for() -> None:
    info = CameraInfo(
        width=64, height=48, fx=60.0, fy=58.0, cx=31.0, cy=24.5,
        distortion=(-0.12, 0.03, 0.001, -0.002, 0.0),
    )  # fmt: skip
    rays = rays_of(info, 5).reshape(-1, 2).astype(np.float64)
    points = np.column_stack([rays, np.ones(len(rays))])
    pixels, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), info.matrix(), np.array(info.distortion)
    )
    rows, columns = np.mgrid[0:48:5, 0:64:5]
    expected = np.column_stack([columns.ravel(), rows.ravel()])
    np.testing.assert_allclose(pixels[:, 0], expected, atol=0.02)


def test_a_fisheyes_rays_to_the_side_and_back_give_no_points() -> None:
    info = CameraInfo(
        width=64, height=48, fx=15.0, fy=15.0, cx=31.5, cy=23.5,
        distortion_model="equidistant", distortion=(0.0,) * 4,
    )  # fmt: skip
    rays = rays_of(info, 1)
    points, seen = back_project(np.ones((48, 64), np.float32), rays, 10.0)
    assert not seen[23, 0]  # 120 degrees off the axis
    assert seen[23, 31]
    assert np.isfinite(points).all()
    rows, columns = np.nonzero(seen)
    expected = np.column_stack([columns, rows])
    np.testing.assert_allclose(info.project(points), expected, atol=2e-3)


def test_what_is_too_far_or_was_not_hit_is_left_out() -> None:
    depth = np.array([[1.0, np.inf, 0.0], [5.0, 5.01, np.nan]], np.float32)
    points, seen = back_project(depth, np.zeros((2, 3, 2), np.float32), 5.0)
    assert seen.tolist() == [[True, False, False], [True, False, False]]
    assert points[:, 2].tolist() == [1.0, 5.0]


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"depth: expected shape \(24, 32\), found \(48, 64\)"):
        back_project(np.ones((48, 64), np.float32), rays_of(INFO, 2), 5.0)


POINTS = np.array([[1.5, -2.25, 0.125], [1e-3, 3e4, -7.0], [0.0, 0.0, 0.0]], np.float32)
COLOURS = np.array([[255, 0, 128], [1, 2, 3], [9, 8, 7]], np.uint8)


def test_a_cloud_comes_back(tmp_path: Path) -> None:
    """Through a reader that knows nothing of the writer."""
    path = tmp_path / "clouds" / "a.ply"
    write_ply(path, POINTS, COLOURS, "map")
    cloud = read_ply(path, 10)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.colors, COLOURS)
    assert cloud.total == 3
    assert [file.name for file in path.parent.iterdir()] == ["a.ply"]


def test_the_name_of_a_frame_stays_in_its_line(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, POINTS, COLOURS, "odom\nélement")
    assert read_ply(path, 10).total == 3


def test_the_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    """A header in ASCII, with the frame in a comment, then 15 bytes a point, little-endian."""
    path = tmp_path / "a.ply"
    write_ply(path, POINTS, COLOURS, "map")
    header, _, body = path.read_bytes().partition(b"end_header\n")
    assert header.decode("ascii").splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment frame map: metres, x north, y east, z down",
        "element vertex 3",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
    ]
    rows = [struct.unpack("<fffBBB", body[k : k + 15]) for k in range(0, len(body), 15)]
    assert rows[0] == (1.5, -2.25, 0.125, 255, 0, 128)
    assert len(rows) == 3
    write_ply(path, POINTS, COLOURS, "odom")
    assert b"comment frame odom: metres\n" in path.read_bytes()


def test_an_empty_cloud_is_a_file_too(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, POINTS[:0], COLOURS[:0], "map")
    assert read_ply(path, 10).total == 0


def test_arrays_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(ValueError, match=r"one shape \(n, 3\), found \(3, 3\) and \(2, 3\)"):
        write_ply(path, POINTS, COLOURS[:2], "map")
    with pytest.raises(ValueError, match=r"found \(3, 2\) and \(3, 2\)"):
        write_ply(path, POINTS[:, :2], COLOURS[:, :2], "map")
    assert list(tmp_path.iterdir()) == []
