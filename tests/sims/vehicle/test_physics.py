"""Physics: what is read is true at its instant, whole steps or pieces, and in our frames.

What the wind does to a vehicle: as MuJoCo's fluid model has it, and nothing if there is none.
"""

from __future__ import annotations

from itertools import pairwise
from math import exp
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Vector3
from events import frames as rotations
from events.frames import normalize, rotate, rotate_inverse
from sims.vehicle import (
    STANDING_HEIGHT,
    Physics,
    PhysicsDivergedError,
    Simulation,
    State,
    attach_vehicle,
)
from sims.vehicle.physics import Air, drag, equivalent_box
from sims.worlds.dynamics import STRONGEST, Gust, WindSpec
from tests.sims.vehicle.flight import UP, WORLD, compiled

MS = 1_000_000


def wild(physics: Physics, milliseconds: int, read_every: int) -> list[State]:
    """Throw the vehicle about for a while and onto the floor; look every `read_every` ms."""
    generator = np.random.default_rng(1)
    states = []
    for tick in range(0, milliseconds, 20):
        physics.set_motors(*generator.uniform(0.0, 0.75, 4).tolist())
        for part in range(read_every, 21, read_every):
            physics.advance_to((tick + part) * MS)
            if read_every < 20:
                physics.imu()
                physics.contacts()
        states.append(physics.state())
    return states


def test_time_goes_by_whole_milliseconds() -> None:
    physics = Physics(compiled(), "drone")
    physics.advance_to(2_500_000)
    assert physics.time_ns == 2 * MS
    state = physics.state()
    physics.advance_to(1 * MS)  # the past: nothing happens
    physics.advance_to(2_999_999)
    assert physics.time_ns == 2 * MS
    assert physics.state() == state


@pytest.mark.slow
@pytest.mark.parametrize("read_every", [1, 2, 5, 10])
def test_pieces_and_readings_change_nothing(read_every: int) -> None:
    """In one go or in pieces, sensors read or not, in flight or on the floor: the same bits."""
    whole = wild(Physics(compiled(0.3), "drone"), 2000, 20)
    pieces = wild(Physics(compiled(0.3), "drone"), 2000, read_every)
    assert pieces == whole


def test_reset_goes_back_to_the_start() -> None:
    physics = Physics(compiled(0.3), "drone")
    first = wild(physics, 500, 5)
    physics.reset()
    assert physics.time_ns == 0
    assert wild(physics, 500, 5) == first


def test_at_rest_the_imu_feels_the_ground_push() -> None:
    physics = Physics(compiled(), "drone")
    physics.advance_to(2000 * MS)
    rates, force = physics.imu()
    assert force == pytest.approx((0.0, 0.0, -9.81), abs=1e-3)
    assert rates == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert physics.state().position == pytest.approx((0.0, 0.0, -STANDING_HEIGHT), abs=1e-3)


def test_a_settled_vehicle_rests_from_the_first_instant() -> None:
    """Feet that only just touch the ground carry nothing: the IMU would feel a free fall."""
    physics = Physics(compiled(yaw=0.3), "drone")
    ball = physics.data.qpos[:7].tolist()
    physics.settle()
    assert physics.time_ns == 0
    assert physics.data.qpos[:7].tolist() == ball
    before = physics.state()
    assert before.position == pytest.approx((0.0, 0.0, -STANDING_HEIGHT), abs=1e-3)
    for stamp in range(0, 500 * MS, MS):
        physics.advance_to(stamp)
        rates, force = physics.imu()
        assert force == pytest.approx((0.0, 0.0, -9.81), abs=1e-3)
        assert rates == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert physics.state().position == pytest.approx(before.position, abs=1e-6)


def test_what_does_not_stand_does_not_settle() -> None:
    physics = Physics(compiled(UP), "drone")
    before = physics.data.qpos.tolist()
    physics.settle()
    assert physics.data.qpos.tolist() == before


