"""Recorded images, depth, intrinsics and poses agree with each other, in both layouts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from nodes.data.dataset import DatasetWriter
from nodes.trajectory_files import read_euroc, read_tum
from runtime import Duration
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.testing import spec
from sims.computer_vision import FreeCamera
from tests.nodes.data.dataset.samples import png, table, yaml

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[4]
Floats = npt.NDArray[np.float64]
CAMERA = {
    "world": "yard",
    "trajectory": str(ROOT / "examples" / "orbit.tum"),
    "rate": 10,
    "cameras": [{
        "name": "eye", "width": 160, "height": 120, "fov": 80, "position": [0.2, 0.1, -0.05],
        "orientation": [5, -10, 15],
    }],
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that both layouts were recorded of."""
    out = tmp_path_factory.mktemp("run")
    nodes = (
        spec(FreeCamera, "rig", CAMERA),
        spec(DatasetWriter, "tum", {"format": "tum_rgbd", "folder": "tum"}),
        spec(DatasetWriter, "euroc", {"format": "euroc", "folder": "euroc"}),
    )
    execute(Config(run=RunConfig(duration=Duration(1.05)), nodes=nodes), out)
    return out


def tum(folder: Path) -> tuple[list[Any], list[Any], Floats, Floats]:
    """Return images, depths (m), K, and the camera's poses."""
    pairs = table(folder / "associations.txt")
    lens = yaml(folder / "camera.yaml")
    truth = read_tum(folder / "groundtruth.txt")
    assert [row[0] for row in pairs] == [row[0] for row in table(folder / "groundtruth.txt")]
    return (
        [cv2.cvtColor(png(folder / row[1]), cv2.COLOR_RGB2GRAY) for row in pairs],
        [png(folder / row[3]) / lens["depth_factor"] for row in pairs],
        np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]]),
        truth.matrices(),
    )


def euroc(folder: Path) -> tuple[list[Any], list[Any], Floats, Floats]:
    """Return the same of the other layout."""
    mav = folder / "mav0"
    frames = table(mav / "cam0" / "data.csv")
    assert frames == table(mav / "depth0" / "data.csv")
    lens = yaml(mav / "cam0" / "sensor.yaml")
    fx, fy, cx, cy = lens["intrinsics"]
    factor = yaml(mav / "depth0" / "sensor.yaml")["depth_factor"]
    body = read_euroc(mav / "state_groundtruth_estimate0" / "data.csv")
    poses = body.at(np.array([int(row[0]) for row in frames])).matrices()
    return (
        [png(mav / "cam0" / "data" / row[1]) for row in frames],
        [png(mav / "depth0" / "data" / row[1]) / factor for row in frames],
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        poses @ np.reshape(lens["T_BS"]["data"], (4, 4)),
    )


@pytest.mark.parametrize("read", [tum, euroc])
def test_what_one_frame_sees_stands_where_another_sees_it(read: Any, run: Path) -> None:
    """Points of the first frame, by its depth and pose, land on the last at the same depth."""
    images, depths, k, poses = read(run / read.__name__)
    assert len(images) == 11
    first, last = depths[0], depths[-1]
    rows, columns = np.nonzero(first)
    rays = np.linalg.inv(k) @ np.stack([columns, rows, np.ones(len(rows))])
    points = poses[0] @ np.vstack([rays * first[rows, columns], np.ones(len(rows))])
    x, y, z = (np.linalg.inv(poses[-1]) @ points)[:3]
    there = z > 0.5
    u, v = np.rint((k @ np.stack([x, y, z]))[:2, there] / z[there]).astype(int)
    inside = (u >= 0) & (u < first.shape[1]) & (v >= 0) & (v < first.shape[0])
    u, v, z = u[inside], v[inside], z[there][inside]
    assert len(z) > 0.3 * first.size
    seen = last[v, u]
    close = abs(seen - z) < 0.02 * z
    assert close.mean() > 0.85
    before = images[0][rows, columns][there][inside][close].astype(float)
    after = images[-1][v, u][close].astype(float)
    assert np.corrcoef(before, after)[0, 1] > 0.7


def test_the_recorded_velocity_is_that_of_the_poses(run: Path) -> None:
    """Within the curvature of a path that is seen every tenth of a second."""
    folder = run / "euroc" / "mav0" / "state_groundtruth_estimate0"
    rows = np.loadtxt(folder / "data.csv", delimiter=",")
    places, velocities = rows[:, 1:4], rows[:, 8:11]
    seconds = (rows[2:, 0] - rows[:-2, 0])[:, None] / 1e9
    between = (places[2:] - places[:-2]) / seconds
    assert np.linalg.norm(between, axis=1).min() > 0.2
    np.testing.assert_allclose(velocities[1:-1], between, atol=0.02)


def test_the_world_is_z_up(run: Path) -> None:
    _, _, _, poses = tum(run / "tum")
    assert (poses[:, 2, 3] > 1.0).all()
    # The images' down is the world's down, but for the mounting's 5 and 10 degrees.
    assert (poses[:, 2, 1] < -0.9).all()


def test_both_layouts_have_the_same_images_and_poses(run: Path) -> None:
    images, depths, k, poses = tum(run / "tum")
    greys, others, other_k, other_poses = euroc(run / "euroc")
    assert (np.array(images) == np.array(greys)).all()
    assert (np.array(depths) == np.array(others)).all()
    assert k.tolist() == other_k.tolist()
    assert abs(poses - other_poses).max() < 1e-8
