"""What is said of estimators while somebody looks."""

from __future__ import annotations

import math
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    EstimatorAnnouncement,
    Event,
    Image,
    Odometry,
    PoseEstimate,
    Score,
    TrackedFeatures,
    TrackingLost,
    TrackingRegained,
)
from events.frames import from_yaw
from runtime.time.clock import SECOND
from runtime.tools.monitor.estimators import MOST_POINTS, Measured, Path
from runtime.tools.monitor.protocol import formatted

MS = SECOND // 1000


class Run:
    """The events of a run up to now."""

    def __init__(self, **announced: Any) -> None:
        self.now = 0
        announcement = EstimatorAnnouncement(stamp=0, source="vo", method="x", **announced)
        self.announcements: list[Announcement] = [announcement]
        state = Mock(announcements=self.announcements)
        state.clock.now = lambda: self.now
        self.measured = Measured(state)

    def send(self, event: Event, name: str = "a.b") -> None:
        self.now = max(self.now, event.stamp)
        self.measured.follow[type(event)](name, event)

    def fly(self, seconds: int, shown: Any, **where: Any) -> None:
        """Fly a circle about (3, 4) northwards, and say of each place what `shown` makes of it."""
        for stamp in range(0, seconds * SECOND, 100 * MS):
            angle = stamp / SECOND
            place = (3 + 2 * math.cos(angle), 4 + 2 * math.sin(angle), -1.0)
            turn = from_yaw(angle)
            rest: Any = {"linear_velocity": (0.0,) * 3, "angular_velocity": (0.0,) * 3}
            self.send(
                Odometry(stamp=stamp, source="drone", position=place, orientation=turn, **rest)
            )
            x, y, yaw = shown(*place[:2], angle)
            self.send(
                PoseEstimate(
                    stamp=stamp,
                    source="vo",
                    position=(x, y, 5.0),
                    orientation=from_yaw(yaw),
                    **where,
                )
            )

    def row(self) -> dict[str, str]:
        (row,) = formatted("estimators", self.measured.rows())
        return dict(zip(("name", "tracking", "m", "percent", "latency"), row, strict=True))


def test_the_ate_is_the_last_that_was_sent_and_nothing_of_ours() -> None:
    run = Run()
    assert (run.row()["m"], run.row()["percent"]) == ("", "")
    for value in (9.0, 0.1234):
        for metric, unit in (("ate_rmse", "m"), ("ate_percent", "%")):
            score = Score(
                stamp=0, source="judge", subject="vo", metric=metric, value=value, unit=unit
            )
            run.send(score)
    assert (run.row()["m"], run.row()["percent"]) == ("0.123", "0.12")


def test_who_has_lost_track_is_lost_by_word_and_by_silence() -> None:
    run = Run()
    assert run.row()["tracking"] == "silent"
    run.fly(1, lambda *pose: pose)
    assert run.row()["tracking"] == "tracking"
    run.send(TrackingLost(stamp=run.now, source="vo", reason="too dark"))
    assert run.row()["tracking"] == "lost: too dark"
    run.send(TrackingLost(stamp=run.now, source="vo"))
    assert run.row()["tracking"] == "lost"
    run.send(TrackingRegained(stamp=run.now, source="vo"))
    assert run.row()["tracking"] == "tracking"
    run.now += 700 * MS
    assert run.row()["tracking"] == "lost: silent for 0.7 s"


def test_latency_is_that_of_the_last_estimate() -> None:
    run = Run()
    run.now = 55 * MS
    run.send(
        PoseEstimate(
            stamp=0, source="vo", position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)
        )
    )
    assert run.row()["latency"] == "55.0"


def _turned(x: float, y: float, yaw: float) -> tuple[float, float, float]:
    """Return a pose in a frame that begins at (5, 1), turned by a quarter."""
    return y - 1.0, 5.0 - x, yaw - math.pi / 2