@pytest.mark.slow
@given(
    motors=st.tuples(*[st.floats(0.0, 1.0)] * 4),
    height=st.sampled_from([0.12, 0.3, UP]),
    steps=st.integers(1, 400),
    offsets=st.lists(st.integers(0, MS), min_size=1, max_size=4),
)
@settings(max_examples=20, deadline=None)
def test_between_two_steps_the_state_is_on_the_way_from_one_to_the_other(
    motors: tuple[float, float, float, float], height: float, steps: int, offsets: list[int]
) -> None:
    """In flight and in contact; a whole step later it is that of the step; and looking changes
    nothing."""
    physics, plain = (Physics(compiled(height), "drone") for _ in range(2))
    for body in (physics, plain):
        body.set_motors(*motors)
        body.advance_to(steps * MS)
    now, qvel_before = physics.state(), plain.data.qvel.copy()
    asked = {offset: physics.state_at(steps * MS + offset) for offset in [0, MS, *offsets]}
    assert asked[0][0] == now
    plain.advance_to((steps + 1) * MS)
    physics.advance_to((steps + 1) * MS)
    assert physics.state() == plain.state()
    after, qpos, qvel = asked[MS]
    np.testing.assert_allclose(qpos, plain.data.qpos, atol=1e-12)
    gained = plain.data.qvel - qvel_before
    np.testing.assert_allclose(qvel - asked[0][2], gained, atol=1e-12)
    for offset, (state, _, _) in asked.items():
        for field in ("position", "velocity", "angular_velocity"):
            start, end = np.array(getattr(now, field)), np.array(getattr(after, field))
            expected = start + offset / MS * (end - start)
            np.testing.assert_allclose(getattr(state, field), expected, atol=1e-9)


def test_the_past_and_the_far_future_are_not_between_two_steps() -> None:
    physics = Physics(compiled(UP), "drone")
    physics.advance_to(5 * MS)
    for stamp in (5 * MS - 1, 6 * MS + 1):
        with pytest.raises(ValueError, match=f"found {stamp} ns"):
            physics.state_at(stamp)


def test_in_free_fall_the_imu_feels_nothing() -> None:
    physics = Physics(compiled(UP), "drone")
    physics.advance_to(20 * MS)
    assert physics.imu()[1] == pytest.approx((0.0, 0.0, 0.0), abs=2e-3)
    assert physics.state().velocity == pytest.approx((0.0, 0.0, 9.81 * 0.0205), abs=1e-4)


def test_hover_thrust_carries_the_weight() -> None:
    physics = Physics(compiled(UP), "drone")
    share = physics.parameters.hover_thrust
    physics.data.act[:] = share
    physics.set_motors(share, share, share, share)
    physics.advance_to(1000 * MS)
    assert physics.state().velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert physics.imu()[1][2] == pytest.approx(-9.81)


def test_motors_answer_as_a_lag_of_40_ms() -> None:
    physics = Physics(compiled(UP), "drone")
    physics.set_motors(0.5, 0.5, 0.5, 0.5)
    physics.advance_to(40 * MS)
    parameters = physics.parameters
    thrust = -physics.imu()[1][2] * parameters.mass
    assert thrust == pytest.approx(0.5 * parameters.max_thrust * (1.0 - exp(-1.0)), rel=2e-3)


@pytest.mark.parametrize(
    ("motors", "axis"),
    [((0.5, 0.5, 0.4, 0.4), 2), ((0.4, 0.5, 0.5, 0.4), 0), ((0.5, 0.4, 0.5, 0.4), 1)],
    ids=["yaw", "roll", "pitch"],
)
def test_motors_turn_the_vehicle_the_right_way(
    motors: tuple[float, float, float, float], axis: int
) -> None:
    """The pair 1, 2 turns the nose right; the left pair rolls right; the front pair pitches up."""
    physics = Physics(compiled(UP), "drone")
    physics.set_motors(*motors)
    physics.advance_to(100 * MS)
    rates = physics.state().angular_velocity
    assert rates[axis] > 0.02
    assert all(abs(rate) < 0.01 * rates[axis] for i, rate in enumerate(rates) if i != axis)


