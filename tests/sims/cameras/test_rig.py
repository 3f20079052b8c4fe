"""When images arrive, which are lost, and what else a simulator says of its cameras."""

from __future__ import annotations

import logging
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    Imu,
    Odometry,
    PoseStamped,
    PositionSetpoint,
    Takeoff,
    TransformStamped,
    VelocitySetpoint,
)
from events.geometry import pose_matrix
from runtime import Node, Output, on
from runtime.errors import ConfigError
from runtime.testing import NodeResult, run_node, run_nodes, spec
from runtime.units import Latency
from sims.cameras import CameraSpec, optical_in_body
from sims.cameras.renderer import delay_of
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor

pytestmark = pytest.mark.slow

MS = 1_000_000
PERIOD = 40 * MS

WORLD = """<mujoco><worldbody>
  <light pos="0 0 4"/><geom type="plane" size="9 9 1"/><geom type="box" size="1 1 1" pos="3 0 0"/>
</worldbody></mujoco>"""

SPOILT = CameraSpec(name="c", latency=Latency(0.04), jitter=Latency(0.09), loss=0.3)
TINY = {"width": 16, "height": 12}


class Arrival(Event):
    """Something of a stamp came, at `stamp`."""

    what: str
    of: int


class Listener(Node):
    arrivals = Output(Arrival)

    @on(Image, DepthImage, PoseStamped)
    def came(self, event: Event) -> None:
        self.arrivals.send(
            Arrival(
                stamp=self.clock.now(), source=self.name, what=type(event).__name__, of=event.stamp
            )
        )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    return str(path)


def watch(world: str, processes: int = 1, **camera: Any) -> NodeResult:
    """Run a free camera of 25 Hz for two seconds, and note what comes when."""
    config = {
        "world": world,
        "rate": 25,
        "camera_processes": processes,
        "cameras": [{"name": "c"} | TINY | camera],
    }
    nodes = [spec(FreeCamera, "free", config), spec(Listener, "listener")]
    return run_nodes(nodes, duration=2.0, seed=4)


def arrivals(result: NodeResult, what: str = "Image") -> dict[int, int]:
    """Stamp to time of arrival."""
    return {e.of: e.stamp for e in result.of(Arrival) if e.what == what}


def test_delays_are_spread_evenly_over_the_jitter() -> None:
    """As many exposures are lost as is asked for; the same seed loses the same."""
    drawn = [delay_of(SPOILT, 1, k * 33 * MS) for k in range(4000)]
    delays = [delay for delay in drawn if delay is not None]
    assert 1.0 - len(delays) / len(drawn) == pytest.approx(0.3, abs=0.03)
    assert 0.04 <= min(delays) < 0.041
    assert 0.129 < max(delays) <= 0.13
    assert np.mean(delays) == pytest.approx(0.085, abs=0.002)
    assert np.std(delays) == pytest.approx(0.09 / 12**0.5, rel=0.03)
    assert drawn == [delay_of(SPOILT, 1, k * 33 * MS) for k in range(4000)]
    assert drawn != [delay_of(SPOILT, 2, k * 33 * MS) for k in range(4000)]


def test_loss_and_jitter_do_not_depend_on_each_other() -> None:
    """Of a camera that loses images, the others come when they would have come anyway."""
    whole = msgspec.structs.replace(SPOILT, loss=0.0)
    prompt = msgspec.structs.replace(SPOILT, jitter=Latency(0))
    for stamp in range(0, 100 * PERIOD, PERIOD):
        delay = delay_of(SPOILT, 1, stamp)
        assert delay in (None, delay_of(whole, 1, stamp))
        assert (delay is None) == (delay_of(prompt, 1, stamp) is None)


