"""What all estimators share: choosing a camera, poses of the body, being lost and found."""

from __future__ import annotations

import math
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    PoseEstimate,
    TrackedFeatures,
    TrackingLost,
    TrackingRegained,
    VehicleAnnouncement,
)
from nodes.estimation import Estimator, RgbdFrame, pose_matrix, pose_tuples
from runtime import Bundle
from runtime.errors import NodeError, RefusedError
from runtime.testing import NodeResult, run_nodes, spec

LOOKING_AHEAD = (0.5, 0.5, 0.5, 0.5)
"""Optical axes right, down, forward to body axes forward, right, down."""
INFO = CameraInfo.from_fov(8, 6, math.pi / 2)


class Said(msgspec.Struct):
    pose: npt.NDArray[np.float64]
    lost: bool = False
    reason: str = ""
    points: npt.NDArray[np.float32] = np.zeros((0, 2), np.float32)
    inliers: npt.NDArray[np.bool_] = np.zeros(0, np.bool_)


class Scripted(Estimator):
    """Moves a metre along its optical axis with each picture; a dark picture is not enough."""

    needs = frozenset({"grey", "depth"})
    method = "scripted"
    frames = Bundle(RgbdFrame)

    async def run(self) -> None:
        self.the_camera()
        count = 0
        async for image, _ in self.frames:
            pose = np.eye(4)
            pose[2, 3] = count
            dark = not image.data.any()
            self.publish(image, Said(pose, dark, "dark" if dark else ""))
            count += 1


def camera(source: str, *images: Literal["rgb", "grey", "depth"], **more: Any) -> Event:
    fields: dict[str, Any] = {
        "stamp": 0,
        "source": source,
        "images": images,
        "info": INFO,
        "rate": 10.0,
        "latency": 0.0,
        "frame_id": f"{source}_optical",
        "parent_frame_id": "base_link",
        "position": (0.2, 0.0, 0.0),
        "orientation": LOOKING_AHEAD,
    }
    return CameraAnnouncement(**(fields | more))


def vehicle(source: str = "drone") -> Event:
    return VehicleAnnouncement(
        stamp=0,
        source=source,
        mass=1.0,
        max_thrust=20.0,
        control_rate=400,
        position=(1.0, 2.0, -0.1),
        orientation=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),  # looks east
    )


def picture(stamp: int, source: str = "drone/front", dark: bool = False) -> list[Event]:
    data = np.full((6, 8), 0 if dark else 9, np.uint8)
    depth = np.ones((6, 8), np.float32)
    frame = f"{source}_optical"
    return [
        Image(stamp=stamp, source=source, frame_id=frame, encoding="mono8", data=data),
        DepthImage(stamp=stamp, source=source, frame_id=frame, data=depth),
    ]


def track(*events: Event, inputs: dict[str, str] | None = None, **config: Any) -> NodeResult:
    return run_nodes([spec(Scripted, "est", config, inputs=inputs)], inputs=events, duration=1.0)


def test_the_bodys_pose_is_in_map_from_where_the_vehicle_said_it_stands() -> None:
    frames = [*picture(1), *picture(2)]
    result = track(vehicle(), camera("drone/front", "rgb", "depth"), *frames)
    first, second = result.of(PoseEstimate)
    assert (first.frame_id, first.child_frame_id) == ("map", "base_link")
    np.testing.assert_allclose(first.position, (1.0, 2.0, -0.1), atol=1e-12)
    np.testing.assert_allclose(second.position, (1.0, 3.0, -0.1), atol=1e-12)  # a metre east
    np.testing.assert_allclose(second.orientation, (math.sqrt(0.5), 0, 0, math.sqrt(0.5)))


def test_without_a_vehicle_or_if_asked_it_is_in_odom() -> None:
    cases: list[tuple[list[Event], dict[str, Any]]] = [([], {}), ([vehicle()], {"origin": "start"})]
    for given, config in cases:
        seen = camera("drone/front", "rgb", "depth")
        result = track(*given, seen, *picture(1), *picture(2), **config)
        first, second = result.of(PoseEstimate)
        assert first.frame_id == "odom"
        np.testing.assert_allclose(first.position, (0.0, 0.0, 0.0), atol=1e-12)
        np.testing.assert_allclose(second.position, (1.0, 0.0, 0.0), atol=1e-12)


def test_another_vehicles_place_is_not_taken_for_its_own() -> None:
    seen = camera("other/front", "rgb", "depth")
    result = track(vehicle("drone"), seen, *picture(1, "other/front"))
    assert result.of(PoseEstimate)[0].frame_id == "odom"


def test_the_first_camera_that_gives_what_is_needed_is_read() -> None:
    result = track(
        *(camera("drone/down", "grey"), camera("drone/front", "rgb", "depth")),
        *(camera("drone/rear", "grey", "depth"),),
        *picture(1),
        *picture(1, "drone/rear"),
        *picture(1, "drone/down")[:1],
    )
    assert {event.frame_id for event in result.of(TrackedFeatures)} == {"drone/front_optical"}
    assert len(result.of(PoseEstimate)) == 1


def test_the_file_may_name_another_camera() -> None:
    result = track(
        *(camera("drone/front", "rgb", "depth"), camera("drone/rear", "grey", "depth")),
        *picture(1),
        *picture(1, "drone/rear"),
        inputs={"frames": "drone/rear"},
    )
    assert {event.frame_id for event in result.of(TrackedFeatures)} == {"drone/rear_optical"}


def test_a_named_camera_that_lacks_something_is_refused() -> None:
    with pytest.raises(RefusedError, match="expected a camera with depth, grey images, found none"):
        track(camera("drone/front", "rgb"), inputs={"frames": "drone/front"})


def test_no_camera_at_all_is_an_error_that_says_so() -> None:
    with pytest.raises(NodeError, match="expected a camera with depth, grey images, found none"):
        track(camera("drone/front", "rgb"))


def test_lost_and_regained_are_told_once_and_no_pose_meanwhile() -> None:
    dark = [*picture(2, dark=True), *picture(3, dark=True)]
    result = track(camera("drone/front", "grey", "depth"), *picture(1), *dark, *picture(4))
    assert [(e.stamp, e.reason) for e in result.of(TrackingLost)] == [(2, "dark")]
    assert [e.stamp for e in result.of(TrackingRegained)] == [4]
    assert [e.stamp for e in result.of(PoseEstimate)] == [1, 4]


def test_matrices_and_tuples_are_the_same_pose() -> None:
    pose = ((1.0, -2.0, 3.0), (0.5, -0.5, 0.5, 0.5))
    position, orientation = pose_tuples(pose_matrix(*pose))
    assert position == pytest.approx(pose[0])
    assert orientation == pytest.approx(pose[1])