def test_what_moves_is_told_of_its_instant_and_not_of_half_a_step_before() -> None:
    """Velocities, rates and specific force, against positions a step before and after; MuJoCo's
    own rates, which are 0.5 ms old, are beside that."""
    physics = Physics(compiled(UP, 0.7), "drone")
    generator = np.random.default_rng(3)
    states, felt, late = [], [], []
    for tick in range(400):
        if tick % 10 == 1:
            physics.set_motors(*generator.uniform(0.2, 0.8, 4).tolist())
        physics.advance_to(tick * MS)
        states.append(physics.state())
        felt.append(physics.imu())
        late.append(physics.data.qvel[6:].copy())
    for k in range(1, 399):
        before, now, after = states[k - 1 : k + 2]
        a, b, c = (np.array(state.position) for state in (before, now, after))
        assert now.velocity == pytest.approx((c - a) / 2e-3, abs=1e-8)
        force = rotations.rotate(now.orientation, felt[k][1])
        assert np.add(force, (0, 0, 9.81)) == pytest.approx((a - 2 * b + c) / 1e-6, abs=1e-6)
        turn = rotations.multiply(rotations.inverse(before.orientation), after.orientation)
        assert felt[k][0] == now.angular_velocity
        assert now.angular_velocity == pytest.approx(np.array(turn[1:]) / 1e-3, abs=1e-4)
    assert (
        max(np.abs(s.angular_velocity[0] - v[3]) for s, v in zip(states, late, strict=True)) > 0.01
    )


def test_momentum_and_energy_are_kept_without_air() -> None:
    physics = Physics(compiled(UP), "drone")
    model = physics.model
    density, viscosity = model.opt.density, model.opt.viscosity
    model.opt.density = model.opt.viscosity = 0.0
    try:
        physics.data.qvel[6:] = (1.0, 0.5, 2.0, 3.0, -2.0, 4.0)  # after the ball's six
        before = _momentum_and_energy(physics)
        physics.advance_to(500 * MS)
        after = _momentum_and_energy(physics)
    finally:
        model.opt.density, model.opt.viscosity = density, viscosity
    assert after[0] == pytest.approx(before[0], rel=0.01, abs=1e-3)
    assert after[1] == pytest.approx(before[1], abs=1e-3)


def _momentum_and_energy(physics: Physics) -> tuple[Vector3, float]:
    state = physics.state()
    parameters = physics.parameters
    spin = [j * w for j, w in zip(parameters.inertia, state.angular_velocity, strict=True)]
    momentum = rotations.rotate(state.orientation, (spin[0], spin[1], spin[2]))
    energy = (
        0.5 * parameters.mass * sum(v * v for v in state.velocity)
        + 0.5 * sum(s * w for s, w in zip(spin, state.angular_velocity, strict=True))
        - parameters.mass * 9.81 * (state.position[2] + UP)
    )
    return momentum, energy


def test_air_slows_the_vehicle_down() -> None:
    """Falling from rest, the drag nears 0.5 ρ v² A with A of about 0.08 m²."""
    physics = Physics(compiled(UP), "drone")
    physics.advance_to(1500 * MS)
    speed = physics.state().velocity[2]
    drag = -physics.imu()[1][2] * physics.parameters.mass
    assert drag / (0.5 * 1.225 * speed * speed) == pytest.approx(0.08, rel=0.1)


def test_flying_into_a_wall_is_a_contact_with_it() -> None:
    physics = Physics(compiled(3.0), "drone")
    physics.data.qvel[6] = 8.0
    while not (contacts := physics.contacts()):
        assert physics.time_ns < 1000 * MS
        physics.advance_to(physics.time_ns + 1 * MS)
    assert physics.touching()
    for contact in contacts:
        assert contact.other == "wall"
        assert contact.normal == pytest.approx((-1.0, 0.0, 0.0), abs=0.02)
        assert contact.position[0] == pytest.approx(4.0, abs=0.02)
        assert contact.speed == pytest.approx(physics.state().velocity[0], rel=0.05)


