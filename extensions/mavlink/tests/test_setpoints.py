"""Each bit of offboard's masks alone, at the level of the set-point that results."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav

import events as ev
from events import Odometry
from events.frames import from_rpy, from_yaw, yaw_of
from visnav_mavlink.setpoints import FASTEST, PLACE_GAIN, ConvertedSetpoint, Offboard
from visnav_mavlink.vehicle import SECOND, Vehicle

ORIGIN = (47.0, 8.0, 400.0)
HERE = (1.0, 2.0, -2.0)
ALL = {
    "x": 4.0, "y": 5.0, "z": -2.5, "vx": 0.1, "vy": 0.2, "vz": 0.3,
    "afx": 0.01, "afy": 0.02, "afz": 0.03, "yaw": 0.5, "yaw_rate": 0.25,
}  # fmt: skip
BITS = {
    "x": 0, "y": 1, "z": 2, "vx": 3, "vy": 4, "vz": 5, "afx": 6, "afy": 7, "afz": 8,
    "yaw": 10, "yaw_rate": 11,
}  # fmt: skip


def vehicle(position: Any = HERE, yaw: float = 0.0) -> Vehicle:
    made = Vehicle(ORIGIN, gps=True)
    move(made, (1.0, 2.0, -0.1))
    move(made, position, yaw)
    return made


def move(vehicle: Vehicle, position: Any, yaw: float = 0.0) -> None:
    still = (0.0, 0.0, 0.0)
    vehicle.set_pose(
        Odometry(
            stamp=0, source="drone", position=position, orientation=from_yaw(yaw),
            linear_velocity=still, angular_velocity=still,
        )
    )  # fmt: skip


def local(ignored: str = "", frame: int = 1, mask: int = 0, **changes: float) -> Any:
    for name in ignored.split():
        mask |= 1 << BITS[name]
    return mav.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, mask, *(ALL | changes).values()
    )


def made(message: Any) -> ConvertedSetpoint:
    result = Offboard(vehicle()).accept(message, 0)
    result.kind(stamp=0, source="mavlink", **result.fields)  # a valid event
    return result


HELD = tuple(
    ALL["v" + axis] + min(max(PLACE_GAIN * (ALL[axis] - here), -FASTEST), FASTEST)
    for axis, here in zip("xyz", HERE, strict=True)
)
"""Velocity with which a coordinate is held at which another one is ignored."""


@pytest.mark.parametrize("nan", [False, True])
@pytest.mark.parametrize("name", BITS)
def test_each_bit_of_a_local_target_alone(name: str, nan: bool) -> None:
    """By its bit as by NaN; all other numbers of the message are followed."""
    nans: dict[str, Any] = {name: math.nan}
    kind, fields, *_ = made(local(**nans) if nan else local(name))
    expected: dict[str, Any] = {
        "position": [ALL[n] for n in ("x", "y", "z")],
        "velocity": [ALL[n] for n in ("vx", "vy", "vz")],
        "acceleration": [ALL[n] for n in ("afx", "afy", "afz")],
        "yaw": 0.0 if name == "yaw" else 0.5,
        "yaw_rate": 0.0 if name == "yaw_rate" else 0.25,
    }
    if name in "xyz":
        assert kind is ev.VelocitySetpoint
        axis = "xyz".index(name)
        velocity = list(HELD)
        velocity[axis] = ALL["v" + name]
        assert fields["velocity"] == pytest.approx(velocity)
        assert fields["frame_id"] == "map"
        return
    assert kind is ev.PositionSetpoint
    if name[0] in "va":
        field = "velocity" if name[0] == "v" else "acceleration"
        expected[field]["xyz".index(name[-1])] = 0.0
    for field, value in expected.items():
        assert fields[field] == pytest.approx(value), field


def test_x_and_y_ignored_beside_velocities_do_not_fly_to_the_origin() -> None:
    velocity = made(local("x y vy afx afy afz yaw yaw_rate")).fields["velocity"]
    assert velocity == pytest.approx((0.1, 0.0, HELD[2]))


def test_a_height_is_held_at_a_velocity_step_after_step() -> None:
    """The set-point is made again from where the vehicle is."""
    drone = vehicle()
    offboard = Offboard(drone)
    assert offboard.accept(local("x y vz afx afy afz yaw yaw_rate", vx=1.0), 0).depends
    x, y, z = HERE
    for step in range(500):
        renew = offboard.renew(step * SECOND // 100)
        assert renew is not None
        vx, vy, vz = renew.fields["velocity"]
        x, y, z = x + 0.01 * vx, y + 0.01 * vy, z + 0.01 * vz
        move(drone, (x, y, z))
    assert (x, y, z) == pytest.approx((HERE[0] + 5.0, HERE[1] + 1.0, ALL["z"]), abs=0.01)
    offboard.accept(local("x y z afx afy afz yaw yaw_rate"), 0)
    assert offboard.renew(1) is None  # a velocity alone stays as it is


def test_a_heading_beside_a_velocity_is_turned_to() -> None:
    drone = vehicle(yaw=3.0)
    offboard, yaw = Offboard(drone), 3.0
    offboard.accept(local("x y z afx afy afz yaw_rate", yaw=-3.0), 0)
    for step in range(500):
        renew = offboard.renew(step * SECOND // 100)
        assert renew is not None
        yaw += 0.01 * renew.fields["yaw_rate"]
        move(drone, HERE, yaw)
    assert math.remainder(yaw + 3.0, math.tau) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (local("x y z vx vy vz"), "expected a position or a velocity, found neither"),
        (local(mask=1 << 9), "forces are not followed"),
        (local("x y z", frame=0), "expected a coordinate_frame of"),
        (local("x y z", frame=20), "expected a coordinate_frame of"),
        (local(frame=8), "expected a place in frame LOCAL_NED, found frame 8"),
        (local(frame=7), "expected a place in frame LOCAL_NED, found frame 7"),
        (local(x=math.inf), "found infinite ones"),
        (local(x=2e4), "expected a place within 10 km of the vehicle's origin, 47.000000"),
    ],
)
def test_what_cannot_be_followed_says_why(message: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Offboard(vehicle()).accept(message, 0)


def test_a_place_in_another_country_says_how_far_it_is() -> None:
    """MAVSDK's examples fly in Zürich, where PX4's simulator is; AirSim's vehicles in Redmond."""
    drone = Vehicle((47.641468, -122.140165, 122.0), gps=True)
    move(drone, HERE)
    with pytest.raises(
        ValueError, match=r"origin, 47\.641468, -122\.140165, .* found it 8,4\d\d km"
    ):
        drone.place_of(5, 473977420.0, 85455940.0, 490.0)
    with pytest.raises(ValueError, match="found it 12 km away"):
        drone.place_of(1, 12e3, 0.0, -2.0)
    with pytest.raises(ValueError, match="found it inf km away"):
        drone.place_of(1, math.inf, 0.0, -2.0)


