"""Monocular odometry as a whole, and its node: signs, unit of length, lost, and begun again."""

from __future__ import annotations

import math
from functools import cache

import msgspec
import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    EstimatorAnnouncement,
    Event,
    Image,
    PoseEstimate,
    TrackedFeatures,
    TrackingLost,
)
from nodes.estimators import TrackingResult
from nodes.estimators.monocular_odometry import MonocularOdometry
from nodes.estimators.monocular_odometry.geometry import MonocularSettings
from nodes.estimators.monocular_odometry.tracker import MonocularTracker
from runtime.errors import ConfigError
from runtime.testing import run_node
from tests.nodes.estimators.monocular_odometry.world import (
    BOARD,
    FLAT,
    INFO,
    RELIEF,
    STEPPED,
    Floats,
    Grey,
    Tile,
    look,
    pose,
)

Place = tuple[float, ...]
"""As `pose` takes it."""
FRAME = 33_000_000
NO_MAP = TrackingResult(np.eye(4))
"""Stands for images before there is a map."""
DARK = np.zeros((INFO.height, INFO.width), np.uint8)
RIGHT: list[Place] = [(0.05 * i,) for i in range(24)]
seen = cache(lambda place, tiles=RELIEF: look(pose(*place), tiles))


def render(path: list[Place], tiles: tuple[Tile, ...] = RELIEF) -> list[Grey]:
    return [seen(place, tiles) for place in path]


def follow(odometry: MonocularTracker, images: list[Grey], start: int = 0) -> list[TrackingResult]:
    return [odometry.track((start + i) * FRAME, image) or NO_MAP for i, image in enumerate(images)]


def angle(a: Floats, b: Floats) -> float:
    """Return the angle between two vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def turned(a: Floats, b: Floats) -> float:
    """Return the angle between the orientations of two poses, degrees."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def unit(said: TrackingResult, place: Place) -> float:
    """Return what the odometry's unit of length is in metres, from how far it has come."""
    return float(np.linalg.norm(pose(*place)[:3, 3]) / np.linalg.norm(said.pose[:3, 3]))


MOTIONS: dict[str, list[Place]] = {
    "right": RIGHT,
    "left": [(-0.05 * i,) for i in range(24)],
    "down": [(0, 0.05 * i) for i in range(24)],
    "right and away": [(0.03 * i, 0, -0.04 * i) for i in range(24)],
    "right and turning right": [(0.05 * i, 0, 0, 0.5 * i) for i in range(24)],
    "down and turning up": [(0, 0.05 * i, 0, 0, 0.5 * i) for i in range(24)],
    "all at once": [(0.05 * i, -0.01 * i, 0.01 * i, -0.4 * i, 0.3 * i) for i in range(24)],
}


@pytest.mark.slow
@pytest.mark.parametrize("path", MOTIONS.values(), ids=MOTIONS)
def test_a_motion_has_its_direction_and_its_turn(path: list[Place]) -> None:
    *_, last = follow(MonocularTracker(INFO), render(path))
    assert last is not NO_MAP
    assert not last.lost
    true = pose(*path[-1])
    assert angle(last.pose[:3, 3], true[:3, 3]) < 0.6
    assert turned(last.pose, true) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("tiles", [FLAT, STEPPED, RELIEF], ids=["flat", "stepped", "relief"])
def test_the_unit_of_length_stays(tiles: tuple[Tile, ...]) -> None:
    path: list[Place] = [(0.07 * i, 0.005 * i, 0.004 * i, 0.2 * i) for i in range(34)]
    said = follow(MonocularTracker(INFO), render(path, tiles))
    known = [i for i, result in enumerate(said) if result is not NO_MAP]
    assert known[0] < 14
    units = [unit(said[i], path[i]) for i in known]
    np.testing.assert_allclose(units, units[-1], rtol=0.02)
    assert not any(result.lost for result in said)


def test_the_unit_is_the_median_depth_of_the_first_image() -> None:
    *_, last = follow(MonocularTracker(INFO), render(RIGHT, FLAT))
    assert unit(last, RIGHT[-1]) == pytest.approx(2.0, rel=5e-3)


@pytest.mark.slow
def test_a_camera_that_hurries_is_followed() -> None:
    odometry = MonocularTracker(INFO)
    follow(odometry, render(RIGHT, FLAT))
    hurry: list[Place] = [(1.15 + 0.35 * i, 0.1 * i) for i in range(1, 7)]  # 28 pixels an image
    said = follow(odometry, render(hurry, FLAT), 24)
    assert not any(result.lost for result in said)
    assert unit(said[-1], hurry[-1]) == pytest.approx(2.0, rel=0.02)


@pytest.mark.slow
def test_landmarks_that_leave_are_replaced_by_far_ones_in_time() -> None:
    path: list[Place] = [(0.06 * i,) for i in range(50)]
    said = follow(MonocularTracker(INFO), render(path, BOARD))
    known = [result for result in said if result is not NO_MAP]
    assert not any(result.lost for result in known)
    assert unit(known[-1], path[-1]) == pytest.approx(
        unit(known[20], path[-len(known) + 20]), rel=0.05
    )


