"""Poses that scripts publish become estimates of the run; what is none is refused."""

from __future__ import annotations

import math
from typing import Any

import pytest

from events import EstimatorAnnouncement, PoseEstimate
from events.frames import angle_between, from_rpy, multiply
from runtime.testing import NodeResult
from tests.sims.airsim.scripts import Caller, RefusedError, Script, drone, with_script

START = (2.0, -1.0)


def pose(*numbers: float) -> dict[str, dict[str, float]]:
    """Return a pose as clients send it: x, y, z, and the quaternion w, x, y, z."""
    x, y, z, w, a, b, c = (*numbers, *(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)[len(numbers) :])
    return {
        "position": {"x_val": x, "y_val": y, "z_val": z},
        "orientation": {"w_val": w, "x_val": a, "y_val": b, "z_val": c},
    }


def published(world: str, script: Script, **estimator: Any) -> NodeResult:
    """Run a script beside a drone that does not start at the origin."""
    settings = {"name": "odometry", **estimator}
    return with_script(script, [drone(world=world, position=START)], estimators=[settings])


def test_a_pose_becomes_an_estimate_of_its_image(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 400_000_000, pose(1, 2, -3))

    result = published(tiny_world, script, method="sparse", scale_free=True, reads=["grey"])
    (estimate,) = result.of(PoseEstimate)
    assert (estimate.stamp, estimate.source, estimate.frame_id) == (400_000_000, "odometry", "odom")
    assert estimate.position == (1.0, 2.0, -3.0)
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.source, said.method, said.scale_free, said.reads) == (
        "odometry", "sparse", True, ("grey",)
    )  # fmt: skip


def test_the_local_frame_becomes_the_map(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 1, pose(1, 2, 0))

    result = published(tiny_world, script, frame_id="map", vehicle="drone")
    (estimate,) = result.of(PoseEstimate)
    assert estimate.frame_id == "map"
    (said,) = result.of(EstimatorAnnouncement)
    assert (estimate.source, said.vehicle) == ("odometry", "drone")
    assert estimate.position[:2] == pytest.approx((START[0] + 1, START[1] + 2))


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (("nobody", 1, pose()), "expected an estimator of the settings (odometry), found 'nobody'"),
        (("odometry", 500_000_001, pose()), "expected a stamp after 5 and up to 500000000 ns"),
        (("odometry", 5, pose()), "expected a stamp after 5 and up to 500000000 ns, found 5"),
        (("odometry", -1, pose()), "expected a stamp after 5"),
        (("odometry", 6, pose(math.nan)), "expected a pose of finite numbers"),
        (("odometry", 6, pose(0, 0, math.inf)), "expected a pose of finite numbers"),
        (("odometry", 6, pose(0, 0, 0, 0)), "whose orientation is a unit quaternion"),
        (("odometry", 6, pose(0, 0, 0, math.nan)), "whose orientation is a unit quaternion"),
        (("odometry", 6, pose(0, 0, 0, 2)), "whose orientation is a unit quaternion"),
        (("odometry", "6", pose()), "Expected `int`, got `str`"),
        (("odometry", 6), "invalid number of arguments. Expected: 3, got: 2"),
    ],
)
def test_what_is_no_estimate_is_refused(
    call: tuple[object, ...], error: str, tiny_world: str
) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.5)
        airsim("visnavPublishPose", "odometry", 5, pose())
        with pytest.raises(RefusedError) as refused:
            airsim("visnavPublishPose", *call)
        assert error in str(refused.value)
        airsim("visnavPublishPose", "odometry", 7, pose())  # what was refused has changed nothing

    assert [e.stamp for e in published(tiny_world, script).of(PoseEstimate)] == [5, 7]


def test_poses_of_a_camera_become_those_of_the_vehicle(tiny_world: str) -> None:
    """Of a camera that looks down from 0.3 m ahead, on a body that has turned by 90°."""
    mount = {"name": "eye", "position": [0.3, 0.0, 0.1], "orientation": [0.0, -90.0, 0.0]}
    body = from_rpy(0.0, 0.0, math.radians(90.0))
    turn = multiply(body, from_rpy(0.0, math.radians(-90.0), 0.0))

    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.1)
        airsim("visnavPublishPose", "odometry", 1, pose(1.0, 2.3, -1.9, *turn))

    with_camera: dict[str, Any] = {
        "estimators": [{"name": "odometry", "camera": "eye"}],
        "cameras": [mount],
    }
    (estimate,) = with_script(script, [drone(world=tiny_world)], **with_camera).of(PoseEstimate)
    assert estimate.position == pytest.approx((1.0, 2.0, -2.0))
    assert angle_between(estimate.orientation, body) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("estimators", "error"),
    [
        ([{"name": "a", "camera": "nowhere"}], "estimators: a: expected a camera of drone"),
        ([{"name": "a", "vehicle": "nobody"}], "estimators: a: .*'nobody' is not available"),
        ([{"name": "a"}, {"name": "a"}], "estimators: expected names of their own"),
    ],
)
def test_an_estimator_of_nothing_is_an_error_of_the_file(
    estimators: list[dict[str, str]], error: str, tiny_world: str
) -> None:
    with pytest.raises(Exception, match=error):
        with_script(lambda _: None, [drone(world=tiny_world)], estimators=estimators)
