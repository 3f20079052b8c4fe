"""Which sensors an estimator reads: what fits it, what the file names, what is refused."""

from __future__ import annotations

import logging
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    Announcement,
    CameraInfo,
    EstimatorAnnouncement,
    Event,
    Image,
    PoseEstimate,
    TrackedFeatures,
    TrajectoryEstimate,
)
from events.camera_info import COEFFICIENTS
from nodes.estimators import Estimator, StereoInertialFrame, TrackingResult
from nodes.estimators.inertial_odometry import RgbdInertialOdometry, StereoInertialOdometry
from nodes.estimators.monocular_odometry import MonocularOdometry
from nodes.estimators.rig import SensorChoice
from nodes.estimators.visual_odometry import VisualOdometry
from nodes.estimators.visual_odometry.node import StereoOdometry
from nodes.outside.process import Process
from runtime import Bundle, Input, on
from runtime.errors import NodeError, RefusedError
from runtime.testing import run_nodes, spec
from tests.nodes.estimators.conformance import lenses_of
from tests.nodes.estimators.test_estimator import (
    INFO,
    MS,
    Scripted,
    camera,
    imu,
    rgbd,
    sample,
    track,
    vehicle,
)


def test_the_first_camera_that_gives_what_is_needed_is_read() -> None:
    result = track(
        *(camera("drone/down", "grey"), camera("drone/front", "rgb", "depth")),
        *(camera("drone/rear", "grey", "depth"),),
        *rgbd(1),
        *rgbd(1, "drone/rear"),
        *rgbd(1, "drone/down")[:1],
    )
    assert {event.frame_id for event in result.of(TrackedFeatures)} == {"drone/front_optical"}
    assert len(result.of(PoseEstimate)) == 1


def test_the_file_may_name_another_camera() -> None:
    result = track(
        *(camera("drone/front", "rgb", "depth"), camera("drone/rear", "grey", "depth")),
        *rgbd(1),
        *rgbd(1, "drone/rear"),
        inputs={"frames": "drone/rear"},
    )
    assert {event.frame_id for event in result.of(TrackedFeatures)} == {"drone/rear_optical"}


def test_a_named_camera_that_lacks_something_is_refused() -> None:
    with pytest.raises(RefusedError, match="expected a camera with depth, grey images, found none"):
        track(camera("drone/front", "rgb"), inputs={"frames": "drone/front"})


def test_no_camera_at_all_is_an_error_that_says_so() -> None:
    with pytest.raises(
        NodeError, match="expected a camera with depth, grey images, found drone/front"
    ):
        track(camera("drone/front", "rgb"))


class PinholeOnly(Scripted):
    """Cannot compute with a lens."""

    lenses = frozenset()


BARREL = CameraInfo(
    width=8, height=6, fx=4.0, fy=4.0, cx=3.5, cy=2.5, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0)
)
FISHEYE = CameraInfo(
    width=8, height=6, fx=4.0, fy=4.0, cx=3.5, cy=2.5,
    distortion_model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0),
)  # fmt: skip


@pytest.mark.parametrize(
    ("info", "message", "inputs"),
    [
        (BARREL, "plumb_bob with -0.2, 0.05, 0", None),
        (FISHEYE, "equidistant with 0, 0, 0, 0", {"frames": "drone/front"}),
    ],
)
def test_a_lens_that_it_cannot_compute_with_is_refused(
    info: CameraInfo, message: str, inputs: dict[str, str] | None
) -> None:
    """In a sentence, with what was found and how to help; the file may name the camera or not."""
    seen = camera("drone/front", "rgb", "depth", info=info)
    refused = [spec(PinholeOnly, "est", {"rectify": False}, inputs=inputs)]
    with pytest.raises(NodeError, match=rf"drone/front: expected images without.*{message}"):
        run_nodes(refused, inputs=[seen], duration=1.0)
    assert track(vehicle(), seen, *rgbd(1)).of(PoseEstimate)  # others can


def test_the_undistorted_twin_is_taken_where_there_is_one() -> None:
    """It is announced after the camera's own images."""
    own = camera("drone/front", "rgb", "depth", info=BARREL)
    twin = camera("drone/front/undistorted", "rgb", "depth", undistorted="drone/front")
    frames = [*rgbd(1), *rgbd(1, "drone/front/undistorted")]
    nodes = [spec(PinholeOnly, "est")]
    result = run_nodes(nodes, inputs=[vehicle(), own, twin, *frames], duration=1.0)
    (features,) = result.of(TrackedFeatures)
    assert features.frame_id == "drone/front/undistorted_optical"


