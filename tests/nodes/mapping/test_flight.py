"""A fast flight through the hall: where the clouds of it lie, and that they survive Ctrl-C."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from events import Odometry
from nodes.mapping import Mapping, read_ply
from nodes.pilots import WaypointFollower
from runtime.testing import run_nodes, spec
from sims.multirotor import Multirotor
from sims.worlds import TOURS
from tests.nodes.mapping.surfaces import distances
from tests.runtime.tools.samples_cli import ROOT, start, summary

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]

CLOSE = 0.02
"""Metres."""
WAYPOINTS = [TOURS["hall"][k] for k in (0, 1, 2, 3, 6)]


def fly(out: Path) -> list[Odometry]:
    """Fly at 3 m/s, 11 m of it straight along the west side of the hall, and map it twice."""
    camera = {"name": "camera", "width": 320, "height": 240, "rate": 15, "latency": "40ms"}
    pilot = {"speed": 3.0, "acceleration": 3.0, "waypoints": WAYPOINTS, "start_delay": 0.5}
    nodes = [
        spec(Multirotor, "drone", {"world": "hall", "cameras": [camera]}),
        spec(WaypointFollower, "pilot", pilot),
        spec(Mapping, "matched", {"pose": "matched"}),
        spec(Mapping, "latest", {"pose": "latest"}),
    ]
    return run_nodes(nodes, duration=30.0, out=out).of(Odometry)


def errors(out: Path, name: str) -> npt.NDArray[np.float64]:
    """Distances of a sample of a cloud's points from the hall's surfaces, metres."""
    cloud = read_ply(out / "clouds" / f"{name}.ply", 3000)
    assert cloud.total > 50_000
    return distances("hall", cloud.points)


def test_a_cloud_of_matched_poses_lies_on_the_surfaces(tmp_path: Path) -> None:
    """At 3 m/s and 40 ms of latency; one of the poses at arrival does not."""
    flown = fly(tmp_path)
    speeds = np.array([np.linalg.norm(o.linear_velocity) for o in flown])
    assert (speeds > 2.9).sum() / 200 > 1.5  # seconds
    matched, latest = errors(tmp_path, "matched"), errors(tmp_path, "latest")
    assert np.quantile(matched, 0.95) < CLOSE
    assert matched.max() < CLOSE
    assert np.quantile(latest, 0.95) > 3 * CLOSE
    assert np.quantile(latest, 0.5) > 5 * np.quantile(matched, 0.95)


def test_distances_are_those_from_floor_and_walls() -> None:
    """The yardstick itself: points at known heights over the floor, and beside a wall."""
    for far in (0.0, 0.005, 0.02, 0.1):
        points = np.array([[0.0, 0.0, -far], [2.0, -1.0, -far], [8.0 - far, 0.0, -1.5]])
        np.testing.assert_allclose(distances("hall", points), far, rtol=0.02, atol=1e-4)


def test_ctrl_c_leaves_whole_clouds(tmp_path: Path) -> None:
    """In the middle of a flight, with frames on their way."""
    arguments: list[str | Path] = [
        "run",
        ROOT / "examples" / "mapping.toml",
        "--out",
        tmp_path / "out",
    ]
    with start(arguments, tmp_path) as process:
        try:
            assert process.stderr is not None
            while "a path of" not in (line := process.stderr.readline()):
                assert line
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
        finally:
            process.kill()
    assert summary(tmp_path / "out")["reason"] == "Ctrl-C"
    clouds = tmp_path / "out" / "clouds"
    assert {path.name for path in clouds.iterdir()} == {"matched.ply", "latest.ply"}
    for path in clouds.iterdir():
        assert read_ply(path, 10).total > 1000