@pytest.mark.slow
def test_jitter_delays_and_keeps_the_order(world: str) -> None:
    """Each image comes at its own time, or with the one before it if that is later; and the
    same whether one process renders quickly or two slowly."""
    result = watch(world, latency="40ms", jitter="90ms")
    came = arrivals(result)
    assert list(came) == sorted(came)
    times = list(came.values())
    assert times == sorted(times)
    late = [time - stamp for stamp, time in came.items()]
    assert min(late) >= 40 * MS
    assert max(late) <= 130 * MS
    assert len(set(late)) > 30
    assert sum(b == a for a, b in pairwise(times)) >= 3  # some did wait for the one before
    assert set(came) == {k * PERIOD for k in range(len(came))}
    assert len(came) >= 46
    slow = watch(world, processes=2, latency="40ms", jitter="90ms", render_time="20ms")
    assert slow.of(Arrival) == result.of(Arrival)
    assert slow.of(PoseStamped) == result.of(PoseStamped)
    for one, other in zip(slow.of(Image), result.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)


@pytest.mark.slow
def test_a_lost_exposure_gives_nothing(world: str, caplog: pytest.LogCaptureFixture) -> None:
    """Neither image nor depth nor pose; the others come in time; and the log says how many."""
    caplog.set_level(logging.INFO, "visnav.free")
    came = watch(world, latency="40ms", loss=0.4)
    stamps = set(arrivals(came))
    assert 18 <= len(stamps) <= 42
    assert set(arrivals(came, "DepthImage")) == stamps
    assert set(arrivals(came, "PoseStamped")) == stamps
    assert {time - stamp for stamp, time in arrivals(came).items()} == {40 * MS}
    (said,) = [r.getMessage() for r in caplog.records if "lost" in r.getMessage()]
    assert int(said.split()[1]) in (49 - len(stamps), 50 - len(stamps))  # one may be on its way


def smeared(result: NodeResult) -> dict[int, bool]:
    """Tell at which stamps the camera with the open shutter saw anything else than the other."""
    seen = {(e.source.partition("/")[2], e.stamp): e.data for e in result.of(Image)}
    return {
        stamp: not np.array_equal(data, seen["open", stamp])
        for (camera, stamp), data in seen.items()
        if camera == "sharp" and ("open", stamp) in seen
    }


SHARP_AND_OPEN = [
    {"name": "sharp", "width": 64, "height": 48, "rate": 10},
    {"name": "open", "width": 64, "height": 48, "rate": 10, "exposure": "90ms", "latency": "45ms"},
]


@pytest.fixture(scope="module")
def free(world: str) -> NodeResult:
    """A free camera that is put elsewhere at 0.15 s, and moves from 0.45 s until that is void."""
    config = {"world": world, "rate": 10, "cameras": SHARP_AND_OPEN, "camera_processes": 1}
    jump = PositionSetpoint(stamp=150 * MS, source="t", position=(0.0, 0.5, -1.0))
    move = VelocitySetpoint(
        stamp=450 * MS, source="t", velocity=(0.0, 3.0, 0.0), frame_id="map", yaw_rate=0.0
    )
    return run_node(FreeCamera, inputs=[jump, move], config=config, duration=1.25)


@pytest.fixture(scope="module")
def vehicle(world: str) -> NodeResult:
    """A vehicle that takes off at 0.6 s; one of its cameras looks down."""
    down = {"name": "down", "orientation": [0, -90, 0], "loss": 1.0} | TINY
    config = {"world": world, "cameras": [*SHARP_AND_OPEN, down], "camera_processes": 1}
    climb = Takeoff(stamp=600 * MS, source="t", altitude=2.0)
    return run_node(Multirotor, inputs=[climb], config=config, duration=3.0)


