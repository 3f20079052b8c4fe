"""What all estimators share: choosing a camera, poses of the body, being lost and found."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import (
    Armed,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    PoseEstimate,
    TakenOff,
    TrackedFeatures,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
    TrajectoryEstimate,
    VehicleAnnouncement,
)
from nodes.estimators import Estimator, RgbdFrame, TrackingResult
from nodes.estimators.rig import check_result
from nodes.judging.evaluation.record import EstimatorRecord
from runtime import Bundle
from runtime.config.reading import find_node
from runtime.errors import ConfigError, NodeError
from runtime.testing import NodeResult, run_nodes, spec

LOOKING_AHEAD = (0.5, 0.5, 0.5, 0.5)
"""Optical axes right, down, forward to body axes forward, right, down."""
MS = 1_000_000
INFO = CameraInfo.from_fov(8, 6, math.pi / 2)


class Scripted(Estimator):
    """Moves a metre along its optical axis with each image; a dark image is not enough."""

    needs = frozenset({"grey", "depth"})
    method = "scripted"
    frames = Bundle(RgbdFrame)

    async def run(self) -> None:
        self.the_camera()
        count = 0
        async for image, _ in self.frames:
            if image.data.max() > 250:
                raise RuntimeError("dazzled")
            pose = np.eye(4)
            pose[2, 3] = count
            dark = not image.data.any()
            self.publish(image, TrackingResult(pose, dark, "dark" if dark else ""))
            count += 1


class ScaleFree(Scripted):
    """Has a unit of length of its own."""

    scale_free = True


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


def vehicle(source: str = "drone", control_rate: float = 400) -> Event:
    return VehicleAnnouncement(
        stamp=0,
        source=source,
        mass=1.0,
        max_thrust=20.0,
        control_rate=control_rate,
        position=(1.0, 2.0, -0.1),
        orientation=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),  # looks east
    )


def rgbd(stamp: int, source: str = "drone/front", dark: bool = False, grey: int = 9) -> list[Event]:
    data = np.full((6, 8), 0 if dark else grey, np.uint8)
    depth = np.ones((6, 8), np.float32)
    frame = f"{source}_optical"
    return [
        Image(stamp=stamp, source=source, frame_id=frame, encoding="mono8", data=data),
        DepthImage(stamp=stamp, source=source, frame_id=frame, data=depth),
    ]


def imu(source: str = "drone/imu") -> Event:
    return ImuAnnouncement(
        stamp=0,
        source=source,
        rate=100.0,
        frame_id="base_link",
        gyroscope_noise_density=0.0,
        gyroscope_random_walk=0.0,
        accelerometer_noise_density=0.0,
        accelerometer_random_walk=0.0,
    )


def sample(stamp: int, source: str = "drone/imu") -> Event:
    rest = {"angular_velocity": (0.0, 0.0, 0.0), "linear_acceleration": (0.0, 0.0, -9.81)}
    return Imu(stamp=stamp, source=source, frame_id="base_link", **rest)


def track(*events: Event, inputs: dict[str, str] | None = None, **config: Any) -> NodeResult:
    return run_nodes([spec(Scripted, "est", config, inputs=inputs)], inputs=events, duration=1.0)


def begin(*events: Event, control_rate: float = 400) -> list[str]:
    """Return the frames in which a vehicle's estimator speaks."""
    seen = camera("drone/front", "rgb", "depth", latency=0.04)
    result = track(vehicle(control_rate=control_rate), seen, *events)
    return [estimate.frame_id for estimate in result.of(PoseEstimate)]


def test_the_bodys_pose_is_in_map_from_where_the_vehicle_said_it_stands() -> None:
    frames = [*rgbd(1), *rgbd(2)]
    result = track(vehicle(), camera("drone/front", "rgb", "depth"), *frames)
    first, second = result.of(PoseEstimate)
    assert (first.frame_id, first.child_frame_id) == ("map", "base_link")
    np.testing.assert_allclose(first.position, (1.0, 2.0, -0.1), atol=1e-12)
    np.testing.assert_allclose(second.position, (1.0, 3.0, -0.1), atol=1e-12)  # a metre east
    np.testing.assert_allclose(second.orientation, (math.sqrt(0.5), 0, 0, math.sqrt(0.5)))


def test_without_a_vehicle_or_if_asked_it_is_in_odom() -> None:
    cases: list[tuple[list[Event], dict[str, Any]]] = [([], {}), ([vehicle()], {"origin": "start"})]
    for said, config in cases:
        seen = camera("drone/front", "rgb", "depth")
        result = track(*said, seen, *rgbd(1), *rgbd(2), **config)
        first, second = result.of(PoseEstimate)
        assert first.frame_id == "odom"
        np.testing.assert_allclose(first.position, (0.0, 0.0, 0.0), atol=1e-12)
        np.testing.assert_allclose(second.position, (1.0, 0.0, 0.0), atol=1e-12)


