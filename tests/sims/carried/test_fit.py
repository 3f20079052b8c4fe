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
from sims.carried.spline import MotionSpline, fit

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
@given(stamp=st.integers(SECOND, 4 * SECOND), fitted=st.booleans())
def test_all_that_it_says_is_the_derivative_of_the_pose(stamp: int, fitted: bool) -> None:
    half = 50_000
    spline = _SPLINE if fitted else _UNEVEN
    before, now, after = (spline.at(stamp + sign * half) for sign in (-1, 0, 1))
    seconds = 2.0 * half / 1e9
    for value, slope in (("position", "velocity"), ("velocity", "acceleration"),
                         ("angular_velocity", "angular_acceleration")):  # fmt: skip
        difference = np.subtract(getattr(after, value), getattr(before, value)) / seconds
        np.testing.assert_allclose(getattr(now, slope), difference, atol=1e-4)
    rates = (turn(before.orientation).inv() * turn(after.orientation)).as_rotvec() / seconds
    np.testing.assert_allclose(now.angular_velocity, rates, atol=1e-5)
    assert math.hypot(*now.orientation) == pytest.approx(1.0, abs=1e-15)


_SPLINE, _REPORT = fit(wandering(np.arange(0.0, 5.001, 0.01)), 0.05)
_UNEVEN = MotionSpline(  # of quaternions whose length changes
    0.0, 0.5, np.random.default_rng(2).uniform(0.3, 1.3, (15, 7))
)


@pytest.mark.parametrize(
    ("climb", "rate"), [(0.0, 200.0), (0.3, 10.0), (0.3, 200.0), (0.3, 1000.0)]
)
def test_circle_and_screw_are_those_of_the_formula(climb: float, rate: float) -> None:
    """Of a body that is pitched, so that it rotates about two of its axes."""
    speed, pitch = 0.5, 0.3  # rad/s, rad

    def screw(seconds: Floats) -> Floats:
        angle = speed * seconds
        place = 2.0 * np.cos(angle), 2.0 * np.sin(angle), -1.0 - climb * seconds
        angles = np.column_stack([angle, np.full_like(angle, pitch), 0.0 * angle])
        turns = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
        return np.column_stack([seconds, *place, turns])

    spline, _ = fit(screw(np.arange(0.0, 6.0, 1.0 / rate)), 0.05)
    rates = np.array((-math.sin(pitch), 0.0, math.cos(pitch))) * speed
    for stamp in range(2 * SECOND, 4 * SECOND, 87_654_321):
        moment, true = spline.at(stamp), screw(np.array([stamp / 1e9]))[0]
        x, y, z = true[1:4]
        for value, expected in (
            (moment.position, (x, y, z)),
            ((turn(true[4:]).inv() * turn(moment.orientation)).as_rotvec(), (0.0, 0.0, 0.0)),
            (moment.velocity, (-speed * y, speed * x, -climb)),
            (moment.acceleration, (-(speed**2) * x, -(speed**2) * y, 0.0)),
            (moment.angular_velocity, rates),
            (moment.angular_acceleration, (0.0, 0.0, 0.0)),
        ):
            np.testing.assert_allclose(value, expected, atol=1e-6)


