"""Sensor events: arrays are checked and made read-only, and intrinsics follow the convention."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import CameraInfo, DepthImage, Event, Image, LidarScan, PointCloud, SegmentationImage

COLOURS = np.zeros((2, 3), np.uint8)
TURN = {
    "frame_id": "l",
    "points": np.zeros((2, 3), np.float32),
    "intensities": np.zeros(2, np.float32),
    "times": np.zeros(2, np.float32),
    "rings": np.zeros(2, np.uint16),
}

GOOD: list[tuple[type[Event], dict[str, Any], str]] = [
    (Image, {"frame_id": "c", "data": np.zeros((4, 5, 3), np.uint8)}, "data"),
    (Image, {"frame_id": "c", "encoding": "mono8", "data": np.zeros((4, 5), np.uint8)}, "data"),
    (DepthImage, {"frame_id": "c", "data": np.zeros((4, 5), np.float32)}, "data"),
    (SegmentationImage, {"frame_id": "c", "data": np.zeros((4, 5), np.int32)}, "data"),
    (LidarScan, TURN, "points"),
    (PointCloud, {"points": np.zeros((2, 3), np.float32), "colors": COLOURS}, "points"),
]


@pytest.mark.parametrize(("event", "fields", "name"), GOOD)
def test_an_array_is_taken_by_reference_and_read_only_from_then_on(
    event: type[Event], fields: dict[str, Any], name: str
) -> None:
    array = fields[name].copy()
    said = event(stamp=0, source="c", **(fields | {name: array}))
    assert getattr(said, name) is array
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 1


@pytest.mark.parametrize(("event", "fields", "name"), GOOD)
def test_a_wrong_array_is_refused_with_what_was_expected_and_found(
    event: type[Event], fields: dict[str, Any], name: str
) -> None:
    right = fields[name]
    wrong: list[tuple[Any, str]] = [
        (right.astype(np.float64), r"float64 of shape \(\d"),
        (right[..., None, None], rf"{right.dtype} of shape .*1, 1\)"),
        (right.tolist(), "list"),
    ]
    for array, wrong_type in wrong:
        with pytest.raises(
            TypeError, match=rf"{event.__name__}\.{name}: expected .* found {wrong_type}"
        ):
            event(stamp=0, source="c", **(fields | {name: array}))


def test_the_message_reads_well() -> None:
    with pytest.raises(TypeError) as caught:
        Image(stamp=0, source="c", frame_id="c", data=np.zeros((1, 2), np.float32))
    assert str(caught.value) == (
        "Image.data: expected a 2 or 3-dimensional uint8 array, found float32 of shape (1, 2)"
    )


def test_images_are_equal_to_themselves_only() -> None:
    """Comparing pixels by accident would cost a millisecond, and fail on an ambiguous array."""
    data = np.zeros((2, 2), np.uint8)
    one, other = (Image(stamp=0, source="c", frame_id="c", data=data) for _ in range(2))
    assert one == one
    assert one != other
    assert len({one, other}) == 2


@given(width=st.integers(1, 4000), height=st.integers(1, 4000), fov=st.floats(0.1, math.pi - 0.1))
def test_an_ideal_camera_sees_its_field_of_view_from_edge_to_edge(
    width: int, height: int, fov: float
) -> None:
    """Pixel centres have whole coordinates, so the image's edges lie half a pixel outside."""
    camera = CameraInfo.from_fov(width, height, fov)
    ray = np.array([math.tan(fov / 2), 0.0, 1.0])
    for side, column in ((1, width - 0.5), (-1, -0.5)):
        pixel = camera.matrix() @ (ray * [side, 1, 1])
        assert pixel[0] == pytest.approx(column, abs=1e-6)
        assert pixel[1] == pytest.approx((height - 1) / 2)
    assert camera.fx == camera.fy
    assert camera.distortion == (0.0,) * 5


def test_intrinsics_are_frozen_and_comparable() -> None:
    camera = CameraInfo.from_fov(640, 480, 1.0)
    assert camera == CameraInfo.from_fov(640, 480, 1.0)
    with pytest.raises(AttributeError, match="immutable"):
        camera.fx = 1.0  # type: ignore[misc]