def armed(stamp: int, source: str = "drone") -> Event:
    return Armed(stamp=stamp, source=source)


def test_a_vehicle_that_takes_commands_stands_where_it_said_until_it_is_armed() -> None:
    late = 500 * MS
    assert begin(*rgbd(late)) == ["map"]
    assert begin(armed(late), *rgbd(late)) == ["map"]
    assert begin(armed(late - 1), *rgbd(late)) == ["odom"]
    assert begin(TakenOff(stamp=late - 1, source="drone"), *rgbd(late)) == ["odom"]
    assert begin(armed(late - 1, "another"), *rgbd(late)) == ["map"]


def test_the_cameras_that_a_file_names_are_announced() -> None:
    seen = camera("drone/front", "rgb", "depth")
    for inputs, cameras in ((None, ()), ({"frames": "drone/front"}, ("drone/front",))):
        (announced,) = track(seen, inputs=inputs).of(EstimatorAnnouncement)
        assert announced.cameras == cameras


def test_an_image_that_shows_too_little_is_no_beginning() -> None:
    """The tracker's poses begin later, when the vehicle is elsewhere."""
    frames = begin(*rgbd(0, dark=True), armed(100 * MS), *rgbd(300 * MS), *rgbd(400 * MS))
    assert frames == ["odom", "odom"]


def test_a_frame_once_chosen_stays() -> None:
    assert begin(*rgbd(0), armed(1), *rgbd(300 * MS), *rgbd(400 * MS)) == ["map"] * 3


@pytest.mark.parametrize(("late", "frame"), [(0, "map"), (140 * MS, "map"), (141 * MS, "odom")])
def test_of_a_recorded_vehicle_the_first_exposure_is_known_only(late: int, frame: str) -> None:
    """A period of the camera's 10 Hz, and its latency: it may move from the start on."""
    assert begin(*rgbd(late), control_rate=0.0) == [frame]


def test_who_does_not_know_the_metre_is_not_in_map() -> None:
    seen = camera("drone/front", "rgb", "depth")
    result = run_nodes([spec(ScaleFree, "est")], inputs=[vehicle(), seen, *rgbd(1)])
    assert [estimate.frame_id for estimate in result.of(PoseEstimate)] == ["odom"]


def test_after_a_restart_it_is_in_a_frame_of_its_own_and_says_so() -> None:
    """Brought up in mid-flight, it would say that the vehicle stands at the start."""
    dazzling = [rgbd(at * MS, grey=255) for at in (100, 1500)]
    frames = [
        *rgbd(0),
        *dazzling[0],
        *rgbd(900 * MS),
        *dazzling[1],
        *rgbd(3000 * MS),
    ]
    result = run_nodes(
        [spec(Scripted, "est", on_error="restart")],
        inputs=[vehicle(), camera("drone/front", "rgb", "depth"), *frames, *rgbd(3100 * MS)],
        duration=4.0,
    )
    assert [(e.stamp // MS, e.frame_id) for e in result.of(PoseEstimate)] == [
        *[(0, "map"), (900, "odom_1"), (3000, "odom_2"), (3100, "odom_2")]
    ]
    told = [(e.stamp // MS, type(e)) for e in result.sent if isinstance(e, TrackingEvent)]
    assert told == [
        *[(900, TrackingLost), (900, TrackingRegained)],
        *[(3000, TrackingLost), (3000, TrackingRegained)],
    ]
    assert result.of(TrackingLost)[0].reason == "restarted: poses are in odom_1 from here on"


class Mapping(Scripted):
    """Begins another map at a guessed pose with each brighter image."""

    async def run(self) -> None:
        async for image, _ in self.frames:
            number = int(image.data.max()) - 9
            self.publish(image, TrackingResult(np.eye(4), map=number))

    async def on_end(self) -> None:
        self.publish_trajectory(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1)), 2)


def test_each_map_at_a_guessed_pose_has_a_frame_of_its_own_and_counts_as_a_restart() -> None:
    shown = [(1, 9), (2, 9), (3, 11), (4, 9), (5, 11), (6, 12)]
    frames = [event for stamp, grey in shown for event in rgbd(stamp, grey=grey)]
    seen = camera("drone/front", "rgb", "depth")
    result = run_nodes([spec(Mapping, "est")], inputs=[vehicle(), seen, *frames], duration=1.0)
    estimates = result.of(PoseEstimate)
    expected = ["map", "map", "odom_1", "map", "odom_1", "odom_2"]
    assert [estimate.frame_id for estimate in estimates] == expected
    changes = [3, 4, 5, 6]
    assert [event.stamp for event in result.of(TrackingLost)] == changes
    assert [event.stamp for event in result.of(TrackingRegained)] == changes
    record = EstimatorRecord()
    assert [record.add(estimate, None) for estimate in estimates] == [f == "map" for f in expected]
    assert record.restarts == 3
    assert [trajectory.frame_id for trajectory in result.of(TrajectoryEstimate)] == ["odom_1"]


def test_a_frame_of_before_a_restart_is_no_frame_of_another_map() -> None:
    class Crashes(Mapping):
        def publish(self, image: Any, result: TrackingResult, origin: int | None = None) -> None:
            super().publish(image, result, origin)
            if image.stamp == 2:
                raise RuntimeError("dazzled")

    frames = [e for at, grey in [(1, 9), (2, 11), (900 * MS, 9)] for e in rgbd(at, grey=grey)]
    result = run_nodes(
        [spec(Crashes, "est", {"latency": 0}, on_error="restart")],
        inputs=[vehicle(), camera("drone/front", "rgb", "depth"), *frames],
        duration=1.0,
    )
    assert [e.frame_id for e in result.of(PoseEstimate)] == ["map", "odom_1", "odom_2"]


def pose(change: tuple[Any, Any] | None = None, factor: float = 1.0) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3] *= factor
    if change is not None:
        matrix[change[0]] = change[1]
    return matrix


