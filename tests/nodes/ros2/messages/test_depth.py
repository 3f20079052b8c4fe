"""Compressed depth, read as compressed_depth_image_transport's decoder reads it."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from events import DepthImage
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.images import HEAD, decode_compressed
from nodes.ros2.messages.topics import PublishingConfig
from tests.nodes.ros2.messages import samples


def message(depth: np.ndarray, farthest: float = 10.0) -> Any:
    event = DepthImage(stamp=samples.STAMP, source="s", frame_id="eye", data=depth)
    config = PublishingConfig(compressed_depth="inverse", depth_max=farthest)
    return samples.message(outgoing.compressed_depth, event, config=config)


def decoded(data: np.ndarray) -> np.ndarray:
    """Return depth, NaN for none: ``decodeCompressedDepthImage`` of codec.cpp, in other words."""
    format_, a, b = struct.unpack("<iff", bytes(data[:12]))
    assert format_ == 0
    inverse = cv2.imdecode(data[12:], cv2.IMREAD_UNCHANGED)
    assert inverse is not None
    assert inverse.dtype == np.uint16
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inverse > 0, np.float32(a) / (inverse - np.float32(b)), np.nan)


def test_depth_comes_back_within_its_step() -> None:
    depth = np.linspace(0.2, 9.99, 48 * 64, dtype=np.float32).reshape(48, 64)
    metres = decoded(message(depth).data)
    np.testing.assert_array_less(np.abs(metres - depth), 0.51 * depth**2 / 10_100 + 1e-4)


def test_what_is_unknown_or_too_far_stays_unknown_and_what_is_too_near_is_near() -> None:
    depth = np.array([[np.inf, 10.0, 25.0, 0.0, np.nan, 9.9, 0.05]], np.float32)
    metres = decoded(message(depth).data)[0]
    assert np.isnan(metres[:5]).all()
    assert metres[5] == pytest.approx(9.9, abs=0.006)
    assert metres[6] == pytest.approx(10_100 / (65_535 + 1009), rel=1e-4)
    assert decoded(message(depth, 30.0).data)[0, 2] == pytest.approx(25.0, abs=0.04)


def test_its_header_and_format_are_those_of_the_plugin() -> None:
    packed = message(np.full((2, 2), 1.0, np.float32))
    assert packed.format == "32FC1; compressedDepth png"
    assert (packed.header.frame_id, packed.header.stamp.sec) == ("eye", 3)
    # q (q + 1) and 1 - a / z_max as float32, as its encoder has them for 100 and 10 m.
    assert bytes(packed.data[:12]) == struct.pack("<iff", 0, 10_100.0, -1009.0)
    assert bytes(packed.data[12:20]) == b"\x89PNG\r\n\x1a\n"


def test_inverse_depth_is_read() -> None:
    """As compressed_depth_image_transport makes it of 32FC1: q = 100, and 10 m at most."""
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    metres = np.array([[0.5, 2.0, 9.0]], np.float32)
    steps = np.append(np.rint(a / metres + b), [[0.0]], axis=1).astype(np.uint16)
    _, png = cv2.imencode(".png", steps)
    data = np.frombuffer(HEAD.pack(0, a, b) + png.tobytes(), np.uint8)
    message = SimpleNamespace(format="32FC1; compressedDepth png", data=data)
    depth = decode_compressed(message)
    assert depth[0, :3] == pytest.approx(metres[0], rel=5e-3)
    assert np.isinf(depth[0, 3])
    for form, wrong in (("8UC1; compressedDepth", data), ("16UC1; compressedDepth", data[:12])):
        with pytest.raises(ValueError, match="expected"):
            decode_compressed(SimpleNamespace(format=form, data=wrong))