@pytest.mark.parametrize(
    ("shown", "announced", "frame_id"),
    [
        (lambda *pose: pose, {}, "map"),
        (_turned, {}, "odom"),
        (lambda *pose: [0.2 * part for part in _turned(*pose)], {"scale_free": True}, "odom"),
    ],
)
def test_an_estimate_is_laid_on_the_truth(
    shown: Any, announced: dict[str, Any], frame_id: str
) -> None:
    run = Run(**announced)
    run.fly(3, shown, frame_id=frame_id)
    paths = run.measured.paths()
    assert [*paths] == ["drone: truth", "vo"]
    assert np.array(paths["vo"]) == pytest.approx(np.array(paths["drone: truth"]), abs=5e-3)
    assert paths["drone: truth"][0] == (4.0, 5.0)  # east, north


def test_without_scale_it_is_laid_on_the_truth_at_its_camera() -> None:
    """The body that it says is half a metre from a camera in a fifth of the truth's unit."""
    run = Run(scale_free=True)
    eye = CameraAnnouncement(
        stamp=0,
        source="drone/eye",
        frame_id="eye",
        parent_frame_id="base_link",
        position=(0.5, 0.0, 0.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        images=("grey",),
        info=CameraInfo.from_fov(64, 48, 1.5),
        rate=10.0,
        latency=0.0,
    )
    run.announcements.append(eye)
    nothing, inliers = np.empty((0, 2), np.float32), np.empty(0, np.bool_)
    features = TrackedFeatures(
        stamp=0, source="vo", frame_id="eye", points=nothing, inliers=inliers
    )
    run.send(features)

    def said(x: float, y: float, yaw: float) -> tuple[float, float, float]:
        ahead = np.array([0.5 * math.cos(yaw), 0.5 * math.sin(yaw)])
        north, east = 0.2 * (np.array([x, y]) + ahead) - ahead
        return float(north), float(east), yaw

    run.fly(3, said, frame_id="odom")
    paths = run.measured.paths()
    assert np.array(paths["vo"]) == pytest.approx(np.array(paths["drone: truth"]), abs=5e-3)


def test_a_drift_is_seen() -> None:
    run = Run()
    run.fly(3, lambda x, y, yaw: (x + 0.1 * yaw, y, yaw), frame_id="odom")
    paths = run.measured.paths()
    east, north = np.array(paths["vo"][-1]) - paths["drone: truth"][-1]
    assert (east, north) == pytest.approx((0.0, 0.29), abs=2e-3)


def test_a_long_path_has_no_more_points_than_said() -> None:
    path = Path()
    for stamp in range(0, 1000 * SECOND, 20 * MS):
        if path.due(stamp):
            path.add(stamp, stamp / SECOND, 0.0)
    times = np.array(path.points)[:, 0]
    assert MOST_POINTS / 2 <= len(times) <= MOST_POINTS
    assert times[0] == 0.0
    assert times[-1] > 990
    assert np.diff(times).max() < 2 * np.diff(times).min()


def test_an_image_is_shown_with_the_features_of_its_own_time() -> None:
    run = Run()

    def image(stamp: int, source: str = "drone/front", frame_id: str = "front") -> Image:
        data = np.zeros((4, 4), np.uint8)
        return Image(stamp=stamp, source=source, frame_id=frame_id, encoding="mono8", data=data)

    def features(stamp: int) -> TrackedFeatures:
        points = np.zeros((1, 2), np.float32)
        return TrackedFeatures(
            stamp=stamp, source="vo", frame_id="front", points=points, inliers=np.array([True])
        )

    camera = "drone.images: drone/front"
    run.send(image(0), "drone.images")
    assert run.measured.image(camera)[1] == []
    run.send(features(0))
    for stamp in (1, 2):
        run.send(image(stamp), "drone.images")
    run.send(image(0, "drone/rear", "rear"), "drone.images")
    shown, drawn = run.measured.image(camera)
    assert (shown.stamp, [event.stamp for event in drawn]) == (0, [0])
    assert run.measured.image("drone.images: drone/rear")[1] == []
    for stamp in range(3, 9):
        run.send(image(stamp), "drone.images")
    assert run.measured.image(camera)[0].stamp == 8
    assert run.measured.cameras() == [camera, "drone.images: drone/rear"]
