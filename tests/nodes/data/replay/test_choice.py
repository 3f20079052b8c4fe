"""Which events of a recording are sent again."""

from __future__ import annotations

import pytest

from events import (
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    Imu,
    Landed,
    Odometry,
    PlannedPose,
    PoseEstimate,
    Score,
    VehicleAnnouncement,
)
from nodes.data.replay.reader import Choice
from tests.nodes.data.recorder.samples import announcements

SAID: list[tuple[type[Event], str]] = [
    (Image, "drone/front"),
    (DepthImage, "drone/front"),
    (Image, "drone/down"),
    (Imu, "drone/imu"),
    (Odometry, "drone"),
    (Landed, "drone"),
    (PlannedPose, "tour"),
    (PoseEstimate, "odometry"),
    (Odometry, "odometry"),
    (Score, "judge"),
]


def wanted(*only: str, skip: tuple[str, ...] = ()) -> list[int]:
    choice = Choice(only, skip, announcements())  # type: ignore[arg-type]
    return [n for n, (kind, source) in enumerate(SAID) if choice(kind, source)]


def test_what_a_simulator_says_is_wanted() -> None:
    """Sensors, truth and the vehicle; no pilot, no judge, nothing of an estimator's."""
    assert wanted() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("only", "skip", "expected"),
    [
        (("drone/front",), (), [0, 1]),
        (("Image",), (), [0, 2]),
        (("Image", "drone/front"), (), [0]),
        (("Image", "Imu"), (), [0, 2, 3]),
        (("VehicleEvent",), (), [5]),
        (("Event",), (), list(range(10))),
        (("drone/fro",), (), []),
        ((), ("drone/front",), [2, 3, 4, 5]),
        ((), ("Image",), [1, 3, 4, 5]),
        (("Event",), ("Odometry", "judge"), [0, 1, 2, 3, 5, 6, 7]),
    ],
)
def test_types_and_sources_narrow_it(
    only: tuple[str, ...], skip: tuple[str, ...], expected: list[int]
) -> None:
    """One of the types and one of the sources, and none of those to skip."""
    assert wanted(*only, skip=skip) == expected


def test_names_that_nothing_has_are_known() -> None:
    """They may be mistyped."""
    choice = Choice(("Image", "dron"), ("Scores",), ())
    for kind, source in SAID:
        choice(kind, source)
    assert choice.unmatched == {"dron", "Scores"}


def test_estimators_are_announced_only_if_they_will_speak() -> None:
    """An evaluation would wait for them in vain."""

    def kinds(*only: str, skip: tuple[str, ...] = ()) -> set[type[Event]]:
        choice = Choice(only, skip, announcements())  # type: ignore[arg-type]
        return {type(a) for a in announcements() if choice.announced(a)}  # type: ignore[arg-type]

    assert EstimatorAnnouncement not in kinds()
    assert VehicleAnnouncement in kinds("drone/front")
    assert EstimatorAnnouncement in kinds("Event")
    assert CameraAnnouncement not in kinds(skip=("drone/front",))
