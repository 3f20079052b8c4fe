"""Poses stay in one frame while ORB-SLAM3's worlds come, turn and merge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from nodes.estimators.orb_slam3.process import Anchor, KeyFrame, first_key_frame

Floats = npt.NDArray[np.float64]


def pose(x: float, yaw: float = 0.0) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", yaw).as_matrix()
    matrix[:3, 3] = (x, 0.0, 0.0)
    return matrix


def test_the_first_key_frame_is_the_origin_wherever_the_world_is() -> None:
    anchor = Anchor()
    assert anchor.maps == 0
    upright = pose(5.0, 1.0)
    anchor.world_may_have_changed(KeyFrame(0.5, upright), upright @ pose(2.0))
    np.testing.assert_allclose(anchor.place(upright @ pose(3.0)), pose(3.0), atol=1e-12)
    assert anchor.maps == 1


def test_a_world_that_turns_takes_its_first_key_frame_along() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    np.testing.assert_allclose(anchor.place(pose(1.0)), pose(1.0))
    turned = pose(-4.0, 0.7)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), turned @ pose(1.1))
    np.testing.assert_allclose(anchor.place(turned @ pose(1.2)), pose(1.2), atol=1e-12)
    assert anchor.maps == 1


def test_a_pose_from_just_before_the_world_turned_is_told_by_the_old_one() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    anchor.place(pose(1.0))
    turned = pose(-4.0, 0.7)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), pose(1.1))
    np.testing.assert_allclose(anchor.place(pose(1.1)), pose(1.1), atol=1e-12)
    anchor.world_may_have_changed(KeyFrame(0.5, turned), turned @ pose(1.2))
    np.testing.assert_allclose(anchor.place(turned @ pose(1.2)), pose(1.2), atol=1e-12)


def test_a_small_turn_is_followed_with_the_next_pose_at_the_latest() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.5, np.eye(4)), pose(1.0))
    anchor.place(pose(1.0))
    turned = pose(0.02)
    for _ in range(2):  # the camera stands still, so the old world seems right
        anchor.world_may_have_changed(KeyFrame(0.5, turned), pose(1.0))
        anchor.place(pose(1.0))
    np.testing.assert_allclose(anchor.last, pose(0.98), atol=1e-12)


def test_a_new_map_begins_where_the_camera_was_last_and_falls_into_place_when_merged() -> None:
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), np.eye(4))
    anchor.place(pose(2.0, 0.3))
    # Lost; a new map whose first key frame is the present one.
    anchor.world_may_have_changed(KeyFrame(7.0, np.eye(4)), np.eye(4))
    np.testing.assert_allclose(anchor.place(np.eye(4)), pose(2.0, 0.3), atol=1e-12)
    np.testing.assert_allclose(anchor.place(pose(0.5)), pose(2.0, 0.3) @ pose(0.5), atol=1e-12)
    assert (anchor.maps, anchor.map) == (2, 1)
    # Merged: the world is the first map's again, and its pose there is the truth.
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), pose(3.1))
    np.testing.assert_allclose(anchor.place(pose(3.1)), pose(3.1), atol=1e-12)
    assert anchor.map == 0
    assert anchor.maps == 2


def test_a_new_map_may_begin_before_the_present_image() -> None:
    """Without depth, the first key frame is some images back."""
    anchor = Anchor()
    anchor.world_may_have_changed(KeyFrame(0.0, np.eye(4)), np.eye(4))
    anchor.place(pose(2.0))
    anchor.world_may_have_changed(KeyFrame(7.0, np.eye(4)), pose(0.4))
    np.testing.assert_allclose(anchor.place(pose(0.4)), pose(2.0), atol=1e-12)


def test_the_first_key_frame_of_a_trajectory(tmp_path: Path) -> None:
    file = tmp_path / "trajectory.tum"
    file.write_text(
        "1.500000 0.1 -0.2 3.0 0.0 0.70710678 0.0 0.70710678\n1.6 0 0 0 0 0 0 1\n",
        encoding="ascii",
    )
    first = first_key_frame(file)
    assert first is not None
    assert first.stamp == 1.5
    np.testing.assert_allclose(first.pose[:3, 3], (0.1, -0.2, 3.0))
    np.testing.assert_allclose(
        first.pose[:3, :3], Rotation.from_euler("y", 90, degrees=True).as_matrix(), atol=1e-7
    )
    file.write_text("")
    assert first_key_frame(file) is None
