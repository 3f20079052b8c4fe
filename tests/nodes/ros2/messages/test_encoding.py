"""Images and depth as JPEG and PNG."""

from __future__ import annotations

import cv2
import numpy as np

from nodes.ros2.messages.images import depth_in_steps, encode_depth, encode_image
from tests.nodes.viewers.common.samples import decoded


def test_red_stays_red() -> None:
    data = np.zeros((16, 16, 3), np.uint8)
    data[..., 0] = 220
    back = decoded(encode_image(data, "jpeg").tobytes(), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back.astype(int) - data).max() < 8


def test_depth_is_kept_to_the_centimetre_and_nothing_is_nought() -> None:
    data = np.array([[1.234, np.inf], [0.0, 700.0]], np.float32)
    back = decoded(encode_depth(depth_in_steps(data, 100.0)), cv2.IMREAD_UNCHANGED)
    assert back.tolist() == [[123, 0], [0, 0]]


def test_millimetres_are_rounded_and_bounded() -> None:
    """0 stands for none: too near, too far, or not known."""
    metres = np.array([[0.0004, 0.0006, 65.535, 65.536, np.inf, np.nan]], np.float32)
    assert depth_in_steps(metres, 1000.0).tolist() == [[0, 1, 65535, 0, 0, 0]]