@pytest.mark.slow
def test_a_free_camera_smears_while_it_moves(free: NodeResult) -> None:
    """With a velocity, and not when it is put elsewhere at once."""
    stamps = [stamp // (100 * MS) for stamp, is_smeared in smeared(free).items() if is_smeared]
    assert stamps == [5, 6, 7, 8, 9]


@pytest.mark.slow
def test_a_trajectory_smears(world: str, tmp_path: Path) -> None:
    file = tmp_path / "turn.tum"
    file.write_text("0 0 0 -1 0 0 0 1\n0.3 0 0 -1 0 0 0 1\n0.6 0 0 -1 0 0 0.3826834 0.9238795\n")
    config = {"world": world, "rate": 10, "cameras": SHARP_AND_OPEN, "camera_processes": 1}
    result = run_node(FreeCamera, config=config | {"trajectory": str(file)}, duration=2.0)
    assert list(smeared(result).values())[:6] == [False, False, False, True, True, True]


def test_a_vehicle_smears_while_it_moves(vehicle: NodeResult) -> None:
    images = smeared(vehicle)
    assert [stamp for stamp, is_smeared in images.items() if is_smeared and stamp < 600 * MS] == []
    assert sum(images.values()) >= 8


def test_mountings_are_said_once_at_the_start(free: NodeResult, vehicle: NodeResult) -> None:
    """Of each camera of either simulator, as announced, in the frame of its body."""
    for result, parent, count in ((free, "node", 2), (vehicle, "base_link", 3)):
        said = result.of(TransformStamped)
        assert [(t.stamp, t.static, t.frame_id) for t in said] == [(0, True, parent)] * count
        for transform, announced in zip(said, result.of(CameraAnnouncement), strict=True):
            assert transform.source == announced.source
            assert transform.child_frame_id == announced.frame_id
            assert transform.translation == announced.position
            assert transform.rotation == announced.orientation
    down = CameraSpec(name="down", orientation=(0.0, -90.0, 0.0))
    assert said[2].rotation == optical_in_body(down)[1]


def sent(world: str, processes: int = 1, **camera: Any) -> NodeResult:
    """Run a free camera of 10 Hz that moves to the right and turns."""
    entry = {"name": "c", "rate": 10, "images": ["rgb", "depth"]} | TINY | camera
    config = {"world": world, "cameras": [entry], "rate": 10, "setpoint_timeout": "5s"}
    config["camera_processes"] = processes
    move = VelocitySetpoint(
        stamp=50 * MS, source="t", velocity=(0.0, 3.0, 0.0), frame_id="map", yaw_rate=0.5
    )
    return run_node(FreeCamera, inputs=[move], config=config, duration=0.75, seed=3)


def test_a_rolling_shutter_sends_the_poses_of_its_rows(world: str) -> None:
    """Of the first, the middle and the last one, at their times, as the camera moves."""
    result = sent(world, readout="20ms")
    (said,) = result.of(CameraAnnouncement)
    assert said.readout == 0.02
    images = result.of(Image)
    poses = [pose.stamp for pose in result.of(PoseStamped)]
    assert poses == [image.stamp + off * MS for image in images for off in (-10, 0, 10)]
    places = {pose.stamp: pose.position[1] for pose in result.of(PoseStamped)}
    for image in images[3:]:
        assert places[image.stamp + 10 * MS] - places[image.stamp] == pytest.approx(0.03, abs=2e-3)
        assert places[image.stamp] - places[image.stamp - 10 * MS] == pytest.approx(0.03, abs=2e-3)


def test_a_rolling_shutter_sees_the_true_states_of_a_vehicle(world: str) -> None:
    """The poses of its rows are those that the ground truth has at these times."""
    camera = {"name": "c", "rate": 20, "readout": "20ms", "latency": "10ms"} | TINY
    config = {"world": world, "cameras": [camera], "camera_processes": 1, "imu_rate": 200}
    orders = [
        Takeoff(stamp=50 * MS, source="t", altitude=1.0),
        VelocitySetpoint(
            stamp=700 * MS, source="t", velocity=(0.0, 4.0, 0.0), frame_id="map", yaw_rate=2.0
        ),
    ]
    result = run_node(Multirotor, inputs=orders, config=config, duration=1.6)
    truth = {odometry.stamp: odometry for odometry in result.of(Odometry)}
    (mount,) = result.of(TransformStamped)
    compared = 0
    for pose in result.of(PoseStamped):
        if (state := truth.get(pose.stamp)) is None or not pose.stamp:
            continue
        expected = pose_matrix(state.position, state.orientation) @ pose_matrix(
            mount.translation, mount.rotation
        )
        matrix = pose_matrix(pose.position, pose.orientation)
        np.testing.assert_allclose(matrix, expected, atol=1e-9)
        compared += 1
    assert compared > 60
    assert result.of(Image)[-1].stamp > 1500 * MS


def test_the_eyes_of_a_stereo_rig_expose_together(world: str) -> None:
    """From one state, and are sent together; the baseline between them is announced."""
    result = sent(world, stereo={"baseline": 0.2}, readout="10ms", noise=2.0)
    left, right = result.of(CameraAnnouncement)
    assert (left.source, right.source) == ("node/c_left", "node/c_right")
    assert (left.baseline, left.stereo) == (0.0, "")
    assert (right.baseline, right.stereo) == (0.2, "node/c_left")
    np.testing.assert_allclose(np.subtract(right.position, left.position), (0.0, 0.2, 0.0))
    images = result.of(Image)
    assert len(images) >= 12
    for one, other in zip(images[::2], images[1::2], strict=True):
        assert (one.source, other.source) == ("node/c_left", "node/c_right")
        assert one.stamp == other.stamp
        assert not np.array_equal(one.data, other.data)
    poses = result.of(PoseStamped)
    by_eye = [[p for p in poses if p.source == eye.source] for eye in (left, right)]
    for one_pose, other_pose in zip(*by_eye, strict=True):
        assert math.dist(one_pose.position, other_pose.position) == pytest.approx(0.2)
        assert one_pose.stamp == other_pose.stamp


def test_a_rolling_stereo_rig_is_the_same_whatever_renders(world: str) -> None:
    """In one process or two, quickly or slowly: to the byte, in the same order."""
    rig = {"stereo": {"baseline": 0.2, "offset": "2ms"}, "readout": "10ms", "exposure": "4ms"}
    more: dict[str, Any] = rig | {"time_jitter": "3ms", "jitter": "120ms", "noise": 2.0}
    one = sent(world, **more)
    for other in (sent(world, processes=2, **more), sent(world, render_time="15ms", **more)):
        assert other.of(PoseStamped) == one.of(PoseStamped)
        assert len(other.of(Image)) == len(one.of(Image)) >= 8
        for a, b in zip(other.of(Image), one.of(Image), strict=True):
            assert (a.stamp, a.source) == (b.stamp, b.source)
            np.testing.assert_array_equal(a.data, b.data)


def test_the_right_eye_may_be_triggered_later(world: str) -> None:
    """Its stamps say so, and it sees what is true then; both still come together."""
    result = sent(world, stereo={"baseline": 0.2, "offset": "5ms"})
    images = result.of(Image)
    for one, other in zip(images[::2], images[1::2], strict=True):
        assert other.stamp - one.stamp == 5 * MS
    places = {(p.source[-4:], p.stamp): p.position for p in result.of(PoseStamped)}
    for image in images[6::2]:
        here, there = places["left", image.stamp], places["ight", image.stamp + 5 * MS]
        # The right eye is 0.2 m to the right, and has moved on for 5 ms at 3 m/s and 0.1 m/s.
        assert math.dist(here, there) == pytest.approx(0.215, abs=2e-3)


@pytest.mark.parametrize("offset", ["0ms", "5ms", "39ms"])
def test_images_of_both_eyes_come_after_the_latency_announced_of_each(
    world: str, offset: str
) -> None:
    """So do those without distortion."""
    lens = {"model": "plumb_bob", "coefficients": [-0.2, 0.05, 0.0, 0.0]}
    rig = {"baseline": 0.2, "offset": offset}
    result = watch(world, stereo=rig, lens=lens, undistorted=True)
    announced, came = result.of(CameraAnnouncement), arrivals(result)
    assert len(announced) == 4
    for said in announced:
        stamps = [image.stamp for image in result.of(Image) if image.source == said.source]
        assert len(stamps) >= 40
        assert {came[stamp] - stamp for stamp in stamps} == {round(said.latency * 1e9)}


def test_stamps_are_late_as_the_clock_of_the_camera_is(world: str) -> None:
    """All that is sent of an exposure has the same stamp; it comes when it would anyway."""
    true = sent(world)
    late = sent(world, time_offset="7ms", time_jitter="2ms")
    (said,) = late.of(CameraAnnouncement)
    assert (said.time_offset, said.time_jitter) == (0.007, 0.002)
    for kind in (Image, DepthImage, PoseStamped):
        errors = [
            (one.stamp - other.stamp) / MS
            for one, other in zip(late.of(kind), true.of(kind), strict=True)
        ]
        assert 5.0 <= min(errors) < 6.9
        assert 7.1 < max(errors) <= 9.0
        assert [e.stamp for e in late.of(kind)] == [e.stamp for e in late.of(Image)]
    assert [o.stamp for o in late.of(Odometry)] == [o.stamp for o in true.of(Odometry)]
    for one, other in zip(late.of(Image), true.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)
    assert [e.stamp for e in sent(world, time_offset="7ms", time_jitter="2ms").of(Image)] == [
        e.stamp for e in late.of(Image)
    ]


def test_images_without_distortion_come_beside_the_others(world: str) -> None:
    """With the same stamps and a pinhole's announcement."""
    lens = {"model": "plumb_bob", "coefficients": [-0.2, 0.05, 0.0, 0.0]}
    result = sent(world, lens=lens, undistorted=True)
    own, twin = result.of(CameraAnnouncement)
    assert (twin.source, twin.undistorted) == ("node/c/undistorted", "node/c")
    assert not own.info.is_pinhole
    assert twin.info.is_pinhole
    for kind in (Image, DepthImage, PoseStamped):
        stamps = [
            [e.stamp for e in result.of(kind) if e.source == camera.source]
            for camera in (own, twin)
        ]
        assert stamps[0] == stamps[1]
        assert len(stamps[0]) >= 6


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"readout": "20ms", "latency": "5ms"}, "latency: expected at least the 10 ms"),
        ({"readout": "200ms", "latency": "1s"}, "readout: expected at most the 33.33 ms"),
        ({"exposure": "10ms", "latency": "0ms"}, "latency: expected at least the 5 ms"),
        ({"time_jitter": "20ms"}, "time_jitter: expected at most the 16.67 ms"),
        ({"stereo": {"baseline": 0.1, "offset": "50ms"}}, "stereo.offset: expected at most"),
        ({"undistorted": True}, "undistorted: expected a lens that distorts"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    """With the camera's name, what was expected and what was found."""
    with pytest.raises(ConfigError, match=message):
        run_node(FreeCamera, config={"cameras": [{"name": "c"} | settings]}, duration=0.1)


def test_a_camera_that_does_not_divide_the_imu_exposes_at_its_own_rate(
    world: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Also one that is quicker; at equal intervals, and no stamp twice; the others are tied."""
    cameras: list[dict[str, Any]] = [
        {"name": f"at_{rate}", "rate": rate} | TINY for rate in (50, 70, 250)
    ]
    config = {"world": world, "cameras": cameras, "camera_processes": 1, "trigger": "imu"}
    result = run_node(Multirotor, config=config, duration=0.5)
    imu = {sample.stamp for sample in result.of(Imu)}
    for rate in (50, 70, 250):
        stamps = [e.stamp for e in result.of(Image) if e.source == f"node/at_{rate}"]
        np.testing.assert_allclose(stamps, np.arange(len(stamps)) * 1e9 / rate, atol=1)
        assert len(stamps) > 0.4 * rate
        assert (set(stamps) <= imu) == (rate == 50)
    warned = [r.getMessage() for r in caplog.records if "does not divide" in r.getMessage()]
    assert [text.split(":")[0] for text in warned] == ["at_70", "at_250"]