@pytest.mark.parametrize(
    ("frame", "frame_id"), [(1, "map"), (7, "map"), (8, "heading"), (12, "heading")]
)
def test_velocities_are_of_their_frame(frame: int, frame_id: str) -> None:
    result = made(local("x y z afx afy afz yaw", frame=frame))
    assert result.fields == {
        "velocity": pytest.approx((0.1, 0.2, 0.3)), "yaw_rate": 0.25, "frame_id": frame_id
    }  # fmt: skip
    assert not result.dropped
    assert made(local("x y z", frame=frame)).dropped == "accelerations beside velocities"


@pytest.mark.parametrize("name", BITS)
def test_each_bit_of_a_global_target_alone(name: str) -> None:
    """As of the local one, at the same place: altitudes are above home."""
    drone = vehicle()
    latitude, longitude, _ = drone.place((4.0, 5.0, -2.5))
    values = [latitude, longitude, 2.4, *list(ALL.values())[3:]]
    message = mav.MAVLink_set_position_target_global_int_message(
        0, 1, 1, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, 1 << BITS[name], *values
    )
    result, same = Offboard(drone).accept(message, 0), made(local(name))
    assert result.kind is same.kind
    for field, value in same.fields.items():
        assert result.fields[field] == pytest.approx(value, abs=0.03), field


RATES = (0.1, 0.2, 0.3)


def attitude(mask: int, turn: Any = (1, 0, 0, 0), rates: Any = RATES, thrust: float = 0.5) -> Any:
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, list(turn), *rates, thrust)


@pytest.mark.parametrize("bit", range(3))
@pytest.mark.parametrize("nan", [False, True])
def test_each_bit_of_the_rates_alone(bit: int, nan: bool) -> None:
    rates = [0.0 if axis == bit else RATES[axis] for axis in range(3)]
    given = [math.nan if nan and axis == bit else RATES[axis] for axis in range(3)]
    kind, fields, *_ = made(attitude(128 | (0 if nan else 1 << bit), rates=given))
    assert kind is ev.BodyRateSetpoint
    assert fields["angular_velocity"] == pytest.approx(rates)
    assert fields["thrust"] == 0.5


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (attitude(7 | 128), "expected an attitude or rates, found neither"),
        (attitude(64), "expected a thrust, found it ignored"),
        (attitude(64 | 128), "expected a thrust, found it ignored"),
        (attitude(7, thrust=math.nan), "expected a thrust, found it ignored"),
        (attitude(32), "expected a thrust, found thrust_body"),
        (attitude(7, turn=(0, 0, 0, 0)), "expected a quaternion of length one"),
    ],
)
def test_an_attitude_that_cannot_be_followed_says_why(message: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Offboard(vehicle()).accept(message, 0)


def test_an_attitude_turns_on_at_the_yaw_rate_beside_it() -> None:
    """From its own heading, whether it comes again or not; without a rate its heading counts."""
    offboard = Offboard(vehicle())
    turn = from_rpy(0.1, 0.2, 1.0)
    first = offboard.accept(attitude(3, turn, (0, 0, 0.5)), 0)
    assert first.fields["orientation"] == pytest.approx(turn)
    offboard.renew(SECOND // 2)
    offboard.accept(attitude(3, turn, (0, 0, 0.5)), SECOND)
    later = offboard.renew(2 * SECOND)
    assert later is not None
    assert later.fields["orientation"] == pytest.approx(from_rpy(0.1, 0.2, 2.0), abs=1e-6)
    for message in (attitude(7, turn), attitude(0, turn, (0, 0, 0))):
        still = offboard.accept(message, 3 * SECOND)
        assert yaw_of(still.fields["orientation"]) == pytest.approx(1.0)
        assert not still.depends
    assert made(attitude(0)).dropped == "roll and pitch rates beside an attitude"