class StereoInertial(Estimator):
    """Moves a metre with each pair of images, and knows its velocity and how sure it is."""

    needs = frozenset({"grey"})
    eyes = 2
    inertial = True
    frames = Bundle(StereoInertialFrame)

    async def run(self) -> None:
        async for left, _, samples in self.frames:
            assert len(samples) == 1
            pose = np.eye(4)
            pose[2, 3] = left.stamp / MS
            velocity = np.array([0.0, 0.0, 1.0])
            covariance = np.diag([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
            self.publish(left, TrackingResult(pose, velocity=velocity, covariance=covariance))

    async def on_end(self) -> None:
        self.publish_trajectory(np.array([MS, 2 * MS]), np.stack([np.eye(4)] * 2))


def rig(name: str) -> list[Event]:
    left, right = f"{name}_left", f"{name}_right"
    return [camera(right, "grey", stereo=left, baseline=0.1), camera(left, "grey")]


def test_a_stereo_rig_and_the_imu_of_its_vehicle_are_chosen() -> None:
    others = [imu("other/imu"), camera("drone/mono", "grey")]
    flown = [
        event
        for k in (1, 2)
        for event in (
            sample(k * MS, "other/imu"),
            sample(k * MS),
            *(rgbd(k * MS, f"drone/{eye}")[0] for eye in ("mono", "eye_left", "eye_right")),
        )
    ]
    result = run_nodes(
        [spec(StereoInertial, "est")],
        inputs=[vehicle(), *others, *rig("drone/eye"), imu(), *flown],
        duration=1.0,
    )
    (said,) = (e for e in result.sent if isinstance(e, EstimatorAnnouncement))
    assert (said.reads, said.eyes) == (("grey", "imu"), 2)
    estimates = result.of(PoseEstimate)
    assert [e.stamp for e in estimates] == [MS, 2 * MS]
    np.testing.assert_allclose(estimates[1].position, (1.0, 4.0, -0.1), atol=1e-9)  # it looks east
    assert estimates[1].velocity == pytest.approx((0.0, 1.0, 0.0))
    variances = np.reshape(estimates[1].covariance, (6, 6)).diagonal()
    np.testing.assert_allclose(variances, (1.0, 3.0, 2.0, 0, 0, 0), atol=1e-9)
    (final,) = result.of(TrajectoryEstimate)
    assert final.stamps.tolist() == [MS, 2 * MS]
    np.testing.assert_allclose(final.positions, [(1.0, 2.0, -0.1)] * 2, atol=1e-9)


@pytest.mark.parametrize(
    ("announced", "expected"),
    [
        ([camera("drone/mono", "grey"), imu()], "expected a stereo rig with grey images, found"),
        ([*rig("drone/eye")], "expected an IMU beside drone/eye_left, found none"),
        ([*rig("drone/eye"), imu("other/imu")], "beside drone/eye_left, found other/imu"),
    ],
)
def test_what_is_missing_of_a_rig_is_named(announced: list[Event], expected: str) -> None:
    choice = SensorChoice({"grey"}, 2, True, {}, lambda _, __: {})
    for announcement in announced:
        assert isinstance(announcement, Announcement)
        choice.announced(announcement)
    assert expected in choice.missing()


def test_the_file_may_name_both_cameras() -> None:
    named = {"frames.left": "drone/b", "frames.right": "drone/a", "frames.imu": "drone/imu2"}
    announced = [camera("drone/a", "grey"), camera("drone/b", "grey"), imu(), imu("drone/imu2")]
    flown = [sample(MS, "drone/imu2"), rgbd(MS, "drone/a")[0], rgbd(MS, "drone/b")[0]]
    nodes = [spec(StereoInertial, "est", inputs=named)]
    result = run_nodes(nodes, inputs=[*announced, *flown], duration=1.0)
    assert len(result.of(PoseEstimate)) == 1


def test_a_class_that_says_nothing_of_lenses_reads_a_pinhole_and_the_log_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    given: list[CameraInfo] = []

    class Asks(Scripted):
        async def run(self) -> None:
            async for image, _ in self.frames:
                given.append(self.the_camera().info)
                self.publish(image, TrackingResult(np.eye(4)))

    caplog.set_level(logging.INFO, "visnav")
    seen = camera("drone/front", "rgb", "depth", info=BARREL)
    result = run_nodes([spec(Asks, "est")], inputs=[seen, *rgbd(1)], duration=1.0)
    (said,) = result.of(EstimatorAnnouncement)
    assert (said.lenses, said.rectifies) == ((), True)
    assert [info.is_pinhole for info in given] == [True]
    focal = f"{given[0].fx:.1f}"
    (line,) = (r.getMessage() for r in caplog.records if "rectified" in r.getMessage())
    assert line.startswith(
        "drone/front is rectified: plumb_bob with -0.2, 0.05, 0, 0, 0 to pinhole, focal length "
        f"{focal} px, "
    )


def test_images_read_in_a_handler_are_not_taken_for_rectified_ones() -> None:
    class Handles(Estimator):
        needs = frozenset({"grey"})

        @on(Image)
        def images(self, image: Image) -> None: ...

        async def run(self) -> None: ...

    seen = [camera("drone/front", "grey", info=info) for info in (BARREL, INFO)]
    with pytest.raises(RefusedError, match=r"expected images read from a Bundle .* plumb_bob with"):
        run_nodes([spec(Handles, "est")], inputs=seen[:1], duration=0.1)
    run_nodes([spec(Handles, "est")], inputs=seen[1:], duration=0.1)


def test_a_stream_of_single_images_is_rectified_too() -> None:
    corners: list[int] = []

    class Single(Estimator):
        needs = frozenset({"grey"})
        images = Input(Image)

        async def run(self) -> None:
            image = await self.images.receive()
            corners.append(int(image.data[0, 0]))

    seen = camera("drone/front", "grey", info=BARREL)
    data = np.full((6, 8), 9, np.uint8)
    data[0, 0] = 200  # the corner is cut off
    image = msgspec.structs.replace(rgbd(1)[0], data=data)
    run_nodes([spec(Single, "est")], inputs=[seen, image], duration=0.1)
    assert len(corners) == 1
    assert corners[0] < 200


@pytest.mark.parametrize(
    ("node", "settings", "lenses"),
    [
        (VisualOdometry, {}, set()),
        (StereoOdometry, {}, set()),
        (RgbdInertialOdometry, {}, set()),
        (StereoInertialOdometry, {}, set()),
        (MonocularOdometry, {}, set()),
        (Process, {"command": ["slam"]}, set(COEFFICIENTS)),
    ],
)
def test_each_of_ours_says_which_lenses_it_knows(
    node: type[Estimator[Any]], settings: dict[str, Any], lenses: set[str]
) -> None:
    assert lenses_of(node, settings) == lenses
