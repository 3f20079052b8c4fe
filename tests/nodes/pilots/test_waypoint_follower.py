"""The tour, flown against a vehicle that does at once what it is told."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar

import msgspec
import pytest

from events import (
    Announcement,
    Command,
    Event,
    Hover,
    Land,
    Landed,
    Odometry,
    PathAnnouncement,
    PilotAnnouncement,
    PositionSetpoint,
    Setpoint,
    Shutdown,
    TakenOff,
    Takeoff,
    Vector3,
    VehicleAnnouncement,
)
from nodes.pilots import WaypointFollower
from runtime import Node, Output, Tick, every, on
from runtime.errors import ConfigError, RefusedError
from runtime.testing import NodeResult, run_nodes, spec


class Vehicle(Node):
    """Is where it is told to be, a second after it has been told to take off or land."""

    odometry = Output(Odometry)
    vehicle_events = Output(Event)
    place: ClassVar[Vector3] = (0.0, 0.0, -0.1)

    def __init__(self) -> None:
        self._place = self.place

    @every(hz=50)
    def tell(self, tick: Tick) -> None:
        self.odometry.send(
            Odometry(
                stamp=tick.stamp,
                source=self.name,
                position=self._place,
                orientation=(1.0, 0.0, 0.0, 0.0),
                linear_velocity=(0.0, 0.0, 0.0),
                angular_velocity=(0.0, 0.0, 0.0),
            )
        )

    @on(PositionSetpoint)
    def follow(self, event: PositionSetpoint) -> None:
        self._place = event.position

    @on(Takeoff)
    def take_off(self, event: Takeoff) -> None:
        x, y, z = self._place
        self._place = (x, y, z - event.altitude)
        self.start(self.later(TakenOff))

    @on(Land)
    def land(self, _: Land) -> None:
        self.start(self.later(Landed))

    async def later(self, event: type[Event]) -> None:
        await self.clock.sleep(1.0)
        self.vehicle_events.send(event(stamp=self.clock.now(), source=self.name))

    def announce(self) -> list[Announcement]:
        return [
            VehicleAnnouncement(
                stamp=0,
                source=self.name,
                mass=1.0,
                max_thrust=20.0,
                control_rate=50.0,
                position=self.place,
                orientation=(1.0, 0.0, 0.0, 0.0),
            )
        ]


def fly(waypoints: Sequence[Sequence[float]], **settings: object) -> NodeResult:
    config = {"waypoints": waypoints} | settings
    return run_nodes([spec(Vehicle, "v"), spec(WaypointFollower, "pilot", config)], duration=60)


SQUARE = [[0, 0, -1.5], [3, 0, -1.5], [3, 3, -2.0], [0, 0, -1.5]]


def test_orders_come_in_order_and_the_run_ends() -> None:
    result = fly(SQUARE)
    orders = [e for e in result.of(Event) if isinstance(e, Takeoff | Hover | Land | Shutdown)]
    assert [type(e) for e in orders] == [Takeoff, Hover, Land, Shutdown]
    assert isinstance(orders[0], Takeoff)
    assert orders[0].stamp == 500_000_000
    assert orders[0].altitude == pytest.approx(1.4)
    assert result.reason == "pilot: flight completed"
    assert result.seconds < 30


def test_setpoints_come_at_the_rate_and_lead_through_the_waypoints() -> None:
    setpoints = fly(SQUARE, rate=20).of(PositionSetpoint)
    steps = {b.stamp - a.stamp for a, b in itertools.pairwise(setpoints)}
    assert steps == {50_000_000}
    for place in SQUARE:
        assert min(math.dist(s.position, place) for s in setpoints) < 0.8
    assert max(math.hypot(*s.velocity) for s in setpoints) <= 1.3 * 1.01


def test_the_vehicle_is_where_it_was_when_the_path_begins() -> None:
    first = fly([[4, 0, -1.5]]).of(PositionSetpoint)[0]
    assert math.dist(first.position, (0, 0, -1.5)) < 0.01
    assert math.hypot(*first.velocity) < 0.03


@pytest.mark.parametrize("waypoints", [[[0, 0, -1.5]], [[0.01, 0, -1.5], [0, 0.01, -1.5]]])
def test_a_tour_of_no_way_takes_off_and_lands(waypoints: list[list[float]]) -> None:
    result = fly(waypoints)
    assert result.reason == "pilot: flight completed"
    assert result.of(PositionSetpoint) == []
    assert len(result.of(Land)) == 1


def test_waypoints_close_together_are_not_lost() -> None:
    close = [[0.04 * k, 0.0, -1.5] for k in range(60)]
    last = fly(close).of(PositionSetpoint)[-1]
    assert math.dist(last.position, close[-1]) < 0.06


def test_a_tour_may_leave_the_run_going() -> None:
    result = fly(SQUARE, end_run=False)
    assert (result.reason, result.of(Shutdown)) == ("duration", [])


def test_it_waits_as_long_as_it_is_told() -> None:
    assert fly(SQUARE, start_delay="2s").of(Takeoff)[0].stamp == 2_000_000_000


def test_it_moves_about_before_it_sets_off_and_flies_an_eight_at_last() -> None:
    eight = {"centre": [1, 0, -1.5], "laps": 2}
    flown = fly([[1, 0, -1.5]], excitation={}, figure_eight=eight).of(PositionSetpoint)
    east = [s.position[1] for s in flown[:300]]
    assert max(east) == pytest.approx(0.25, abs=0.03)
    assert min(east) == pytest.approx(-0.25, abs=0.03)
    north = [s.position[0] for s in flown[300:]]
    assert (max(north), min(north)) == pytest.approx((3, -1), abs=0.1)
    assert sum(a < 2.9 <= b for a, b in itertools.pairwise(north)) == 2


def test_no_waypoints_are_a_mistake_in_the_file() -> None:
    with pytest.raises(ConfigError, match="waypoints: expected at least one, or a figure_eight"):
        fly([])


def test_of_several_vehicles_a_tour_says_which_it_flies() -> None:
    """Otherwise it would begin where the other one is, and end when that has landed."""
    vehicles = [spec(Vehicle, "v"), spec(Vehicle, "w")]
    pilot = spec(WaypointFollower, "pilot", {"waypoints": SQUARE})
    with pytest.raises(RefusedError, match=r'^pilot: cannot work with w: .* write vehicle = "v"'):
        run_nodes([*vehicles, pilot], duration=60)
    narrowed = msgspec.structs.replace(
        pilot, inputs=dict.fromkeys(("vehicle_events", "odometry"), "w")
    )
    assert run_nodes([*vehicles, narrowed], duration=60).reason == "pilot: flight completed"
    named = spec(WaypointFollower, "pilot", {"waypoints": SQUARE, "vehicle": "w"})
    result = run_nodes([*vehicles, named], duration=60)
    assert result.reason == "pilot: flight completed"
    orders = [e for e in result.sent if isinstance(e, Command | Setpoint)]
    assert {e.vehicle for e in orders} == {"w"}
    assert [e.vehicle for e in result.of(PilotAnnouncement)] == ["w"]
    assert [e.vehicle for e in result.of(PathAnnouncement)] == ["w"]