@pytest.mark.parametrize("half", [math.pi, -math.pi])
@pytest.mark.parametrize("rows", [slice(300, 301), slice(300, 304)])
def test_a_mirrored_marker_is_left_out(rows: slice, half: float) -> None:
    """Its rotation is 180° off, at right places; the signs of the others do not depend on it."""
    motion = wandering(np.arange(0.0, 6.0, 0.01))
    mirrored = motion.copy()
    mirrored[rows, 4:] = (turn(motion[rows, 4:]) * Rotation.from_rotvec((0, half, 0))).as_quat(
        scalar_first=True
    )
    spline, report = fit(mirrored, 0.05)
    assert report.turn < 1e-4
    assert report.largest_turn > 1.0
    for moment in (spline.at(stamp) for stamp in range(2 * SECOND, 4 * SECOND, 20_000_000)):
        assert math.hypot(*moment.angular_velocity) < 3.0
    error = turn(spline.at(3 * SECOND).orientation).inv() * turn(motion[300, 4:])
    assert error.magnitude() < 0.02


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
        (lambda r: r[[0, 2, 1, *range(3, 500)]], "rising stamps, found 0.01 s after 0.02 s"),
        (lambda r: r[[0, 1, 1, *range(2, 500)]], "rising stamps, found 0.01 s after 0.01 s"),
        (lambda r: r[:5], "6 poses or more, found 5"),
        (lambda r: np.where(np.arange(500)[:, None] == 7, np.nan, r), "not finite in row 8"),
        (lambda r: np.where(np.eye(500, 8, -7) == 1, np.inf, r), "not finite in row 8"),
        (lambda r: np.column_stack([r[:, :4], Rotation.random(500, rng=1).as_quat()]),
         "rotations that follow each other, found jumps"),
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
    whole = wandering(np.arange(0.0, 5.0, 0.01))[60:]  # after its first EASE / 2 only later
    np.testing.assert_allclose(rows[-len(whole) :] - whole, np.eye(8)[:1] * 1.5 + 0 * whole,
                               atol=1e-9)  # fmt: skip


def test_speed_rises_smoothly_from_rest() -> None:
    """Of a straight motion at 1 m/s: as the integral of 30 s² - 60 s³ + 30 s⁴ says."""
    rows = wandering(np.arange(0.0, 5.0, 0.005))
    rows[:, 1:4] = rows[:, :1] * (1.0, 0.0, 0.0)
    spline, _ = fit(eased(rows, 1.0), 0.05)
    for stamp in range(0, 3 * SECOND, 12_345_678):
        share = min(max(stamp / 1e9 - 1.0, 0.0), 1.0)
        moment = spline.at(stamp)
        speed = share**3 * (10.0 + share * (-15.0 + 6.0 * share))
        np.testing.assert_allclose(moment.velocity, (speed, 0.0, 0.0), atol=2e-3)
        gain = 30.0 * (share * (1.0 - share)) ** 2
        np.testing.assert_allclose(moment.acceleration, (gain, 0.0, 0.0), atol=0.1)


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


def test_of_many_boxes_those_near_many_points_are_the_nearest() -> None:
    """The same bits as of one point after the other, and the first of those that are as near."""
    random = np.random.default_rng(3)
    spec = mujoco.MjSpec.from_string(BOXES)
    for place in [*np.round(random.uniform(-9.0, 9.0, (300, 3))), *random.normal(size=(50, 3))]:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=random.integers(1, 5, 3) / 4.0, pos=place,
            quat=(1.0, 0.0, 0.0, 0.0) if random.random() < 0.7 else random.normal(size=4),
        )  # fmt: skip
    clearance = Clearance(spec.compile())
    points = np.round(random.uniform(-12.0, 12.0, (500, 3)) * 2.0) / 2.0
    distances, geoms = clearance.nearest(points)
    alone = [clearance.nearest(point[None]) for point in points]
    np.testing.assert_array_equal(distances, [distance for (distance,), _ in alone])
    np.testing.assert_array_equal(geoms, [geom for _, (geom,) in alone])


def test_a_distance_from_a_mesh_is_that_of_its_hull() -> None:
    corners = "1 0 0 -1 0 0 0 1 0 0 -1 0 0 0 1 0 0 -1"
    xml = (
        f'<mujoco><asset><mesh name="m" vertex="{corners}"/></asset><worldbody>'
        '<geom type="mesh" mesh="m" pos="2 0 3"/></worldbody></mujoco>'
    )
    clearance = Clearance(mujoco.MjSpec.from_string(xml).compile())
    points = np.array([(2.0, 0.0, -3.0), (3.0, 1.0, -4.0)])
    expected = [-1.0 / math.sqrt(3.0), 2.0 / math.sqrt(3.0)]
    np.testing.assert_allclose(clearance.distances(points), expected, atol=1e-6)