class Giving(Scripted):
    """Gives good poses, but for one at 2 ms."""

    bad: Any = None

    async def run(self) -> None:
        async for image, _ in self.frames:
            good = TrackingResult(np.eye(4))
            self.publish(image, self.bad if image.stamp == 2 * MS else good)


def giving(bad: Any, **config: Any) -> NodeResult:
    node = type("Bad", (Giving,), {"bad": bad})
    frames = [event for stamp in (1, 2, 3) for event in rgbd(stamp * MS)]
    given = [camera("drone/front", "rgb", "depth"), *frames]
    return run_nodes([spec(node, "est", config)], inputs=given, duration=1.0)


NOT_FINITE = TrackingResult(pose(((0, 3), math.nan)))


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (None, "expected a TrackingResult, found None"),
        (np.eye(4), "expected a TrackingResult, found shape (4, 4) of float64"),
        (TrackingResult(None), "pose: * of shape (4, 4), found None"),  # type: ignore[arg-type]
        (TrackingResult([[1.0]]), "pose: * of shape (4, 4), found a list"),  # type: ignore[arg-type]
        (TrackingResult(np.eye(3)), "pose: * shape (4, 4), found shape (3, 3) of float64"),
        (TrackingResult(np.eye(4, dtype=object)), "pose: * found shape (4, 4) of object"),
        (NOT_FINITE, "pose: expected finite numbers, found nan"),
        (TrackingResult(pose(factor=2.0)), "pose[:3, :3]: expected a rotation * length 2, 2, 2, *"),
        (TrackingResult(pose(factor=-1.0)), "pose[:3, :3]: * determinant -1"),
        (TrackingResult(pose((3, 1.0))), "pose[3]: expected 0, 0, 0, 1, found *"),
        (TrackingResult(pose(), velocity=np.eye(3)), "velocity: * (3,), found shape (3, 3) *"),
        (TrackingResult(pose(), covariance=np.eye(3)), "covariance: * (6, 6), found shape (3, 3)*"),
    ],
)
def test_what_is_no_pose_is_said_in_a_line(bad: Any, says: str) -> None:
    try:
        message = check_result(bad)
    except ValueError as error:
        message = str(error)
    assert re.fullmatch(re.escape(says).replace(r"\*", ".*"), message), message


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (None, "expected a TrackingResult, found None"),
        (NOT_FINITE, 'pose: expected finite numbers, found nan (not_finite = "lost" *'),
    ],
)
def test_what_is_no_pose_ends_the_run_with_its_time(bad: Any, says: str) -> None:
    with pytest.raises(NodeError) as caught:
        giving(bad)
    pattern = re.escape(f"est: pose at 0.002 s: {says}").replace(r"\*", ".*")
    assert re.fullmatch(pattern, str(caught.value)), str(caught.value)


