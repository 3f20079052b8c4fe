"""Encoded depth: what is too near, too far or unknown."""

from __future__ import annotations

import numpy as np

from nodes.viewing.encoding import depth_in_steps


def test_millimetres_are_rounded_and_bounded() -> None:
    """0 stands for none: too near, too far, or not known."""
    metres = np.array([[0.0004, 0.0006, 65.535, 65.536, np.inf, np.nan]], np.float32)
    assert depth_in_steps(metres, 1000.0).tolist() == [[0, 1, 65535, 0, 0, 0]]
