"""What tests can ask of OpenCV 5 alone; all others pass with 4.10, too (`make test-opencv4`)."""

from __future__ import annotations

import cv2
import pytest

OPENCV_5 = int(cv2.__version__.partition(".")[0]) >= 5

needs_dense = pytest.mark.skipif(not OPENCV_5, reason="cv2.Odometry is of OpenCV 5")
drawn_by_5 = pytest.mark.skipif(
    not OPENCV_5, reason="OpenCV 4 has other letters, and rounds cubic interpolation differently"
)
"""For saved hashes of the built-in worlds' textures, and of images that show them."""
