"""Monocular odometry as a node, on images of a small world."""

from __future__ import annotations

import math

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
from nodes.estimators.monocular_odometry import MonocularOdometry
from runtime.errors import ConfigError
from runtime.testing import run_node
from tests.nodes.estimators.monocular_odometry.world import INFO, Grey, look, pose

FRAME = 50_000_000


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
        stamp=(number + 1) * FRAME,
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
    assert [each.stamp for each in features] == [each.stamp for each in estimates] + [last]
    assert estimates[0].stamp == events[18 - len(estimates)].stamp
    assert [each.stamp for each in result.of(TrackingLost)] == [last]
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
