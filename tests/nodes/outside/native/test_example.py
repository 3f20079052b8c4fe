"""The example in C++ tracks a camera through a drawn room, and breaks no rule of the language."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from events import CameraInfo
from events.geometry import inverse
from nodes.outside.native import Endpoint, LinkAnswer, describe
from tests.nodes.outside.native.samples_link import CAMERA, LIMIT, compiled

SOURCE = Path(__file__).parents[4] / "examples" / "outside_cpp" / "odometry.cpp"
INFO = CameraInfo.from_fov(240, 180, 1.5)
WALLS = np.array([3.0, 1.5, 4.0])
"""Metres from the middle of the room to its walls along x, y, z."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),  # a compiler with sanitizers has much to do
    pytest.mark.skipif(shutil.which("c++") is None, reason="c++: not found"),
]


def drawn(pose: npt.NDArray[np.float64]) -> list[tuple[int, str, npt.NDArray[Any]]]:
    """What a camera at a pose (4, 4) sees of a room with smooth texture."""
    v, u = np.mgrid[: INFO.height, : INFO.width]
    rays = np.stack([(u - INFO.cx) / INFO.fx, (v - INFO.cy) / INFO.fy, np.ones(u.shape)], axis=-1)
    turned = rays @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = ((np.sign(turned) * WALLS - pose[:3, 3]) / turned).min(axis=-1)
    x, y, z = np.moveaxis(pose[:3, 3] + depth[..., None] * turned, -1, 0)
    waves = (
        np.sin(3 * x + 2 * y) + np.sin(4 * y - 3 * z) + np.sin(5 * z + 2 * x) + np.sin(9 * x * y)
    )
    grey = np.random.default_rng(0).normal(128 + 25 * waves, 1.0).clip(0, 255).astype(np.uint8)
    depth[:10, :10] = np.inf
    return [(0, "rgb8", grey[..., None].repeat(3, 2)), (0, "depth32f", depth.astype(np.float32))]


def trajectory(count: int) -> list[npt.NDArray[np.float64]]:
    poses = []
    for n in range(count):
        t = n / 30
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("yx", [0.6 * t, 0.1 * np.sin(2 * t)]).as_matrix()
        pose[:3, 3] = np.sin(0.7 * t), 0.2 * np.sin(1.1 * t), 1.2 * (np.cos(0.6 * t) - 1)
        poses.append(pose)
    return poses


def answers(program: Path, path: Path, frames: list[Any]) -> list[LinkAnswer]:
    """Run the program, and return its answers."""
    got: list[LinkAnswer] = []
    camera = msgspec.structs.replace(CAMERA, info=INFO)
    endpoint = Endpoint(
        path,
        describe([(camera, ["rgb8", "depth32f"])], [], {"kind": "lockstep"}),
        slots=1,
        slot_bytes=240 * 180 * 7,
        answered=got.append,
        gone=lambda why: None,
        logged=print,
    )
    endpoint.listen()
    environment = {**os.environ, "VISNAV_SOCKET": str(path)}
    with subprocess.Popen([program], env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            endpoint.wait(LIMIT)
            for n, frame in enumerate(frames):
                assert endpoint.send_frame(n, frame)
            # With its only slot free again, the last frame has been answered.
            assert endpoint.send_frame(len(frames), frames[-1])
        finally:
            endpoint.close()
        _, error = process.communicate(timeout=LIMIT)
    assert (process.returncode, error) == (0, "")
    return got[: len(frames)]


def test_it_tracks_twice_alike(tmp_path: Path) -> None:
    flags = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    program = compiled(SOURCE, tmp_path, *flags)
    truth = trajectory(45)
    frames = [drawn(pose) for pose in truth]
    first = answers(program, tmp_path / "s", frames)
    path = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in itertools.pairwise(truth))
    for pose, answer in zip(truth, first, strict=True):
        assert answer.pose is not None
        error = inverse(inverse(truth[0]) @ pose) @ answer.pose
        assert np.linalg.norm(error[:3, 3]) < 0.02 * path
        assert Rotation.from_matrix(error[:3, :3]).magnitude() < np.radians(1)
    again = answers(program, tmp_path / "s", frames)
    assert [a.pose.tobytes() for a in again if a.pose is not None] == [
        a.pose.tobytes() for a in first if a.pose is not None
    ]


def test_the_program_on_the_page_compiles(tmp_path: Path) -> None:
    page = (SOURCE.parents[2] / "docs" / "reference" / "link.md").read_text(encoding="utf-8")
    block = page.partition("```cpp\n")[2].partition("```")[0]
    images = "const visnav::Image&, const visnav::Image&"
    track = f"std::optional<visnav::Pose> track({images}, const std::vector<visnav::Imu>&);\n"
    (tmp_path / "page.cpp").write_text('#include "visnav_link.hpp"\n' + track + block)
    compiled(tmp_path / "page.cpp", tmp_path, "-c")


def test_it_says_that_it_is_lost(tmp_path: Path) -> None:
    """Frames without texture have no pose, nor has the next: there was nothing to align it with."""
    blank = [(0, "rgb8", np.full((180, 240, 3), 90, np.uint8)), drawn(np.eye(4))[1]]
    frames = [drawn(np.eye(4)), blank, blank, drawn(np.eye(4)), drawn(np.eye(4))]
    statuses = [a.status for a in answers(compiled(SOURCE, tmp_path), tmp_path / "s", frames)]
    assert statuses == ["tracked", "lost", "lost", "lost", "tracked"]
