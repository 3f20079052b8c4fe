"""A carried body as a node: what its sensors feel, what it follows, refuses and tells."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    Imu,
    ImuAnnouncement,
    LidarScan,
    Odometry,
    PathAnnouncement,
    PoseStamped,
    Range,
    TransformStamped,
    VehicleAnnouncement,
)
from events.frames import cross, rotate, rotate_inverse
from nodes.data.dataset import DatasetWriter
from nodes.data.replay import Replay
from nodes.trajectory import Trajectory
from runtime.config.model import Config, RunConfig
from runtime.errors import ConfigError, NodeError
from runtime.recorded import MotionFile, RecordedMotion, read_motion
from runtime.testing import NodeResult, run_node, run_nodes, spec
from runtime.tools.preflight import of_nodes
from sims.carried import Carried
from sims.carried.motion import BODIES, axes_of, rows_of
from sims.multirotor import Multirotor
from sims.world import World
from tests.nodes.judging.judge import bags

SECOND = 1_000_000_000
GRAVITY = 9.81
WORLD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1"/>
    <geom name="wall" type="box" size="1 20 3" pos="9 0 3"/>
  </worldbody>
</mujoco>
"""
CAMERA = {"name": "eye", "width": 8, "height": 6, "images": ["grey"], "position": [0, 0, 0]}
RADIUS, RATE = 2.0, 1.2  # of the circle, metres and rad/s
Floats = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("carried")
    (path / "world.xml").write_text(WORLD)
    write(path / "circle.tum", circle(np.arange(0.0, 4.0, 0.01)))
    return path


def circle(seconds: Floats) -> Floats:
    """Return rows of a horizontal circle, clockwise from above, the nose ahead."""
    angle = RATE * seconds
    place = [RADIUS * np.cos(angle), RADIUS * np.sin(angle), np.full_like(angle, -1.5)]
    turn = Rotation.from_rotvec(np.outer(angle + math.pi / 2.0, (0, 0, 1)))
    return np.column_stack([seconds, *place, turn.as_quat(scalar_first=True)])


def write(file: Path, rows: Floats, head: str = "# base_link (FRD) in map (NED)") -> str:
    rows = rows[:, [0, 1, 2, 3, 5, 6, 7, 4]]
    lines = [head, *(" ".join(f"{value:.12f}" for value in row) for row in rows.tolist())]
    file.write_text("\n".join(lines) + "\n")
    return str(file)


def settings(folder: Path, **config: Any) -> dict[str, Any]:
    return {
        "world": str(folder / "world.xml"),
        "trajectory": str(folder / "circle.tum"),
        "place": {"position": [RADIUS, 0.0, -1.5]},
        "rest": 0.0,
        "imu": {"ideal": True},
    } | config


def carry(folder: Path, duration: float = 1.0, **config: Any) -> NodeResult:
    return run_node(Carried, config=settings(folder, **config), duration=duration, name="rig")