def test_being_hit_from_above_counts_the_speed_of_both() -> None:
    """The other is a moving body whose geom has no name: it is called by its body's."""
    physics = Physics(compiled(10.0), "drone")
    physics.data.qpos[:3] = (0.0, 0.0, 10.12)
    physics.data.qvel[:3] = (0.0, 0.0, -2.0)
    physics.data.qvel[6:9] = (0.0, 0.0, 1.0)
    while not (contacts := physics.contacts()):
        assert physics.time_ns < 100 * MS
        physics.advance_to(physics.time_ns + 1 * MS)
    (contact,) = contacts
    assert contact.other == "ball"
    assert contact.normal == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)
    assert contact.speed == pytest.approx(3.0, rel=0.02)


def test_what_others_touch_is_not_ours() -> None:
    """The ball lies on the floor while the vehicle is in the air."""
    physics = Physics(compiled(UP), "drone")
    physics.advance_to(500 * MS)
    physics.imu()
    assert physics.data.ncon > 0
    assert not physics.touching()
    assert physics.contacts() == []


def test_the_state_comes_as_copies() -> None:
    physics = Physics(compiled(), "drone")
    _, qpos, qvel = physics.state_at(0)
    qpos[:] = qvel[:] = 7.0
    assert (qpos.shape, qvel.shape) == ((physics.model.nq,), (physics.model.nv,))
    assert physics.state().position == pytest.approx((0.0, 0.0, -STANDING_HEIGHT))
    assert physics.state().velocity == pytest.approx((0.0, 0.0, 0.5e-3 * 9.81))


def test_a_state_that_is_not_finite_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the present folder
    physics = Physics(compiled(UP), "drone")
    physics.advance_to(100 * MS)
    physics.data.qvel[8] = float("nan")
    with pytest.raises(PhysicsDivergedError, match=r"0\.105 s"):
        physics.advance_to(105 * MS)


COMPONENT = st.floats(-15.0, 15.0)
VECTOR = st.tuples(COMPONENT, COMPONENT, COMPONENT)


def windy(spec: WindSpec, height: float = UP, seed: int = 1) -> tuple[Physics, Air]:
    """Return a vehicle in wind, in a model of its own."""
    world = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(world, "drone", (0.0, 0.0, -height), 0.0)
    model = world.compile()
    air = Air(model, spec, ["drone"], np.random.default_rng(seed))
    return Physics(Simulation(model, [air]), "drone"), air


@settings(max_examples=50, deadline=None)
@given(wind=VECTOR, speed=VECTOR, turn=st.tuples(COMPONENT, COMPONENT, COMPONENT, COMPONENT))
def test_our_drag_is_that_of_mujoco(
    wind: Vector3, speed: Vector3, turn: tuple[float, float, float, float]
) -> None:
    if sum(component * component for component in turn) < 1e-2:
        return
    model: Any = compiled(UP)
    data: Any = mujoco.MjData(model)
    body = model.body("drone/base_link").id
    data.qvel[6:9] = speed
    data.qpos[10:14] = turn = normalize(turn)
    before = model.opt.wind.copy()
    model.opt.wind[:] = wind
    mujoco.mj_forward(model, data)
    model.opt.wind[:] = before
    through = tuple(a - b for a, b in zip(speed, wind, strict=True))
    ours = rotate(turn, drag(model, equivalent_box(model, body), rotate_inverse(turn, through)))  # type: ignore[arg-type]
    assert ours == pytest.approx(data.qfrc_fluid[6:9].tolist(), abs=1e-9)


def test_no_wind_changes_no_bit() -> None:
    plain = wild(Physics(compiled(0.3), "drone"), 1500, 5)
    world = mujoco.MjSpec.from_string(WORLD)
    attach_vehicle(world, "drone", (0.0, 0.0, -0.3), 0.0)
    model = world.compile()
    air = Air(model, WindSpec(), ["drone"], np.random.default_rng(1))
    assert wild(Physics(Simulation(model, [air]), "drone"), 1500, 5) == plain


