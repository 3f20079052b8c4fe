"""What every method of RGB-D odometry must do, and what features do beyond it."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from events import CameraInfo
from nodes.estimators import TrackingResult
from nodes.estimators.images import Floats
from nodes.estimators.visual_odometry.features import FeatureSettings, FeatureTracker
from nodes.estimators.visual_odometry.node import DenseSettings, DenseTracker
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose
from tests.opencv import needs_dense

Tracker = FeatureTracker | DenseTracker
Make = Callable[[CameraInfo], Tracker]
METHODS = pytest.mark.parametrize(
    "make", [FeatureTracker, pytest.param(DenseTracker, marks=needs_dense)]
)
FRAME = 33_000_000


def follow(tracker: Tracker, path: list[Floats], start: int = 0) -> list[TrackingResult]:
    return [tracker.track((start + i) * FRAME, *look(place)) for i, place in enumerate(path)]


def off(said: TrackingResult, true: Floats) -> tuple[float, float]:
    """Return the errors of a pose: metres, degrees."""
    between = np.linalg.inv(true) @ said.pose
    cosine = np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(between[:3, 3])), float(np.degrees(np.arccos(cosine)))


RIGHT = [pose(x=0.02 * i) for i in range(12)]
MOTIONS = {
    "right": [pose(x=0.02 * i) for i in range(8)],
    "down": [pose(y=0.02 * i) for i in range(8)],
    "forward": [pose(z=0.03 * i) for i in range(8)],
    "turning right": [pose(yaw=0.7 * i) for i in range(8)],
    "turning up": [pose(pitch=0.7 * i) for i in range(8)],
    "all at once": [pose(0.015 * i, -0.01 * i, 0.02 * i, -0.5 * i, 0.3 * i) for i in range(8)],
}


@pytest.mark.slow
@METHODS
@pytest.mark.parametrize("path", MOTIONS.values(), ids=MOTIONS)
def test_follows_a_motion_with_its_signs_and_in_metres(make: Make, path: list[Floats]) -> None:
    *_, last = follow(make(INFO), path)
    assert not last.lost
    metres, degrees = off(last, path[-1])
    assert metres < 0.02
    assert degrees < 0.4


@METHODS
def test_a_camera_at_rest_stays(make: Make) -> None:
    said = follow(make(INFO), [pose()] * 5)
    assert max(off(result, pose())[0] for result in said) < 1e-3


@pytest.mark.slow
@METHODS
def test_equal_images_give_equal_bits(make: Make) -> None:
    first, second = (follow(make(INFO), MOTIONS["all at once"]) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.pose.tobytes() == b.pose.tobytes()
        assert a.points.tobytes() == b.points.tobytes()


@pytest.mark.slow
@METHODS
def test_colour_and_grey_are_the_same(make: Make) -> None:
    grey, coloured = make(INFO), make(INFO)
    for index, place in enumerate(MOTIONS["forward"]):
        image, depth = look(place)
        a = grey.track(index, image, depth)
        b = coloured.track(index, np.repeat(image[..., None], 3, axis=2), depth)
    np.testing.assert_allclose(a.pose, b.pose, atol=1e-4)


@pytest.mark.slow
@METHODS
def test_a_dark_moment_is_lost_and_regained_at_the_same_place(make: Make) -> None:
    tracker, path = make(INFO), RIGHT
    follow(tracker, path)
    dark = np.zeros((240, 320), np.uint8), np.full((240, 320), np.inf, np.float32)
    said = [tracker.track((20 + i) * FRAME, *dark) for i in range(3)]
    assert all(result.lost and result.reason for result in said)
    assert off(said[-1], path[-1])[0] < 0.02  # the last pose that was known
    after = follow(tracker, [path[-1], pose(x=0.23), pose(x=0.24)], 23)
    assert not after[-1].lost
    assert off(after[-1], pose(x=0.24))[0] < 0.03


@METHODS
def test_an_image_of_another_size_is_refused(make: Make) -> None:
    image, depth = look(pose())
    with pytest.raises(ValueError, match="image: expected 320×240 pixels"):
        make(INFO).track(0, image[:90], depth)
    with pytest.raises(ValueError, match="depth: expected 320×240 pixels"):
        make(INFO).track(0, image, depth[:90])


@METHODS
def test_a_distorted_camera_is_refused(make: Make) -> None:
    bent = msgspec.structs.replace(INFO, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="without distortion"):
        make(bent)


@METHODS
def test_darkness_from_the_start_is_lost_until_something_is_seen(make: Make) -> None:
    tracker = make(INFO)
    dark = np.zeros((240, 320), np.uint8), np.full((240, 320), np.inf, np.float32)
    assert tracker.track(0, *dark).lost
    assert not follow(tracker, [pose(), pose(x=0.02)], 1)[-1].lost


def test_features_find_a_place_again_that_they_were_carried_to() -> None:
    tracker, path = FeatureTracker(INFO), RIGHT
    follow(tracker, path)
    dark = np.zeros((240, 320), np.uint8), np.full((240, 320), np.inf, np.float32)
    tracker.track(20 * FRAME, *dark)
    elsewhere = [pose(x=-0.1, yaw=4.0)] * 3  # much farther than optical flow reaches
    *_, said = follow(tracker, elsewhere, 21)
    assert not said.lost
    assert off(said, elsewhere[0])[0] < 0.03


@pytest.mark.slow
def test_features_begin_a_new_map_if_nothing_is_known_and_say_so() -> None:
    settings = FeatureSettings(reset_timeout=0.1)
    tracker = FeatureTracker(INFO, settings)
    follow(tracker, RIGHT)
    strange = pose(x=40.0)  # past the wall's end there is none
    far = pose(x=-6.0, y=6.0)  # another part of the wall
    follow(tracker, [strange], 20)
    said = follow(tracker, [far] * 6, 21)
    assert [result.lost for result in said][-1] is False
    assert any("new map" in result.reason for result in said)
    assert said[-1].map == 1
    x, y, z = said[-1].pose[:3, 3]
    assert abs(y) < 0.01
    assert abs(z) < 0.01
    assert 0.2 < x < 0.5  # the pose goes on as it moved, and ever more slowly


@needs_dense
@pytest.mark.slow
def test_a_dense_map_at_a_guessed_pose_has_a_number_of_its_own() -> None:
    tracker = DenseTracker(INFO, DenseSettings(reset_timeout=0.0))
    assert follow(tracker, RIGHT)[-1].map == 0
    assert follow(tracker, [pose(x=-6.0, y=6.0, yaw=60.0)], 20)[-1].map == 1


def test_features_tell_what_they_followed() -> None:
    *_, said = follow(FeatureTracker(INFO), RIGHT)
    assert said.points.shape == (len(said.inliers), 2)
    assert said.inliers.sum() > 50
