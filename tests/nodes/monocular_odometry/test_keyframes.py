"""A lost camera knows a key frame again from elsewhere, and nothing that is not there."""

from __future__ import annotations

import numpy as np
import pytest

from nodes.monocular_odometry.flow import new_corners
from nodes.monocular_odometry.keyframes import Keyframe, find_again
from nodes.monocular_odometry.views import rays
from nodes.visual_odometry.tracker import Floats
from tests.nodes.visual_odometry.world import INFO, look, pose


def keyframe() -> Keyframe:
    """Return the picture at the origin, with landmarks where its depth has them."""
    image, depth = look(pose())
    pixels = new_corners(image, np.empty((0, 2)), 300)
    column, row = np.rint(pixels).astype(int).T
    landmarks = rays(pixels, INFO.matrix()) * depth[row, column][:, None]
    return Keyframe(image, np.eye(4), landmarks, pixels)


@pytest.mark.parametrize("there", [pose(), pose(x=-0.15, yaw=3.0), pose(z=0.4)])
def test_a_key_frame_is_recognised_from_elsewhere(there: Floats) -> None:
    found = find_again(look(there)[0], keyframe(), INFO.matrix())
    assert found is not None
    said, agree = found
    assert agree > 15
    np.testing.assert_allclose(np.linalg.inv(said)[:3, 3], there[:3, 3], atol=0.12)


def test_what_is_not_in_the_picture_is_not_recognised() -> None:
    assert find_again(look(pose(x=-6.0, y=6.0))[0], keyframe(), INFO.matrix()) is None
