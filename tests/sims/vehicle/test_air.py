"""What the wind does to a vehicle: as MuJoCo's fluid model has it, and nothing if there is none."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from events import Vector3
from events.frames import normalize, rotate, rotate_inverse
from sims.vehicle import Physics, Simulation, attach_vehicle
from sims.vehicle.air import Air, drag, equivalent_box
from sims.worlds.wind import STRONGEST, Gust, WindSpec
from tests.sims.vehicle.flight import UP, WORLD, compiled
from tests.sims.vehicle.test_physics import MS, wild

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
    if sum(each * each for each in turn) < 1e-2:
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
        touched |= {each.other for each in physics.contacts()}
    assert "wall" in touched
