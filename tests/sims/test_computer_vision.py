"""The free camera: the twist that it tells is that of the poses that it tells."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events import Odometry, PositionSetpoint, VelocitySetpoint
from runtime.testing import NodeResult, run_node
from sims.computer_vision import FreeCamera, read_tum

SECOND = 1_000_000_000
WORLD = """<mujoco><worldbody><geom type="plane" size="9 9 1"/></worldbody></mujoco>"""
CAMERA = {"name": "c", "width": 8, "height": 6, "loss": 1.0}


def watch(tmp_path: Path, *inputs: Any, duration: float = 2.0, **config: Any) -> NodeResult:
    """Run a free camera that takes no images."""
    world = tmp_path / "world.xml"
    world.write_text(WORLD)
    config = {"world": str(world), "cameras": [CAMERA], "camera_processes": 1} | config
    return run_node(FreeCamera, inputs=inputs, config=config, duration=duration, name="eye")


def turn(event: Odometry) -> Rotation:
    w, x, y, z = event.orientation
    return Rotation.from_quat((x, y, z, w))


def assert_true(before: Odometry, now: Odometry, after: Odometry) -> None:
    """The twist at `now` is what the poses around it say, in the body's frame."""
    seconds = (after.stamp - before.stamp) / 1e9
    velocity = np.subtract(after.position, before.position) / seconds
    rates = (turn(before).inv() * turn(after)).as_rotvec() / seconds
    np.testing.assert_allclose(now.linear_velocity, turn(now).inv().apply(velocity), atol=1e-4)
    np.testing.assert_allclose(now.angular_velocity, rates, atol=1e-4)


@pytest.mark.slow
def test_the_twist_along_a_trajectory_is_that_of_its_poses(tmp_path: Path) -> None:
    """With turns about all axes, and stamps since 1970 (a float has them to 0.2 microseconds)."""
    random = np.random.default_rng(5)
    places = np.cumsum(random.normal(0.0, 0.2, (21, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(random.normal(0.0, 0.3, (21, 3)), axis=0)).as_quat()
    rows = np.column_stack([np.arange(21) * 0.1, places, turns])
    file = tmp_path / "path.tum"
    lines = [f"{1_400_000_000 + r[0]:.1f} " + " ".join(map(repr, r[1:].tolist())) for r in rows]
    file.write_text("\n".join(lines))
    said = watch(tmp_path, rate=100, trajectory=str(file), duration=3.0).of(Odometry)
    assert 200 <= len(said) <= 201
    between = [i for i in range(1, len(said) - 1) if i % 10]
    for index in between:
        assert_true(*said[index - 1 : index + 2])
    knot = said[10]  # the mean of both sides
    sides = [np.subtract(b.position, a.position) * 100 for a, b in pairwise(said[9:12])]
    expected = turn(knot).inv().apply(np.mean(sides, axis=0))
    np.testing.assert_allclose(knot.linear_velocity, expected, atol=1e-3)
    speeds = [np.linalg.norm(e.linear_velocity) for e in said]
    assert min(speeds[i] for i in between) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("frame_id", ["map", "heading"])
def test_the_twist_of_a_velocity_is_that_of_the_poses(tmp_path: Path, frame_id: str) -> None:
    """While it holds; before and afterwards, and where the camera is put, it rests."""
    put = PositionSetpoint(stamp=SECOND // 10, source="t", position=(1.0, 0.0, -1.0), yaw=0.5)
    move = VelocitySetpoint(
        stamp=SECOND // 2 - 1, source="t", velocity=(1.0, 2.0, -0.5), frame_id=frame_id
    )
    spin = VelocitySetpoint(stamp=SECOND, source="t", velocity=(0.0, 0.0, 0.0), yaw_rate=1.5)
    said = watch(tmp_path, put, move, spin, rate=50).of(Odometry)
    for before, now, after in zip(said[26:48], said[27:49], said[28:50], strict=True):
        assert_true(before, now, after)
    for before, now, after in zip(said[52:73], said[53:74], said[54:75], strict=True):
        assert_true(before, now, after)
    assert np.linalg.norm(said[40].linear_velocity) == pytest.approx(5.25**0.5)
    assert said[60].angular_velocity == pytest.approx((0.0, 0.0, 1.5))
    for rests in (*said[:25], *said[80:]):
        assert rests.linear_velocity == rests.angular_velocity == (0.0, 0.0, 0.0)


def test_rows_count_time_from_the_first(tmp_path: Path) -> None:
    file = tmp_path / "t.tum"
    file.write_text("5.5 1 2 3 0 0 0 1\n7 1 2 3 0 0 0 1\n")
    assert read_tum(file)[:, 0].tolist() == [0.0, 1.5]
