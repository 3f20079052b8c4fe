"""The closed loop when its estimator fails in mid-flight: nobody flies on what it does not know."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    CameraInfo,
    Image,
    Landed,
    Odometry,
    PoseEstimate,
    TrackingLost,
    TrackingRegained,
)
from events.geometry import pose_matrix
from nodes.estimators import Estimator, TrackingResult
from nodes.pilots import VisualPilot
from runtime import Input
from runtime.testing import NodeResult, run_nodes, spec
from sims.multirotor import Multirotor

SECOND = 1_000_000_000
FAILS = 6.0
FLOOR = """<mujoco><worldbody>
  <light pos="0 0 4"/><geom name="floor" type="plane" size="9 9 1"/>
</worldbody></mujoco>"""


class Ideal(Estimator):
    """Follows the truth from where it begins, as a tracker of images would; raises once."""

    truth = Input(Odometry, keep="latest")
    cameras = (
        CameraAnnouncement(
            stamp=0,
            source="drone/camera",
            images=("grey",),
            info=CameraInfo.from_fov(8, 6, math.pi / 2),
            rate=200.0,
            latency=0.0,
            frame_id="camera",
            parent_frame_id="base_link",
            position=(0.0, 0.0, 0.0),
            orientation=(1.0, 0.0, 0.0, 0.0),
        ),
    )

    def check(self) -> Iterable[str]:
        """Lack nothing: its camera is made up."""
        return ()

    async def run(self) -> None:
        first = None
        async for event in self.truth:
            if self.restarts == 0 and event.stamp > FAILS * SECOND:
                raise RuntimeError("out of order")
            body = pose_matrix(event.position, event.orientation)
            first = np.linalg.inv(body) if first is None else first
            image = Image(
                stamp=event.stamp,
                source="drone/camera",
                frame_id="camera",
                encoding="mono8",
                data=np.zeros((6, 8), np.uint8),
            )
            self.send_result(image, TrackingResult(first @ body))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> NodeResult:
    world: Path = tmp_path_factory.mktemp("world") / "floor.xml"
    world.write_text(FLOOR)
    pilot = {"waypoints": [[0, 0, -1.5], [8.0, 0.0, -1.5]], "speed": 0.9, "landing_timeout": "4s"}
    return run_nodes(
        [
            spec(Multirotor, "drone", {"world": str(world), "position": [0.5, 1.0]}),
            spec(Ideal, "odometry", on_error="restart"),
            spec(VisualPilot, "pilot", pilot),
        ],
        duration=30,
    )


@pytest.mark.slow
def test_a_restarted_estimator_speaks_in_a_frame_that_begins_where_it_is(
    flight: NodeResult,
) -> None:
    estimates = flight.of(PoseEstimate)
    assert list(dict.fromkeys(estimate.frame_id for estimate in estimates)) == ["map", "odom_1"]
    first = next(estimate for estimate in estimates if estimate.frame_id == "odom_1")
    assert math.dist(first.position, (0, 0, 0)) < 1e-9
    assert [event.stamp for event in flight.of(TrackingLost)] == [first.stamp]
    assert [event.stamp for event in flight.of(TrackingRegained)] == [first.stamp]


@pytest.mark.slow
def test_the_vehicle_stays_where_it_was_and_lands(flight: NodeResult) -> None:
    assert flight.reason == "pilot: no estimate in map for 4 s: landed"
    assert len(flight.of(Landed)) == 1
    flown = [e.position for e in flight.of(Odometry) if e.stamp > FAILS * SECOND]
    far = max(math.dist(place[:2], flown[0][:2]) for place in flown)
    assert far < 1.0, "it brakes from 0.9 m/s after half a second without estimates, and stays"
