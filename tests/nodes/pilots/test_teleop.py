"""Flying by hand: which velocities and commands come of which keys."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from events import (
    Arm,
    Command,
    Disarm,
    Event,
    Hover,
    KeyPressed,
    KeyReleased,
    Land,
    PilotAnnouncement,
    Setpoint,
    Shutdown,
    Takeoff,
    Vector3,
    VelocitySetpoint,
)
from nodes.pilots.teleop import Teleop, approach
from runtime.errors import ConfigError
from runtime.testing import NodeResult, run_node

BRISK = {"acceleration": 1000.0}
"""Speeds up within one tick, for tests that are not about that."""


def fly(*keys: str, config: dict[str, Any] | None = None, duration: float = 1.0) -> NodeResult:
    """Run a teleop; ``"0.1 +w"`` presses w at 0.1 s, ``"0.5 -w"`` lets it come up at 0.5 s."""
    inputs: list[Event] = []
    for text in keys:
        seconds, key = text.split()
        event = KeyPressed if key[0] == "+" else KeyReleased
        inputs.append(event(stamp=round(float(seconds) * 1e9), source="keyboard", key=key[1:]))
    result = run_node(Teleop, inputs=inputs, config=config, duration=duration, name="teleop")
    assert isinstance(result.sent.pop(0), PilotAnnouncement)
    return result


def velocities(result: NodeResult) -> list[tuple[float, float, float, float]]:
    """Return x, y, z, yaw rate of each set-point that was sent."""
    return [(*s.velocity, s.yaw_rate) for s in result.of(VelocitySetpoint)]


def held(*keys: str) -> set[tuple[float, float, float, float]]:
    """Return the set-points of a run in which keys are held to the end, without the last stop."""
    return set(velocities(fly(*keys, config=BRISK, duration=0.2))[:-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("w", (2.0, 0.0, 0.0, 0.0)),
        ("s", (-2.0, 0.0, 0.0, 0.0)),
        ("a", (0.0, -2.0, 0.0, 0.0)),
        ("d", (0.0, 2.0, 0.0, 0.0)),
        ("space", (0.0, 0.0, -1.0, 0.0)),
        ("r", (0.0, 0.0, -1.0, 0.0)),
        ("left_shift", (0.0, 0.0, 1.0, 0.0)),
        ("f", (0.0, 0.0, 1.0, 0.0)),
        ("q", (0.0, 0.0, 0.0, -1.0)),
        ("e", (0.0, 0.0, 0.0, 1.0)),
    ],
)
def test_each_key_moves_along_its_axis(key: str, expected: tuple[float, ...]) -> None:
    """x is ahead, y to the right, z down and yaw clockwise, in the heading frame."""
    assert held(f"0.01 +{key}") == {expected}
    result = fly(f"0.01 +{key}")
    assert {s.frame_id for s in result.of(VelocitySetpoint)} == {"heading"}
    assert {s.source for s in result.of(VelocitySetpoint)} == {"teleop"}


def test_keys_held_together_add_up() -> None:
    """Ahead, up and a turn at once: a velocity on both axes, and the yaw rate."""
    assert held("0.01 +w", "0.01 +space", "0.01 +e") == {(2.0, 0.0, -1.0, 1.0)}


def test_a_diagonal_is_no_faster() -> None:
    """Two level keys share the speed."""
    (velocity,) = held("0.01 +w", "0.01 +d")
    assert velocity == pytest.approx((math.sqrt(2), math.sqrt(2), 0.0, 0.0))


def test_opposite_keys_cancel() -> None:
    """Left and right together are neither, and what else is held goes on."""
    assert held("0.01 +a", "0.01 +d") == {(0.0, 0.0, 0.0, 0.0)}
    assert held("0.01 +a", "0.01 +d", "0.01 +w") == {(2.0, 0.0, 0.0, 0.0)}


def test_two_keys_for_one_motion_count_once() -> None:
    """Both keys for up are no faster than one, and either one alone keeps it up."""
    assert held("0.01 +space", "0.01 +r", "0.05 -space") == {(0.0, 0.0, -1.0, 0.0)}


def test_the_last_release_stops_once_and_at_once() -> None:
    """Letting go of one of two keys goes on with the other; of both, one stop, then nothing."""
    result = fly("0.01 +w", "0.01 +a", "0.2 -w", "0.41 -a", config=BRISK)
    sent = velocities(result)
    assert sent.count((0.0, 0.0, 0.0, 0.0)) == 1
    assert sent[-2:] == [(0.0, -2.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)]
    assert result.of(VelocitySetpoint)[-1].stamp == 410_000_000


def test_nothing_is_said_while_no_key_is_touched() -> None:
    """Other nodes' set-points are not fought over, nor after keys that mean nothing."""
    assert fly("0.1 +x", "0.2 -x", "0.3 -w").sent == []


def test_set_points_come_at_the_rate() -> None:
    """A key held for a second makes as many set-points as the rate says."""
    result = fly("0.001 +w", config={"rate": 20}, duration=1.0)
    stamps = [s.stamp for s in result.of(VelocitySetpoint)][:-1]  # the last is the stop at the end
    assert {b - a for a, b in itertools.pairwise(stamps)} == {50_000_000}
    assert 19 <= len(stamps) <= 20