@pytest.mark.slow
def test_what_moves_by_itself_does_not_agree() -> None:
    on: list[Place] = [(1.15 + 0.05 * i,) for i in range(1, 4)]
    thing = render([(9.0, 4.0)], FLAT)[0][40:120, 60:140]
    images = render([*RIGHT, *on], FLAT)
    odometry = MonocularTracker(INFO)
    for i, image in enumerate(images):
        moving = image.copy()
        row = 60 + (2 * (i - 22) if i > 22 else 0)
        column = 150 - round(3.8 * i)
        moving[row : row + 80, column : column + 80] = thing  # at first as if it lay on the floor
        result = odometry.track(i * FRAME, moving)
    assert result is not None
    (x, y), agree = result.points.T, result.inliers
    on_it = (x > column + 8) & (x < column + 72) & (y > row + 8) & (y < row + 72)
    assert not result.lost
    assert on_it.sum() > 5
    assert agree[on_it].mean() < 0.2
    assert agree[~on_it].mean() > 0.8
    assert unit(result, on[-1]) == pytest.approx(2.0, rel=0.02)


def test_nothing_is_known_before_there_is_a_map() -> None:
    said = follow(MonocularTracker(INFO), [DARK, DARK, *render(RIGHT)])
    first = next(i for i, result in enumerate(said) if result is not NO_MAP)
    assert first > 5
    assert not any(result.lost for result in said[first:])
    assert {result.reason for result in said[first:]} == {""}


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [[(0.0,)] * 12, [(0.0, 0.0, 0.0, 3.0 * i) for i in range(12)]], ids=["rest", "turning"]
)
def test_without_a_way_there_is_no_map(path: list[Place]) -> None:
    assert all(result is NO_MAP for result in follow(MonocularTracker(INFO), render(path)))


@pytest.mark.slow
def test_a_camera_that_turned_first_begins_once_it_moves() -> None:
    turn: list[Place] = [(0.0, 0.0, 0.0, 2.0 * i) for i in range(8)]
    away: list[Place] = [(0.05 * i, 0.0, 0.0, 14.0) for i in range(16)]
    assert follow(MonocularTracker(INFO), render(turn + away))[-1] is not NO_MAP


