"""The past of a simulation: exact on milliseconds, between them as it was stepped."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sims.vehicle import Physics
from tests.sims.vehicle.flight import UP, compiled
from tests.sims.vehicle.test_physics import MS, wild


def flown(seconds: float = 0.1) -> tuple[Physics, list[tuple[list[float], list[float]]]]:
    """Return a vehicle thrown about for 200 ms, and the state of each of its milliseconds."""
    physics = Physics(compiled(UP), "drone")
    physics.simulation.keep(seconds)
    states = []
    generator = np.random.default_rng(3)
    for step in range(201):
        physics.advance_to(step * MS)
        if step % 10 == 0:
            physics.set_motors(*generator.uniform(0.0, 1.0, 4).tolist())
        qpos, qvel = physics.data.qpos.tolist(), physics.data.qvel.tolist()
        states.append((qpos, qvel))
    return physics, states


def test_it_is_exact_on_every_kept_millisecond() -> None:
    physics, states = flown()
    for step in range(100, 200):
        qpos, qvel = physics.simulation.past(step * MS)
        assert qpos.tolist() == states[step][0]
        assert qvel == pytest.approx(np.mean([states[step][1], states[step + 1][1]], axis=0))


@settings(max_examples=40, deadline=None)
@given(st.integers(100 * MS, 200 * MS - 1))
def test_between_milliseconds_it_lies_on_the_way_from_one_to_the_next(stamp: int) -> None:
    physics, states = FLOWN
    step, rest = divmod(stamp, MS)
    (before, _), (after, next_qvel) = states[step], states[step + 1]
    qpos, qvel = physics.simulation.past(stamp)
    expected = np.array(before)
    mujoco.mj_integratePos(physics.model, expected, np.array(next_qvel), rest * 1e-9)
    assert qpos.tolist() == expected.tolist()
    low, high = np.minimum(before, after), np.maximum(before, after)
    assert (qpos >= low - 1e-9).all()
    assert (qpos <= high + 1e-9).all()
    assert np.isfinite(qvel).all()


FLOWN = flown()


def test_a_fraction_of_a_step_ahead_is_what_the_physics_says() -> None:
    physics, _ = flown()
    stamp = physics.time_ns + 300_000
    assert physics.simulation.past(stamp)[0].tolist() == physics.state_at(stamp)[1].tolist()


def test_before_the_start_all_is_as_at_the_start() -> None:
    physics, states = flown(1.0)
    assert physics.simulation.past(-20 * MS)[0].tolist() == states[0][0]


def test_it_keeps_no_more_than_was_asked_for() -> None:
    physics, _ = flown(0.05)
    physics.simulation.keep(0.01)  # less than before: nothing is lost
    physics.simulation.past(150 * MS)
    with pytest.raises(ValueError, match=r"history: expected a time from .* found 100000000 ns"):
        physics.simulation.past(100 * MS)
    with pytest.raises(ValueError, match="expected a time of"):
        physics.simulation.past(250 * MS)


def test_keeping_a_past_changes_no_bit_of_the_flight() -> None:
    plain, kept = (Physics(compiled(0.3), "drone") for _ in range(2))
    kept.simulation.keep(0.2)
    assert wild(plain, 1000, 20) == wild(kept, 1000, 20)
    with pytest.raises(ValueError, match="history: expected a time"):
        plain.simulation.past(100 * MS)


def test_a_reset_forgets_the_past() -> None:
    physics, states = flown()
    physics.reset()
    assert physics.simulation.past(-5 * MS)[0].tolist() == states[0][0]
    with pytest.raises(ValueError, match="expected a time of"):
        physics.simulation.past(100 * MS)