def test_speed_comes_gradually_and_reaches_the_goal() -> None:
    """Neither starting nor reversing asks for more than the acceleration."""
    config = {"acceleration": 5.0, "rate": 50, "speed": 1.0}
    sent = velocities(fly("0.01 +w", "0.6 +s", "0.61 -w", "1.5 -s", config=config, duration=2.0))
    ahead = [x for x, *_ in sent[:-1]]
    steps = [b - a for a, b in itertools.pairwise([0.0, *ahead])]
    assert max(map(abs, steps)) == pytest.approx(5.0 / 50)
    assert max(ahead) == 1.0
    assert min(ahead) == -1.0


@pytest.mark.parametrize(
    ("key", "event"),
    [("t", Takeoff), ("l", Land), ("h", Hover), ("m", Arm), ("backspace", Disarm)],
)
def test_commands_are_sent_once_when_their_key_goes_down(key: str, event: type[Event]) -> None:
    """A command is said once, at the time of its key, and coming up says nothing."""
    (said,) = fly(f"0.1 +{key}", f"0.2 -{key}").sent
    assert type(said) is event
    assert (said.stamp, said.source) == (100_000_000, "teleop")


def test_take_off_climbs_to_the_altitude_that_is_set() -> None:
    """The altitude setting goes into the command."""
    (takeoff,) = fly("0.1 +t", config={"altitude": 4.0}).of(Takeoff)
    assert takeoff.altitude == 4.0


def test_a_command_ends_the_movement_that_keys_held_ask_for() -> None:
    """Landing is not undone by a key still held, nor by letting go of it; a new press moves."""
    keys = ["0.01 +w", "0.2 +l", "0.3 -w", "0.5 +d", "0.6 -d"]
    result = fly(*keys, config=BRISK)
    land = result.sent.index(result.of(Land)[0])
    after = [e for e in result.sent[land + 1 :] if isinstance(e, VelocitySetpoint)]
    assert min(e.stamp for e in after) >= 500_000_000
    assert {e.velocity for e in after} == {(0.0, 2.0, 0.0), (0.0, 0.0, 0.0)}


def test_escape_ends_the_run() -> None:
    """Escape asks for the end of the run, long before its time is over."""
    result = fly("0.1 +escape", duration=60.0)
    assert len(result.of(Shutdown)) == 1
    assert result.seconds == pytest.approx(0.1)
    assert "quit by key" in result.reason


def test_a_run_that_ends_with_keys_held_says_stop() -> None:
    """Whoever listens until the end is left with a stop."""
    assert velocities(fly("0.01 +w", config=BRISK, duration=0.2))[-1] == (0.0, 0.0, 0.0, 0.0)


def test_keys_can_be_bound_anew() -> None:
    """Bound keys replace the default ones, others stay, and an empty text unbinds."""
    keys = {"forward": "up", "back": "kp_2 down", "hover": ""}
    config = BRISK | {"keys": keys}
    assert set(velocities(fly("0.01 +up", config=config, duration=0.1))) >= {(2.0, 0.0, 0.0, 0.0)}
    assert (-2.0, 0.0, 0.0, 0.0) in velocities(fly("0.01 +kp_2", config=config))
    assert (0.0, -2.0, 0.0, 0.0) in velocities(fly("0.01 +a", config=config))
    assert fly("0.01 +w", "0.1 +h", config=config).sent == []


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"forwrd": "i"}, "node.keys: found .*'forwrd' .did you mean 'forward'"),
        ({"up": "spce"}, "keys: expected names of keys, .* for up; there is no 'spce' .*'space'"),
        ({"takeoff": "w"}, "keys: expected a key of its own for takeoff; 'w' is for forward"),
        ({"up": 7}, "keys.up: expected a text, found 7"),
    ],
)
def test_wrong_bindings_are_told_with_their_place(keys: dict[str, Any], expected: str) -> None:
    """Unknown actions, unknown keys and keys used twice: where, what was expected and found."""
    with pytest.raises(ConfigError, match=expected):
        run_node(Teleop, config={"keys": keys})


@pytest.mark.parametrize("setting", ["speed", "climb", "yaw_rate", "acceleration", "rate"])
def test_settings_must_be_positive(setting: str) -> None:
    """A vehicle that cannot move is a mistake in the file."""
    with pytest.raises(ConfigError, match=setting):
        run_node(Teleop, config={setting: 0})


@pytest.mark.parametrize(
    ("goal", "expected"),
    [((3.0, 4.0, 0.0), (0.6, 0.8, 0.0)), ((0.3, 0.4, 0.0), (0.3, 0.4, 0.0)), ((0.0,) * 3,) * 2],
)
def test_approach_goes_straight_and_not_too_far(goal: Vector3, expected: Vector3) -> None:
    """A far goal is one step nearer on the straight line, a near one is reached."""
    assert approach((0.0, 0.0, 0.0), goal, 1.0) == pytest.approx(expected)


def test_all_orders_name_the_vehicle_that_is_flown() -> None:
    result = fly("0.1 +t", "0.2 -t", "0.3 +w", config={"vehicle": "b"})
    assert {e.vehicle for e in result.sent if isinstance(e, Command | Setpoint)} == {"b"}
    assert [type(e) for e in result.sent][:2] == [Takeoff, VelocitySetpoint]