@pytest.mark.slow
def test_equal_images_give_equal_bits() -> None:
    images = [*render(RIGHT), DARK, *render(RIGHT[-3:])]
    one, other = (follow(MonocularTracker(INFO), images) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert a.pose.tobytes() == b.pose.tobytes()
        assert a.points.tobytes() == b.points.tobytes()
        assert a.inliers.tobytes() == b.inliers.tobytes()


def test_colour_is_seen_as_grey() -> None:
    grey, colour = MonocularTracker(INFO), MonocularTracker(INFO)
    images = render(RIGHT[:16])
    *_, a = follow(grey, images)
    *_, b = follow(colour, [np.repeat(image[..., None], 3, axis=2) for image in images])
    assert a is not NO_MAP
    np.testing.assert_array_equal(a.pose, b.pose)


def test_it_tells_what_it_followed() -> None:
    *_, last = follow(MonocularTracker(INFO), render(RIGHT))
    assert last.points.shape == (len(last.inliers), 2)
    assert last.inliers.sum() > 60


@pytest.mark.slow
def test_a_dark_moment_is_lost_and_regained_with_the_same_unit() -> None:
    odometry = MonocularTracker(INFO)
    *_, before = follow(odometry, render(RIGHT))
    dark = follow(odometry, [DARK] * 3, 24)
    assert all(result.lost and result is not NO_MAP and result.reason for result in dark)
    np.testing.assert_array_equal(dark[-1].pose, before.pose)
    on: list[Place] = [(1.15 + 0.05 * i,) for i in range(1, 12)]
    after = follow(odometry, render(on), 27)
    assert [result.lost for result in after[2:]] == [False] * 9
    assert {result.reason for result in after if not result.lost} == {"against a key frame", ""}
    assert unit(after[-1], on[-1]) == pytest.approx(unit(before, RIGHT[-1]), rel=0.01)


DOWN_AND_ASIDE: list[Place] = [
    *RIGHT[:14],
    *((0.65 + 0.04 * i, 0.0, 0.06 * i, 1.5 * i) for i in range(1, 14)),
]
"""Begins two metres above the floor, ends 1.22 m above it and turned by 19.5 degrees."""


def elsewhere(count: int) -> list[Grey]:
    """Return a flight over another floor, as far below the camera as the one that was lost."""
    return render([(7.0 + 0.04 * i, 4.0, 0.78) for i in range(count)], FLAT)


@pytest.mark.slow
def test_a_new_map_waits_for_the_timeout_says_so_and_goes_on_from_the_last_pose() -> None:
    odometry = MonocularTracker(INFO, MonocularSettings(reset_timeout=0.15))
    *_, before = follow(odometry, render(DOWN_AND_ASIDE, FLAT))
    assert not before.lost
    said = follow(odometry, elsewhere(20), len(DOWN_AND_ASIDE))
    new = next(i for i, result in enumerate(said) if not result.lost)
    assert new * FRAME > 0.15e9
    assert "new map" in said[new].reason
    assert (before.map, {result.map for result in said[new:]}) == (0, {1})
    assert NO_MAP not in said
    assert not any(result.lost or result.reason for result in said[new + 1 :])
    relative = [np.linalg.inv(before.pose) @ result.pose for result in said[new:]]
    assert np.linalg.norm(relative[0][:3, 3]) < 0.3  # it moved during initialization
    for motion in relative:
        assert angle(motion[:3, 3], np.array([1.0, 0.0, 0.0])) < 1.5
        assert turned(motion, np.eye(4)) < 0.5
    metres = 0.04 * (len(relative) - 1)
    units = np.linalg.norm(relative[-1][:3, 3] - relative[0][:3, 3])
    assert metres / units == pytest.approx(2.0, rel=0.15)  # about as deep as the last


@pytest.mark.slow
def test_before_the_timeout_there_is_no_new_map() -> None:
    odometry = MonocularTracker(INFO, MonocularSettings(reset_timeout=10.0))
    follow(odometry, render(RIGHT, FLAT))
    assert all(result.lost for result in follow(odometry, elsewhere(8), 24))


@pytest.mark.slow
def test_a_known_place_is_better_than_a_new_map_even_after_the_timeout() -> None:
    odometry = MonocularTracker(INFO, MonocularSettings(reset_timeout=0.1))
    *_, before = follow(odometry, render(RIGHT))
    assert all(result.lost for result in follow(odometry, [DARK] * 20, 24))
    *_, after = follow(odometry, render(RIGHT[-1:] * 3), 44)
    assert not after.lost
    assert unit(after, RIGHT[-1]) == pytest.approx(unit(before, RIGHT[-1]), rel=0.01)


def test_an_image_of_another_size_is_refused() -> None:
    odometry = MonocularTracker(INFO)
    for wrong in (DARK[:90], np.zeros((INFO.height, INFO.width, 4), np.uint8)):
        with pytest.raises(ValueError, match="image: expected 256×192 pixels"):
            odometry.track(0, wrong)


def test_a_distorted_camera_is_refused() -> None:
    bent = msgspec.structs.replace(INFO, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="without distortion"):
        MonocularTracker(bent)


def test_a_place_is_found_again_after_being_carried_there() -> None:
    odometry = MonocularTracker(INFO)
    *_, before = follow(odometry, render(RIGHT))
    odometry.track(24 * FRAME, DARK)
    there: Place = (0.75, 0.1, 0.0, 3.0)  # much farther than optical flow reaches
    *_, after = follow(odometry, render([there] * 3), 25)
    assert not after.lost
    assert turned(after.pose, pose(*there)) < 0.5
    assert unit(after, there) == pytest.approx(unit(before, RIGHT[-1]), rel=0.02)


PERIOD = 50_000_000


def camera() -> Event:
    return CameraAnnouncement(
        stamp=0,
        source="drone/down",
        images=("grey",),
        info=INFO,
        rate=20.0,
        latency=0.0,
        frame_id="down_optical",
        parent_frame_id="base_link",
        position=(0.0, 0.0, 0.0),
        orientation=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),  # straight down, right is right
    )


def image_event(number: int, data: Grey) -> Event:
    return Image(
        stamp=(number + 1) * PERIOD,
        source="drone/down",
        frame_id="down_optical",
        encoding="mono8",
        data=data,
    )


@pytest.mark.slow
def test_it_says_that_its_scale_is_free_and_nothing_before_it_has_a_map() -> None:
    images = [look(pose(x=0.06 * i)) for i in range(18)] + [np.zeros_like(look(pose()))]
    events = [image_event(i, image) for i, image in enumerate(images)]
    result = run_node(MonocularOdometry, inputs=[camera(), *events], duration=1.2, name="mono")
    (said,) = result.of(EstimatorAnnouncement)
    assert said.scale_free
    estimates, features = result.of(PoseEstimate), result.of(TrackedFeatures)
    assert 4 < len(estimates) < 14
    last = events[-1].stamp
    assert [f.stamp for f in features] == [e.stamp for e in estimates] + [last]
    assert estimates[0].stamp == events[18 - len(estimates)].stamp
    assert [event.stamp for event in result.of(TrackingLost)] == [last]
    assert estimates[0].frame_id == "odom"  # no vehicle said where it stands
    x, y, z = estimates[-1].position
    assert y > 0.2  # to the right of the image, which is to the body's right
    assert math.hypot(x, z) < 0.02 * y


@pytest.mark.parametrize(
    "settings",
    [{"corners": 10}, {"keyframe_overlap": 1.0}, {"keyframes": 2}, {"reset_timeout": -1.0}],
)
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        run_node(MonocularOdometry, config={"tracker": settings})
