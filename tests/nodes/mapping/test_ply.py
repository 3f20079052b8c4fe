"""What is written is what others read."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from nodes.mapping.cloud import read_ply, write_ply

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
    assert [each.name for each in path.parent.iterdir()] == ["a.ply"]


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
