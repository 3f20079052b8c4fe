"""The curve through recorded poses, its place in a world, and the distance from solids."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sims.carried.clearance import Clearance
from sims.carried.placing import Placement, eased, find_place, placed
from sims.carried.spline import fit

Floats = npt.NDArray[np.float64]
SECOND = 1_000_000_000


def wandering(seconds: Floats) -> Floats:
    """Return rows of a motion about all axes."""
    phases = np.outer(seconds, [0.9, 1.3, 2.1, 0.7, 1.7, 1.1]) + np.arange(6.0)
    turn = Rotation.from_euler("ZYX", np.sin(phases[:, 3:]) * (1.0, 0.3, 0.3))
    place = np.sin(phases[:, :3]) * (1.5, 1.0, 0.4)
    return np.column_stack([seconds, place, turn.as_quat(scalar_first=True)])


def turn(quaternion: Any) -> Rotation:
    return Rotation.from_quat(quaternion, scalar_first=True)


@settings(max_examples=20, deadline=None)
@given(stamp=st.integers(SECOND, 4 * SECOND))
def test_all_that_it_says_is_the_derivative_of_the_pose(stamp: int) -> None:
    half = 50_000
    before, now, after = (_SPLINE.at(stamp + sign * half) for sign in (-1, 0, 1))
    seconds = 2.0 * half / 1e9
    for value, slope in (("position", "velocity"), ("velocity", "acceleration"),
                         ("angular_velocity", "angular_acceleration")):  # fmt: skip
        difference = np.subtract(getattr(after, value), getattr(before, value)) / seconds
        np.testing.assert_allclose(getattr(now, slope), difference, atol=1e-4)
    rates = (turn(before.orientation).inv() * turn(after.orientation)).as_rotvec() / seconds
    np.testing.assert_allclose(now.angular_velocity, rates, atol=1e-5)
    assert math.hypot(*now.orientation) == pytest.approx(1.0, abs=1e-15)


_SPLINE, _REPORT = fit(wandering(np.arange(0.0, 5.001, 0.01)), 0.05)


def test_gaps_are_bridged_jumps_left_out_and_signs_of_no_matter() -> None:
    seconds = np.arange(0.0, 10.0, 0.01)
    rows = wandering(seconds)
    rows[300, 1:4] += 1.0  # a jump
    rows[400:500, 4:] *= -1.0
    rows = np.delete(rows, slice(600, 650), axis=0)
    spline, report = fit(rows, 0.05)
    ((begin, length),) = report.gaps
    assert (begin, length) == pytest.approx((5.99, 0.51))
    assert report.largest_residual > 0.9
    assert report.residual < 1e-4
    true = wandering(np.array([3.0, 6.25]))
    for row, error in zip(true, (1e-3, 0.05), strict=True):
        moment = spline.at(round(row[0] * 1e9))
        np.testing.assert_allclose(moment.position, row[1:4], atol=error)


def test_it_rests_before_and_after() -> None:
    for stamp, row in ((-SECOND, 0), (6 * SECOND, -1)):
        moment = _SPLINE.at(stamp)
        expected = wandering(np.arange(0.0, 5.001, 0.01))[row, 1:4]
        np.testing.assert_allclose(moment.position, expected, atol=1e-4)
        assert moment.velocity == moment.acceleration == moment.angular_velocity == (0, 0, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r[::20], "8 rows or more a second, found 5"),
        (lambda r: np.delete(r, slice(100, 320), axis=0), "more than 2 s, found one of 2.21"),
        (lambda r: r * ([1] * 4 + [0] * 4) + np.eye(8)[4], "rotation that changes"),
        (lambda r: r[[0, 2, 1, *range(3, 500)]], "rising stamps"),
        (lambda r: r + np.random.default_rng(1).normal(0, 0.1, r.shape) * np.eye(8)[1:4].sum(0),
         "within 0.05 m of a smooth curve"),
    ],
)  # fmt: skip
def test_what_no_body_can_follow_is_refused(change: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit(change(wandering(np.arange(0.0, 5.0, 0.01))), 0.05)


def test_ten_rows_a_second_are_fitted_with_wider_knots() -> None:
    spline, report = fit(wandering(np.arange(0.0, 9.95, 0.1)), 0.05)
    assert report.knots >= 0.105
    true = wandering(np.array([4.32]))[0]
    np.testing.assert_allclose(spline.at(4_320_000_000).position, true[1:4], atol=2e-3)


def test_a_motion_is_eased_in_from_rest() -> None:
    rows = eased(wandering(np.arange(0.0, 5.0, 0.01)), 1.0)
    assert (np.diff(rows[:, 0]) > 0.0).all()
    spline, _ = fit(rows, 0.05)
    assert math.hypot(*spline.at(SECOND // 2).velocity) < 1e-6
    speeds = [math.hypot(*spline.at(k * 10_000_000).acceleration) for k in range(100, 300)]
    assert max(speeds) < 8.0
    late = wandering(np.array([2.0]))[0]
    np.testing.assert_allclose(spline.at(3_500_000_000).position, late[1:4], atol=1e-4)


BOXES = """<mujoco><worldbody><geom type="plane" size="9 9 1"/>
  <geom name="box" type="box" size="1 1 1" pos="4 0 1"/>
  <geom name="pillar" type="cylinder" size="0.5 1" pos="-4 0 1"/>
  <geom name="ball" type="sphere" size="0.5" pos="0 4 1"/>
  <geom name="pill" type="capsule" size="0.5 0.5" pos="0 -4 1"/>
  <geom name="seen" type="box" size="1 1 1" pos="0 0 1" contype="0" conaffinity="0"/>
