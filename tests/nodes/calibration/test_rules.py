"""Each rule of ``lint`` fires on what is odd, and on nothing else; and a file can accept it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from events import Announcement, CameraAnnouncement, CameraInfo, EstimatorAnnouncement
from runtime.config.model import Config
from runtime.config.reading import parse
from runtime.tools.preflight import Finding, lint
from runtime.tools.preflight import rules as all_rules
from tests.nodes.calibration.samples import IMU, camera, stereo
from tests.nodes.estimators.lidar_samples import lidar
from tests.runtime.tools.samples_cli import command

SLAM: dict[str, Any] = {"name": "slam", "type": "OrbSlam3"}
ESTIMATES = EstimatorAnnouncement(stamp=0, source="slam", method="test")
RIGHT, LEFT = stereo(noise=2.0).cameras[::-1]


def file(mode: str = "rgbd_inertial", latency: str = "15ms", accept: Sequence[str] = ()) -> Config:
    """Return a file in which ORB-SLAM3 is judged."""
    nodes = [SLAM | {"mode": mode, "latency": latency}]
    nodes.append({"name": "evaluation", "type": "Evaluation"})
    return parse({"run": {"accept": list(accept), "duration": 1}, "nodes": nodes}, "test")


def nodes_of(*types: str, duration: float = 1.0, **settings: Any) -> Config:
    """Return a file with nodes called a, b, …, the last with settings."""
    nodes = [{"name": name, "type": kind} for name, kind in zip("abc", types, strict=False)]
    nodes[-1] |= settings
    return parse({"run": {"duration": duration}, "nodes": nodes}, "test")


DRONE, EVALUATION = "Multirotor", "Evaluation"
PILOT = "WaypointFollower"
ON_A_LIDAR = nodes_of("Evalio")


def square(**more: Any) -> CameraAnnouncement:
    """Return a camera to which nobody objects."""
    info = msgspec.structs.replace(camera().info, fy=camera().info.fx)
    fields: dict[str, Any] = {"info": info, "rate": 20.0, "noise": 2.0}
    return camera(**(fields | more))


def wide() -> CameraInfo:
    """Return a lens whose polynomial turns back within the image."""
    return msgspec.structs.replace(camera().info, fx=200.0, fy=200.0, distortion=(-0.3, 0, 0, 0, 0))


ODD: list[tuple[str, Config, list[Announcement], str]] = [
    (
        "baseline",
        file(),
        [LEFT, msgspec.structs.replace(RIGHT, position=LEFT.position)],
        "its baseline is 0 m",
    ),
    (
        "baseline",
        file(),
        [LEFT, msgspec.structs.replace(RIGHT, baseline=0.2)],
        "and announces 0.200 m",
    ),
    (
        "square-pixels",
        file(),
        [square(info=msgspec.structs.replace(camera().info, fy=300.0))],
        "fx is 401.2 px and fy 300 px",
    ),
    ("exposure", file(), [square(exposure=0.03, readout=0.03)], "take 60 ms of 50 ms"),
    ("imu-rate", file(), [square(rate=40.0), IMU, ESTIMATES], "gives 5 samples"),
    ("rates-divide", file(), [square(rate=15.0), IMU, ESTIMATES], "15 Hz does not divide"),
    (
        "extrinsics",
        file(),
        [square(parent_frame_id="gimbal"), IMU],
        "mounted on gimbal, drone/imu on base_link",
    ),
    (
        "extrinsics",
        file(),
        [square(position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0))],
        "its pose on the body is none",
    ),
    ("monotonic", file(), [square(info=wide())], "of its image's rim shows nothing"),
    ("latency", file(latency="80ms"), [square(), ESTIMATES], "its latency is 80 ms"),
    ("latency", file(latency="0ms"), [square(), ESTIMATES], "its estimates take no time"),
    ("zero-noise", file(), [square(noise=0.0), ESTIMATES], "its images have no noise"),
    (
        "zero-noise",
        file(),
        [square(), msgspec.structs.replace(IMU, gyroscope_noise_density=0.0), ESTIMATES],
        "a noise density of it is 0",
    ),
    (
        "stamps",
        file(),
        [LEFT, msgspec.structs.replace(RIGHT, rate=15.0)],
        "its rate is 15, that of drone/left 30",
    ),
    ("stamps", file(), [LEFT, msgspec.structs.replace(RIGHT, time_jitter=1e-3)], "have a jitter"),
    ("needs", file(), [square()], "it needs an IMU, which nobody announces"),
    ("needs", ON_A_LIDAR, [square(), IMU], "it needs lidar, which no sensor gives"),
    ("needs", nodes_of(DRONE, "ImageWindow"), [], "no camera is announced"),
    ("no-end", nodes_of(DRONE, EVALUATION, duration=0.0), [], "it has no duration, and no node"),
    (
        "no-end",
        nodes_of(DRONE, PILOT, duration=0.0, waypoints=[[0, 0, -1]], end_run=False),
        [],
        "and no node that ends it",
    ),
    ("idle", nodes_of(DRONE, EVALUATION), [square()], "waits for Command or Setpoint, which no"),
    ("nobody-judged", nodes_of(DRONE, EVALUATION), [square()], "nobody sends estimates"),
]


def test_every_rule_is_offered_and_has_an_odd_case() -> None:
    assert {name for name, *_ in ODD} == set(all_rules())
    assert all(rule.__doc__ for rule in all_rules().values())


@pytest.mark.parametrize(("name", "config", "announced", "said"), ODD)
def test_a_rule_says_what_is_odd(
    name: str, config: Config, announced: list[Announcement], said: str
) -> None:
    findings = [finding for finding in lint(config, announced) if finding.rule == name]
    assert len(findings) == 1
    assert said in str(findings[0])
    assert findings[0].change
    subject = findings[0].subject
    for accepted in (name, f"{name}:{subject}"):
        assert not [
            finding for finding in lint(config, announced, [accepted]) if finding.rule == name
        ]


def test_nothing_is_said_of_a_sound_rig() -> None:
    assert lint(file(), [square(), IMU, ESTIMATES]) == []
    assert lint(file("rgbd"), [square(rate=30.0), IMU, ESTIMATES]) == []  # nobody fuses the IMU
    pair = [msgspec.structs.replace(camera, info=square().info) for camera in (LEFT, RIGHT)]
    near = msgspec.structs.replace(pair[1], position=(0.15, 0.12, -0.03), rate=30.0)
    assert [finding.rule for finding in lint(file("rgbd"), [pair[0], near])] == []
    assert lint(ON_A_LIDAR, [lidar()]) == []
    on_a_lidar = msgspec.structs.replace(ESTIMATES, source="a", reads=("imu", "lidar"))
    assert lint(ON_A_LIDAR, [lidar(), square(rate=40.0), IMU, on_a_lidar]) == []
    flown = nodes_of(DRONE, PILOT, duration=0.0, waypoints=[[0, 0, -1]])
    assert lint(flown, [square()]) == []


def test_of_a_recording_no_noise_is_known() -> None:
    config = file()
    replay = {"name": "drone", "type": "Replay", "file": "flight.mcap"}
    recorded = msgspec.structs.replace(
        config, nodes=(*config.nodes, *parse({"nodes": [replay]}, "test").nodes)
    )
    silent = msgspec.structs.replace(IMU, gyroscope_noise_density=0.0)
    announced = [square(noise=0.0), silent, ESTIMATES]
    assert len(lint(config, announced)) == 2
    assert lint(recorded, announced) == []


def test_what_a_file_accepts_is_left_out_and_a_wrong_name_is_said() -> None:
    announced = [square(rate=40.0), IMU, ESTIMATES]
    assert lint(file(accept=["imu-rate:drone/left"]), announced) == []
    (finding,) = lint(file(accept=["imu-rate", "imu-rat"]), announced)
    assert isinstance(finding, Finding)
    assert finding.rule == "accept"
    assert "accept names no rule: imu-rat" in finding.found
    assert "imu-rate" in finding.change


@pytest.mark.slow
def test_the_command_ends_with_1_on_findings_and_check_warns(tmp_path: Path) -> None:
    text = (
        '[run]\naccept = ["no-end", "idle"]\n[[nodes]]\nname = "drone"\n'
        'type = "Multirotor"\n'
        '[[nodes.cameras]]\nname = "camera"\n'
        '[[nodes]]\nname = "odometry"\ntype = "VisualOdometry"\n'
        '[[nodes]]\nname = "evaluation"\ntype = "Evaluation"\n'
    )
    (tmp_path / "rig.toml").write_text(text)
    done = command("lint", "rig.toml", folder=tmp_path)
    said = "zero-noise: drone/camera: its images have no noise: noise = 2.0 is usual\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, said, "")
    done = command("lint", "rig.toml", "--ignore", "zero-noise", folder=tmp_path)
    assert (done.returncode, done.stdout) == (0, "rig.toml: nothing to say\n")
    done = command("check", "rig.toml", folder=tmp_path)
    assert done.returncode == 0
    assert f"warning: {said}" in done.stderr