def test_on_a_circle_the_imu_and_the_truth_are_those_of_the_formula(folder: Path) -> None:
    """Of an IMU that is mounted off the centre and turned."""
    position, orientation = (0.3, -0.1, 0.2), (0.0, 90.0, 0.0)
    imu = {"ideal": True, "position": position, "orientation": orientation}
    result = carry(folder, 2.0, imu=imu, imu_rate=100)
    rates = (0.0, 0.0, RATE)
    inwards = (0.0, RATE**2 * RADIUS, -GRAVITY)  # the circle's middle is to the right
    force = np.add(inwards, cross(rates, cross(rates, position)))
    mounted = Rotation.from_euler("y", 90, degrees=True).as_quat(scalar_first=True)
    samples, truths = result.of(Imu), result.of(Odometry)
    assert [e.stamp for e in samples] == [e.stamp for e in truths]
    assert [e.stamp for e in samples] == [k * SECOND // 100 for k in range(200)]
    for sample, truth in zip(samples[50:150], truths[50:150], strict=True):
        expected = rotate_inverse(tuple(mounted.tolist()), tuple(force.tolist()))
        np.testing.assert_allclose(sample.linear_acceleration, expected, atol=1e-6)
        turned = rotate_inverse(tuple(mounted.tolist()), rates)
        np.testing.assert_allclose(sample.angular_velocity, turned, atol=1e-6)
        np.testing.assert_allclose(truth.linear_velocity, (RADIUS * RATE, 0, 0), atol=1e-6)
        row = circle(np.array([truth.stamp / 1e9]))[0]
        np.testing.assert_allclose(truth.position, row[1:4], atol=1e-6)


def integrated(samples: list[Imu], start: Odometry) -> Floats:
    """Return the last position: constant rates and force in the frame halfway between samples."""
    w, x, y, z = start.orientation
    turn = Rotation.from_quat((x, y, z, w))
    place, velocity = np.array(start.position), turn.apply(start.linear_velocity)
    stamp = start.stamp
    for sample in samples:
        seconds, stamp = (sample.stamp - stamp) / 1e9, sample.stamp
        step = Rotation.from_rotvec(np.multiply(sample.angular_velocity, seconds))
        half = turn * Rotation.from_rotvec(np.multiply(sample.angular_velocity, seconds / 2.0))
        acceleration = np.add(half.apply(sample.linear_acceleration), (0.0, 0.0, GRAVITY))
        place = place + velocity * seconds + acceleration * seconds**2 / 2.0
        velocity = velocity + acceleration * seconds
        turn = turn * step
    return place


def wandering(seconds: Floats) -> Floats:
    """Return rows of a motion about all axes, as of a hand-held camera."""
    phases = np.outer(seconds, [0.9, 1.3, 2.1, 0.7, 1.7, 1.1]) + np.arange(6.0)
    place = np.sin(phases[:, :3]) * (1.5, 1.0, 0.4)
    turn = Rotation.from_euler("ZYX", np.sin(phases[:, 3:]) * (1.0, 0.3, 0.3))
    return np.column_stack([seconds, place, turn.as_quat(scalar_first=True)])


@pytest.mark.slow
def test_mean_samples_of_a_minute_integrate_to_the_truth(folder: Path) -> None:
    file = write(folder / "wandering.tum", wandering(np.arange(0.0, 61.0, 0.01)))
    place = {"position": [0.0, 0.0, -1.5]}
    imu = {"ideal": True, "sampling": "mean"}
    result = carry(folder, 60.1, trajectory=file, place=place, imu=imu, rest=0.5)
    samples, truths = result.of(Imu), result.of(Odometry)
    assert samples[-1].stamp >= 60 * SECOND
    assert math.dist(integrated(samples[1:], truths[0]), truths[-1].position) < 0.005


def test_the_run_ends_with_the_motion_and_as_planned(folder: Path) -> None:
    result = carry(folder, 9.0, rest=0.5, speed=2.0)
    assert result.reason == "trajectory ended"
    assert 0.5 + 3.99 / 2.0 < result.seconds < 0.5 + 3.99 / 2.0 + 1.05  # eased in
    rest = [e for e in result.of(Odometry) if e.stamp < 0.3 * SECOND]
    assert all(math.hypot(*e.linear_velocity) < 1e-2 for e in rest)
    fast = max(math.hypot(*e.linear_velocity) for e in result.of(Odometry))
    assert fast == pytest.approx(2.0 * RADIUS * RATE, rel=0.1)


def test_imagined_rotors_start_with_the_motion(folder: Path) -> None:
    imu = {"vibration": {"amplitude": 2.0}}
    samples = carry(folder, 3.5, rest=1.0, thrust=0.5, imu=imu).of(Imu)
    size = {e.stamp: math.hypot(*e.linear_acceleration) for e in samples}
    at_rest = [size[s] for s in size if s < 0.9 * SECOND]
    moving = [size[s] for s in size if s > 2.5 * SECOND]
    assert np.std(at_rest) < 0.05
    assert np.std(moving) > 0.3


def test_it_announces_a_vehicle_without_motors_and_its_sensors(folder: Path) -> None:
    result = carry(folder, 0.5, imu={}, barometer={"position": [0.1, 0, 0]}, place={
        "position": [1.0, 2.0, -1.5], "heading": 90.0
    })  # fmt: skip
    (vehicle,), (imu,) = result.of(VehicleAnnouncement), result.of(ImuAnnouncement)
    assert (vehicle.mass, vehicle.max_thrust, vehicle.control_rate) == (0.0, 0.0, 0.0)
    assert vehicle.position == pytest.approx((1.0, 2.0, -1.5), abs=1e-3)
    assert (imu.source, imu.frame_id) == ("rig/imu", "base_link")
    assert [e.child_frame_id for e in result.of(TransformStamped)] == ["rig/barometer"]
    first = result.of(Odometry)[0]
    assert first.position == pytest.approx(vehicle.position, abs=1e-9)
    assert first.orientation == pytest.approx(vehicle.orientation, abs=1e-9)


@pytest.mark.slow
def test_rays_start_where_the_body_is_at_their_time(folder: Path) -> None:
    """Of a turn during which it comes nearer to a wall 8 m north of the start, at 4 m/s."""
    seconds = np.arange(0.0, 2.0, 0.02)
    rolling = Rotation.from_rotvec(np.outer(0.2 * np.sin(3.0 * seconds), (1, 0, 0)))
    places = np.outer(4.0 * seconds, (1, 0, 0))
    rows = np.column_stack([seconds, places, rolling.as_quat(scalar_first=True)])
    file = write(folder / "straight.tum", rows)
    lidar = {"name": "lidar", "azimuths": [-1, 1], "channels": 1, "elevations": [0, 0],
             "columns": 64, "rate": 2.0}  # fmt: skip
    ahead = {"name": "ahead", "rate": 10, "noise": 0.0}
    result = carry(
        folder, 1.9, trajectory=file, place={"position": [0.0, 0.0, -1.5]},
        lidars=[lidar], range_finders=[ahead],
    )  # fmt: skip
    for scan in result.of(LidarScan):
        distances = np.linalg.norm(scan.points, axis=1)
        walls = 8.0 - 4.0 * (scan.stamp / 1e9 + scan.times)
        np.testing.assert_allclose(distances, walls, atol=5e-3)
    assert len(result.of(LidarScan)) >= 2
    for reading in result.of(Range)[2:-2]:
        assert reading.range == pytest.approx(8.0 - 4.0 * reading.stamp / 1e9, abs=1e-3)


def test_equal_seeds_give_equal_events_and_others_do_not_matter(folder: Path) -> None:
    config = settings(folder, imu={}, gnss={"startup_delay": 0})
    alone = carry(folder, **config)
    assert carry(folder, **config).sent == alone.sent
    drone = spec(Multirotor, "drone", {"world": config["world"], "position": [-4.0, 0.0]})
    both = run_nodes([spec(Carried, "rig", config), drone])
    own = [e for e in both.sent if e.source.partition("/")[0] == "rig"]
    assert own == alone.sent
    (truth, *_) = [e for e in both.of(Odometry) if e.source == "drone"]
    assert truth.position[:2] == pytest.approx((-4.0, 0.0), abs=1e-9)


def refusal(folder: Path, **config: Any) -> str:
    with pytest.raises((ConfigError, NodeError)) as caught:
        carry(folder, 0.1, **config)
    return str(caught.value)


def test_what_cannot_be_followed_is_refused_at_the_start(folder: Path) -> None:
    assert "trajectory: expected a file" in refusal(folder, trajectory="")
    assert "none.tum: expected a file, found: No such file" in refusal(
        folder, trajectory=str(folder / "none.tum")
    )
    undeclared = write(folder / "plain.tum", circle(np.arange(0.0, 2.0, 0.01)), head="#")
    assert 'axes: expected "ned", "nwu"' in refusal(folder, trajectory=undeclared)
    (folder / "places.tum").write_text("0 1 2 3\n1 1 2 3\n")
    assert "expected orientations" in refusal(
        folder, trajectory=str(folder / "places.tum"), axes="ned"
    )


def test_a_body_inside_something_is_refused_and_one_near_it_warned_of(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    inside = refusal(folder, place={"position": [9.0, 0.0, -1.5]})
    assert re.search(r"place: expected a free way, found it in wall at \d\.\d\d s", inside)
    times = np.arange(0.0, 3.0, 0.01)
    half = circle(times + math.pi / RATE)  # from the circle's other side
    half[:, 0], half[:, 1] = times, half[:, 1] + 7.0
    on_the_way = refusal(folder, trajectory=write(folder / "half.tum", half), place="recorded")
    assert re.search(r"found it in wall at 2\.\d\d s", on_the_way)
    assert "in the ground" in refusal(folder, place={"position": [0.0, 0.0, 0.5]})
    near = circle(times) + np.eye(8)[1] * 5.9
    file = write(folder / "near.tum", near)
    with caplog.at_level(logging.WARNING, "visnav"):
        carry(folder, 0.1, trajectory=file, place="recorded")
    assert re.search(r"margin: nearer than 0\.3 m: 0\.1 m from wall at", caplog.text)
    caplog.clear()
    with caplog.at_level(logging.WARNING, "visnav"):
        carry(folder, 0.1, trajectory=file, place="recorded", margin=0.05)
    assert "margin" not in caplog.text


def test_what_is_too_fast_is_refused_or_warned_of(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert "expected accelerations of up to 500 m/s²" in refusal(folder, speed=20.0)
    with caplog.at_level(logging.WARNING, "visnav"):
        carry(folder, 0.1, imu={"gyroscope_range": 1.0, "accelerometer_range": 100.0})
    assert "beyond the range of the gyroscope" in caplog.text
    assert "beyond the range of the accelerometer" not in caplog.text


def test_what_moves_by_itself_in_the_way_is_told(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of a person who stands where the circle comes by after a second."""
    x, y = circle(np.array([1.0]))[0, 1:3].tolist()
    person = {"name": "ann", "kind": "person", "waypoints": [[x, y, 0.0]]}
    world = spec(World, "world", {"bodies": [person]})
    with caplog.at_level(logging.WARNING, "visnav"):
        run_nodes([world, spec(Carried, "rig", settings(folder, place="recorded"))], duration=0.1)
    assert re.search(r"margin: nearer than 0\.3 m: .* m from world/ann at (0\.9|1\.)", caplog.text)


def test_a_check_tells_what_the_motion_is_like(folder: Path) -> None:
    config = Config(run=RunConfig(), nodes=(spec(Carried, "rig", settings(folder)),))
    findings = of_nodes(config)
    assert findings.errors == []
    text = " ".join(findings.facts)
    for fact in ("400 rows, each 10 ms, no gap", "at most 2.4 m/s, 2.88 m/s², 68.8°/s",
                 "nearest to the ground, 1.50 m"):  # fmt: skip
        assert fact in text


@pytest.mark.slow
def test_a_data_set_replayed_and_written_again_is_the_same(folder: Path, tmp_path: Path) -> None:
    files = []
    config = settings(folder, imu={"sampling": "mean"}, cameras=[CAMERA], trigger="imu")
    carried = spec(Carried, "rig", config)
    for name in ("first", "second"):
        out = tmp_path / name
        out.mkdir()
        run_nodes(
            [carried, spec(DatasetWriter, "data", {"format": "euroc", "folder": "euroc"})],
            duration=2.0,
            out=out,
        )
        carried = spec(Replay, "rig", {"file": str(tmp_path / "first" / "euroc")})
        samples, truth = (
            np.loadtxt(out / "euroc" / "mav0" / file / "data.csv", delimiter=",")
            for file in ("imu0", "state_groundtruth_estimate0")
        )
        files.append((samples, truth))
    np.testing.assert_array_equal(files[0][0], files[1][0])
    np.testing.assert_array_equal(files[0][1], files[1][1])
    assert len(files[0][0]) == 400


def test_nobody_flies_it(folder: Path) -> None:
    path = PathAnnouncement(stamp=0, source="pilot", waypoints=((1.0, 0.0, -1.0),))
    with pytest.raises(NodeError, match="expected no path for a carried body, found that of pilot"):
        run_node(Carried, inputs=[path], config=settings(folder), duration=0.1, name="rig")


def axes_file(folder: Path, world: Floats, body: Floats) -> tuple[str, RecordedMotion]:
    rows = circle(np.arange(0.0, 2.0, 0.01))
    turns = Rotation.from_quat(rows[:, 4:], scalar_first=True).as_matrix()
    rows[:, 1:4] = rows[:, 1:4] @ world.T
    turned = Rotation.from_matrix(world @ turns @ body)
    rows[:, 4:] = turned.as_quat(scalar_first=True)
    name = write(folder / "axes.tum", rows, head="#")
    return name, read_motion(MotionFile(path=name, axes="nwu"))


@pytest.mark.parametrize("axes", BODIES)
def test_the_body_is_upright_whatever_its_recorded_axes(axes: Any, folder: Path) -> None:
    up = np.diag([1.0, -1.0, -1.0])
    body = Rotation.from_quat(BODIES[axes], scalar_first=True).as_matrix()
    _, recorded = axes_file(folder, up, body)
    assert axes_of(recorded) == axes
    rows = rows_of(recorded, axes, (0.0, 0.0, 0.0), 1.0)
    expected = circle(np.arange(0.0, 2.0, 0.01))
    signs = np.sign((rows[:, 4:] * expected[:, 4:]).sum(axis=1))
    np.testing.assert_allclose(rows[:, 4:] * signs[:, None], expected[:, 4:], atol=1e-9)
    np.testing.assert_allclose(rows[:, :4], expected[:, :4], atol=1e-9)


def test_every_format_gives_the_same_motion(folder: Path) -> None:
    """A bag's, EuRoC's with z up, KITTI's with y down and a file of times, and a run's."""
    rows = circle(np.arange(0.0, 2.0, 0.01))
    turns = Rotation.from_quat(rows[:, 4:], scalar_first=True)
    up = np.diag([1.0, -1.0, -1.0])
    euroc = (
        Rotation.from_matrix(up) * turns * Rotation.from_quat(BODIES["euroc"], scalar_first=True)
    )
    stamps = [f"{1_400_000_000 * SECOND + round(s * 1e9)}" for s in rows[:, 0].tolist()]
    table = np.column_stack(
        [rows[:, 1:4] @ up, euroc.as_quat(scalar_first=True), np.zeros((200, 9))]
    )
    lines = [
        ",".join([stamp, *(f"{value:.12f}" for value in row)])
        for stamp, row in zip(stamps, table.tolist(), strict=True)
    ]
    (folder / "data.csv").write_text("\n".join(lines))
    axes = Rotation.from_quat(BODIES["optical"], scalar_first=True)
    matrices = (axes.inv() * turns * axes).as_matrix()
    transforms = np.concatenate([matrices, axes.inv().apply(rows[:, 1:4])[:, :, None]], axis=2)
    np.savetxt(folder / "00.txt", transforms.reshape(200, 12), fmt="%.12e")
    np.savetxt(folder / "times.txt", rows[:, 0], fmt="%.6e")
    (folder / "flight" / "trajectories").mkdir(parents=True)
    write(folder / "flight" / "trajectories" / "truth.tum", rows)
    numbers = np.round(rows[:, 0] * SECOND).astype(np.int64)
    bag = bags.bag(folder / "bag", bags.POSE, Trajectory(numbers, rows[:, 1:4], rows[:, 4:]))
    for file in (
        MotionFile(path=str(bag), part="/slam/poses"),
        MotionFile(path=str(folder / "data.csv")),
        MotionFile(path=str(folder / "00.txt"), times=str(folder / "times.txt")),
        MotionFile(path=str(folder / "flight")),
    ):
        recorded = read_motion(file)
        again = rows_of(recorded, axes_of(recorded), (0.0, 0.0, 0.0), 1.0)
        again[:, 4:] *= np.sign((again[:, 4:] * rows[:, 4:]).sum(axis=1))[:, None]
        np.testing.assert_allclose(again, rows, atol=1e-6)


def test_a_lever_is_where_the_recorded_point_is_on_the_body(folder: Path) -> None:
    recorded = read_motion(MotionFile(path=str(folder / "circle.tum")))
    lever = (0.15, 0.0, -0.2)
    rows = rows_of(recorded, "frd", lever, 0.5)
    for row, position in zip(rows.tolist(), recorded.positions.tolist(), strict=True):
        place = np.add(row[1:4], rotate((row[4], row[5], row[6], row[7]), lever))
        np.testing.assert_allclose(place, position, atol=1e-9)
    assert rows[-1, 0] == pytest.approx(2.0 * 3.99)


def test_a_body_that_lies_on_no_axis_is_asked_for() -> None:
    slanted = Rotation.from_euler("xy", [45, 35], degrees=True).as_quat(scalar_first=True)
    recorded = RecordedMotion(
        stamps=np.array([0, SECOND]),
        positions=np.zeros((2, 3)),
        orientations=np.tile(slanted, (2, 1)),
        body="",
    )
    with pytest.raises(ValueError, match="body: expected one of frd, flu, optical, euroc"):
        axes_of(recorded)


@pytest.mark.slow
def test_a_camera_tells_where_its_rows_were_exposed(folder: Path) -> None:
    rolling = CAMERA | {"readout": "20ms", "rate": 10}
    result = carry(folder, 1.0, cameras=[rolling], trigger="imu", camera_processes=1)
    (announced,) = result.of(CameraAnnouncement)
    assert announced.parent_frame_id == "base_link"
    poses = result.of(PoseStamped)
    assert len(poses) >= 3 * 8
    for pose in poses[6:]:
        row = circle(np.array([pose.stamp / 1e9]))[0]
        np.testing.assert_allclose(pose.position, row[1:4], atol=1e-5)