def test_terrain_is_solid() -> None:
    """A slope of 45° up to the north, whose foot is at the origin's south."""
    spec = mujoco.MjSpec()
    ramp = np.tile(np.linspace(0.0, 1.0, 9), (5, 1)).ravel().tolist()
    spec.add_hfield(name="ramp", size=[2, 1, 4, 0.1], nrow=5, ncol=9, userdata=ramp)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ramp")
    clearance = Clearance(spec.compile())
    points = np.array([(0.0, 0.0, -3.0), (1.0, 0.5, -3.0), (1.3, 0.5, -3.1), (0.0, 3.0, -1.0)])
    expected = [1.0 / math.sqrt(2.0), 0.0, -0.2, 2.0]
    np.testing.assert_allclose(clearance.distances(points), expected, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_ray_meets_terrain_nearer_than_its_distance(seed: int) -> None:
    random = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    heights = random.uniform(0.0, 1.0, 35).tolist()
    spec.add_hfield(name="hills", size=[3, 2, 1.5, 0.1], nrow=5, ncol=7, userdata=heights)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hills")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, np.int32)
    for point in random.uniform((-4, -3, 0.1), (4, 3, 3), (10, 3)):
        distance = float(Clearance(model).distances(point[None] * (1.0, -1.0, -1.0))[0])
        for way in (*random.normal(size=(20, 3)), np.array((0.0, 0.0, -1.0))):
            way /= np.linalg.norm(way)
            ray = float(mujoco.mj_ray(model, data, point, way, None, 1, -1, hit))
            assert distance <= 0.0 or ray < 0.0 or ray >= distance - 1e-6
        if distance < 0.0 and (abs(point[:2]) < (3, 2)).all():  # the last ray, down from inside
            above = point + np.array((0.0, 0.0, 5.0))
            top = float(mujoco.mj_ray(model, data, above, way, None, 1, -1, hit))
            assert distance == pytest.approx(top - 5.0, abs=1e-6)


def room(x: float, y: float) -> Clearance:
    """Return the clearance between four walls, without a floor."""
    walls = "".join(
        f'<geom type="box" size="{half} 1.5" pos="{place} 1.5"/>'
        for half, place in ((f"{x} 0.1", f"0 {y}"), (f"{x} 0.1", f"0 {-y}"),
                            (f"0.1 {y}", f"{x} 0"), (f"0.1 {y}", f"{-x} 0"))
    )  # fmt: skip
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{walls}</worldbody></mujoco>")
    return Clearance(spec.compile())


@pytest.mark.parametrize("angle", [0.0, 15.0, 37.0])
def test_a_motion_is_turned_to_where_a_narrow_room_has_most_of_it(angle: float) -> None:
    """Of a line of 3 m, along the middle of a room 2.2 m wide: 1.1 m from its walls."""
    clearance = room(1.2, 3.0)
    ways = np.linspace(0.0, 3.0, 100)
    rows = np.zeros((100, 8))
    rows[:, 0], rows[:, 4] = ways / 2.0, 1.0
    rows[:, 1], rows[:, 2] = (f(math.radians(angle)) * ways for f in (math.cos, math.sin))
    place = find_place(rows, clearance)
    assert clearance.distances(placed(rows, place)[:, 1:4]).min() > 1.0


def test_a_place_is_found_where_there_is_room() -> None:
    """Of a line of 3 m, which is longer than half of the room is wide."""
    clearance = room(2.0, 4.0)
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
    steps = [
        np.linalg.norm(np.diff(trajectory[:, 1:4], axis=0), axis=1) for trajectory in (rows, moved)
    ]
    np.testing.assert_allclose(steps[1], steps[0] / 2.0)
    about = turn(moved[:, 4:]) * turn(rows[:, 4:]).inv()
    np.testing.assert_allclose(about.as_rotvec(), np.tile((0, 0, math.pi / 2), (500, 1)), atol=1e-9)