def test_wind_pushes_with_a_plausible_force() -> None:
    """5 m/s from the front on 0.035 m² with a drag coefficient of 1: 0.54 N."""
    physics, air = windy(WindSpec(velocity=(-5.0, 0.0, 0.0)))
    physics.advance_to(1 * MS)
    before = physics.state().velocity
    physics.advance_to(101 * MS)
    after = physics.state().velocity
    force = (before[0] - after[0]) / 0.1 * physics.parameters.mass
    assert force == pytest.approx(0.55, abs=0.06)
    assert air.velocity_at("drone") == (-5.0, 0.0, 0.0)
    assert after[1] == pytest.approx(0.0, abs=0.05)


def test_a_vehicle_without_motors_drifts_with_the_wind() -> None:
    physics, _ = windy(WindSpec(velocity=(3.0, -4.0, 0.0)), height=300.0)
    speeds = []
    for seconds in (2, 4, 6):
        physics.advance_to(seconds * 1000 * MS)
        speeds.append(physics.state().velocity[:2])
    for (vx, vy), (later_x, later_y) in pairwise([(0.0, 0.0), *speeds, (3.0, -4.0)]):
        assert vx < later_x
        assert vy > later_y


def test_a_gust_comes_and_goes_on_top_of_the_mean() -> None:
    physics, air = windy(
        WindSpec(velocity=(1.0, 0.0, 0.0), gusts=(Gust(velocity=(0.0, 6.0, 0.0)),)), height=100.0
    )
    felt = {}
    for ms in (0, 500, 1000, 2500):
        physics.advance_to(ms * MS)
        felt[ms] = air.velocity_at("drone")
    assert felt == {
        0: pytest.approx((1.0, 0.0, 0.0)),
        500: pytest.approx((1.0, 3.0, 0.0)),
        1000: pytest.approx((1.0, 6.0, 0.0)),
        2500: pytest.approx((1.0, 0.0, 0.0)),
    }


def test_turbulence_depends_on_its_source_and_on_nothing_else() -> None:
    spec = WindSpec(velocity=(4.0, 0.0, 0.0), turbulence="severe")
    flights = []
    for seed, piece in ((1, 1), (1, 7), (2, 1)):
        physics, air = windy(spec, seed=seed)
        for ms in range(0, 700, piece):
            physics.advance_to(ms * MS)
        physics.advance_to(700 * MS)
        flights.append((physics.state(), air.velocity_at("drone")))
    assert flights[0] == flights[1]
    assert flights[0] != flights[2]
    assert abs(flights[0][1][2]) > 0.01


def test_a_wind_that_is_set_holds_from_then_on() -> None:
    physics, air = windy(WindSpec(velocity=(1.0, 0.0, 0.0)))
    physics.advance_to(10 * MS)
    air.velocity = (0.0, 2.0, 0.0)
    physics.advance_to(11 * MS)
    assert air.velocity_at("drone") == (0.0, 2.0, 0.0)
    assert physics.model.opt.wind.tolist() == [0.0, -2.0, 0.0]


def test_the_strongest_wind_carries_nothing_through_a_wall_unseen() -> None:
    """Faster wind is refused: at 500 m/s the vehicle was behind the wall one step later."""
    for wind in ((0.0, 50.1, 0.0), (float("nan"), 0.0, 0.0)):
        with pytest.raises(ValueError, match="velocity: expected up to 50 m/s"):
            WindSpec(velocity=wind)
    with pytest.raises(ValueError, match="found 60 m/s"):
        WindSpec(velocity=(30.0, 0.0, 0.0), gusts=(Gust(velocity=(0.0, 30.0, 0.0)),))
    physics, _ = windy(WindSpec(velocity=(STRONGEST, 0.0, 0.0)), height=3.0)
    touched = set()
    for millisecond in range(1000):
        physics.advance_to(millisecond * MS)
        touched |= {contact.other for contact in physics.contacts()}
    assert "wall" in touched