</worldbody></mujoco>"""


def test_distances_are_those_of_the_shapes() -> None:
    clearance = Clearance(mujoco.MjSpec.from_string(BOXES).compile())
    points = np.array([
        (2.0, 0.0, -1.5), (4.0, 0.2, -1.0), (2.0, -2.0, -1.9), (-4.0, 1.5, -1.5),
        (0.0, -4.0, -2.0), (0.0, 4.0, -2.5), (0.0, 0.0, -0.7), (0.0, 0.0, 0.3),
    ])  # fmt: skip
    expected = [1.0, -0.8, math.sqrt(2.0), 1.0, 0.5, 0.5, 0.7, -0.3]
    np.testing.assert_allclose(clearance.distances(points), expected, atol=1e-12)
    names = [clearance.name_of(geom) for geom in clearance.nearest(points)[1].tolist()]
    assert names[:6] == ["box", "box", "box", "pillar", "ball", "pill"]
    assert names[6:] == ["the ground", "the ground"]


def test_a_place_is_found_where_there_is_room() -> None:
    """Of a line of 3 m, which is longer than half of the room is wide."""
    walls = "".join(
        f'<geom type="box" size="{x} {y} 1.5" pos="{px} {py} 1.5"/>'
        for x, y, px, py in ((2, 0.1, 0, 4), (2, 0.1, 0, -4), (0.1, 4, 2, 0), (0.1, 4, -2, 0))
    )
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{walls}</worldbody></mujoco>")
    clearance = Clearance(spec.compile())
    rows = np.zeros((100, 8))
    rows[:, 0], rows[:, 1], rows[:, 4] = np.arange(100) / 50, np.linspace(0.0, 3.0, 100), 1.0
    place = find_place(rows, clearance)
    least = clearance.distances(placed(rows, place)[:, 1:4]).min()
    assert least > 1.3
    rows[:, 1] *= 4.0
    with pytest.raises(ValueError, match="place: expected room for a motion of 12 x 0 x 0 m"):
        find_place(rows, clearance)


def test_a_placement_keeps_the_motion() -> None:
    rows = wandering(np.arange(0.0, 5.0, 0.01))
    moved = placed(rows, Placement(position=(1.0, 2.0, -3.0), heading=90.0, scale=0.5))
    np.testing.assert_allclose(moved[0, 1:4], (1.0, 2.0, -3.0))
    steps = [np.linalg.norm(np.diff(each[:, 1:4], axis=0), axis=1) for each in (rows, moved)]
    np.testing.assert_allclose(steps[1], steps[0] / 2.0)
    about = turn(moved[:, 4:]) * turn(rows[:, 4:]).inv()
    np.testing.assert_allclose(about.as_rotvec(), np.tile((0, 0, math.pi / 2), (500, 1)), atol=1e-9)
