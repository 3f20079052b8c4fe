"""The nodes around our odometries: when they begin, and what does not end a run."""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
import pytest

from events import DepthImage, Event, Image, PoseEstimate, TrackingLost, VehicleAnnouncement
from nodes.estimators.monocular_odometry import MonocularOdometry
from nodes.estimators.visual_odometry import VisualOdometry
from runtime import Node, Output, Tick, every
from runtime.errors import RefusedError
from runtime.testing import run_nodes, spec
from tests.nodes.estimators.test_estimator import LOOKING_AHEAD, MS, camera, vehicle
from tests.nodes.estimators.visual_odometry.world import INFO, look, pose
from tests.runtime.samples_runs import supervise


def frame(stamp: int, image: Any, depth: Any) -> list[Event]:
    """Return both images of an exposure."""
    of: dict[str, Any] = {
        "stamp": stamp,
        "source": "drone/front",
        "frame_id": "drone/front_optical",
    }
    return [Image(**of, encoding="mono8", data=image), DepthImage(**of, data=depth)]


@functools.cache
def views() -> list[Any]:
    """Return what a camera sees that goes 1 m/s to the right, at 30 Hz."""
    frames = [look(pose(x=k / 30)) for k in range(30)]
    for image, depth in frames:
        image.flags.writeable = depth.flags.writeable = False
    return frames


class Eyes(Node):
    """A vehicle with a camera that moves from the first image on."""

    images = Output(Event)

    def announce(self) -> Any:
        return [vehicle(), camera("drone/front", "grey", "depth", info=INFO, rate=30.0)]

    @every(hz=30)
    def expose(self, tick: Tick) -> None:
        if tick.index < len(views()):
            for event in frame(tick.index * 33 * MS, *views()[tick.index]):
                self.images.send(event)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_the_first_image_is_tracked_on_either_clock(clock: str) -> None:
    """Its pose is the announced one; a tracker that starts late would be off from there on."""
    views()
    outcome = supervise(
        [spec(Eyes, "eyes"), spec(VisualOdometry, "odometry")], clock=clock, duration=1.0
    )
    assert outcome.error is None
    estimates = [event for event in outcome.sent if isinstance(event, PoseEstimate)]
    assert (estimates[0].stamp, estimates[0].frame_id) == (0, "map")
    [start] = [event for event in outcome.sent if isinstance(event, VehicleAnnouncement)]
    # It looks ahead, and east is ahead: what is on its right is south.
    flown = np.array([np.subtract(estimate.position, start.position) for estimate in estimates])
    meant = np.array([[-estimate.stamp / (33 * MS) / 30, 0.0, 0.0] for estimate in estimates])
    assert len(estimates) > (3 if clock == "lockstep" else 0)  # a busy machine skips images
    np.testing.assert_allclose(flown, meant, atol=0.02)


BLACK = np.zeros((INFO.height, INFO.width), np.uint8)
NOWHERE = np.full((INFO.height, INFO.width), np.inf, np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("node", [VisualOdometry, MonocularOdometry])
def test_whatever_it_is_shown_the_run_goes_on(node: type[Node[Any]]) -> None:
    random = np.random.default_rng(1)
    noise = [(random.integers(0, 255, BLACK.shape, np.uint8), NOWHERE) for _ in range(3)]
    shown = [*[(BLACK, NOWHERE)] * 3, *[views()[0]] * 4, *noise, (BLACK, NOWHERE)]
    frames = [event for k, pair in enumerate(shown) for event in frame(k * 33 * MS, *pair)]
    seen = camera("drone/front", "grey", "depth", info=INFO, rate=30.0, orientation=LOOKING_AHEAD)
    result = run_nodes([spec(node, "est")], inputs=[vehicle(), seen, *frames], duration=1.0)
    assert result.reason == "duration"
    estimates = result.of(PoseEstimate)
    if node is MonocularOdometry:
        assert not estimates, "it has never moved"
    else:
        assert [estimate.stamp // MS // 33 for estimate in estimates] == [3, 4, 5, 6]
        assert {estimate.frame_id for estimate in estimates} == {"map"}  # it was not armed
        for estimate in estimates:
            np.testing.assert_allclose(estimate.position, (1, 2, -0.1), atol=0.01)
        assert [event.stamp // MS // 33 for event in result.of(TrackingLost)] == [0, 7]


@pytest.mark.slow
def test_shown_nothing_it_says_nothing() -> None:
    seen = camera("drone/front", "grey", "depth", info=INFO)
    result = run_nodes([spec(VisualOdometry, "est")], inputs=[vehicle(), seen], duration=1.0)
    assert (result.reason, result.of(PoseEstimate)) == ("duration", [])


def test_a_dense_method_that_opencv_4_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "Odometry", raising=False)
    monkeypatch.setattr(cv2, "__version__", "4.10.0")
    seen = camera("drone/front", "grey", "depth", info=INFO)
    with pytest.raises(RefusedError, match=r'"dense" needs OpenCV 5, found 4\.10\.0: pip install'):
        run_nodes([spec(VisualOdometry, "est", {"method": "dense"})], inputs=[vehicle(), seen])