def test_a_pose_that_is_not_finite_may_count_as_lost() -> None:
    result = giving(NOT_FINITE, not_finite="lost")
    assert [estimate.stamp // MS for estimate in result.of(PoseEstimate)] == [1, 3]
    (lost,) = result.of(TrackingLost)
    assert (lost.stamp, lost.reason) == (2 * MS, "pose: expected finite numbers, found nan")


def test_a_final_trajectory_that_is_none_is_refused() -> None:
    class Ends(Giving):
        async def on_end(self) -> None:
            self.publish_trajectory(np.array([1, 2 * MS]), np.stack([np.eye(4), pose(factor=2.0)]))

    with pytest.raises(NodeError, match=r"est: final trajectory: pose at 0.002 s\[:3, :3\]: exp"):
        run_nodes(
            [spec(Ends, "est")],
            inputs=[camera("drone/front", "rgb", "depth"), *rgbd(1)],
            duration=1.0,
        )


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("needs = {'grey'}", "{name}:B: expected `async def run` in it, found none"),
        ("def run(self): pass", "{name}: B.run: expected `async def run`, found `def run` ({line}"),
        ("needs = {'gray'}", "{name}: B.needs: expected a set of rgb, grey, depth, segmentation, "
         "lidar, found 'gray' (did you mean 'grey'?) ({line}"),
        ("needs = 'grey'", "{name}: B.needs: expected a set of rgb, grey, depth, segmentation, "
         "lidar, found 'grey' ({line}"),
    ],
)  # fmt: skip
def test_a_class_that_is_no_estimator_is_a_line_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, says: str
) -> None:
    name = f"wrong_{abs(hash(body))}"
    text = f"from nodes.estimators import Estimator\n\n\nclass B(Estimator):\n    {body}\n"
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as caught:
        find_node(f"{name}:B", "c.toml: nodes[0] (b)")
    line = f"{tmp_path / name}.py, line 4)"
    assert str(caught.value) == f"c.toml: nodes[0] (b): {says.format(name=name, line=line)}"


def test_another_vehicles_place_is_not_taken_for_its_own() -> None:
    seen = camera("other/front", "rgb", "depth")
    result = track(vehicle("drone"), seen, *rgbd(1, "other/front"))
    assert result.of(PoseEstimate)[0].frame_id == "odom"


def test_lost_and_regained_are_told_once_and_no_pose_meanwhile() -> None:
    dark = [*rgbd(2, dark=True), *rgbd(3, dark=True)]
    result = track(camera("drone/front", "grey", "depth"), *rgbd(1), *dark, *rgbd(4))
    assert [(e.stamp, e.reason) for e in result.of(TrackingLost)] == [(2, "dark")]
    assert [e.stamp for e in result.of(TrackingRegained)] == [4]
    assert [e.stamp for e in result.of(PoseEstimate)] == [1, 4]


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(1, 400), st.sampled_from(("lit", "dark", "dazzling")))),
    st.integers(0, 2000),
    st.sampled_from((0.0, 400.0)),
)
def test_whatever_happens_an_estimate_in_map_is_true(
    shown: list[tuple[int, str]], moves: int, control_rate: float
) -> None:
    """From when it is armed on, the vehicle flies east at 1 m/s; images come at any time."""
    flown = {}
    events: list[Event] = [Armed(stamp=moves * MS, source="drone")] if control_rate else []
    at = 0
    for gap, kind in shown:
        at += gap
        flown[at * MS] = max(at - (moves if control_rate else 0), 0) / 1000
        grey = {"lit": 9, "dark": 0, "dazzling": 255}[kind]
        events += rgbd(at * MS, grey=grey)
    events.sort(key=lambda event: event.stamp)

    class Ideal(Scripted):
        async def run(self) -> None:
            first = None
            async for image, _ in self.frames:
                if image.data.max() > 250:
                    raise RuntimeError("dazzled")
                pose = np.eye(4)
                if image.data.any():
                    first = flown[image.stamp] if first is None else first
                    pose[2, 3] = flown[image.stamp] - first
                self.publish(image, TrackingResult(pose, lost=not image.data.any()))

    seen = camera("drone/front", "rgb", "depth", rate=100.0)
    result = run_nodes(
        [spec(Ideal, "est", on_error="restart")],
        inputs=[vehicle(control_rate=control_rate), seen, *events],
        duration=at / 1000 + 1,
    )
    frames: list[str] = []
    for estimate in result.of(PoseEstimate):
        if estimate.frame_id == "map":
            off = estimate.position[1] - 2.0 - flown[estimate.stamp]
            assert abs(off) < 1e-9 if control_rate else abs(off) <= 0.01 + 1e-9
        if estimate.frame_id not in frames[-1:]:
            frames.append(estimate.frame_id)
    assert len(set(frames)) == len(frames), "none is taken up again"


def test_estimates_are_on_the_clock_of_the_imu() -> None:
    """The announced offset of the camera's clock is taken off; features keep the image's stamp."""
    seen = camera("drone/front", "rgb", "depth", time_offset=0.03)
    result = track(vehicle(), seen, *rgbd(100 * MS), *rgbd(200 * MS, dark=True))
    assert [estimate.stamp for estimate in result.of(PoseEstimate)] == [70 * MS]
    assert [event.stamp for event in result.of(TrackingLost)] == [170 * MS]
    assert [features.stamp for features in result.of(TrackedFeatures)] == [100 * MS, 200 * MS]
