"""Scripted flights: by the true pose, and by what an estimator says of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np
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
    PlannedPose,
    PoseEstimate,
    PositionSetpoint,
    Setpoint,
    Shutdown,
    TakenOff,
    Takeoff,
    Vector3,
    VehicleAnnouncement,
)
from nodes.pilots import VisualPilot, WaypointFollower
from runtime import Node, NodeConfig, Output, Tick, every, on
from runtime.errors import ConfigError, RefusedError
from runtime.testing import NodeResult, run_nodes, spec
from sims.multirotor import Multirotor


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


def test_waypoints_are_passed_lap_by_lap_and_the_way_back_is_announced() -> None:
    there = [[1, 0, -1.5], [3, 0, -1.5]]
    result = fly(there, laps=3)
    north = [s.position[0] for s in result.of(PositionSetpoint)]
    assert sum(a < 2 <= b for a, b in itertools.pairwise(north)) == 3
    assert north[-1] == pytest.approx(3, abs=0.05)
    (path,) = result.of(PathAnnouncement)
    assert path.waypoints == ((1, 0, -1.5), (3, 0, -1.5), (1, 0, -1.5))


def test_no_waypoints_are_a_mistake_in_the_file() -> None:
    with pytest.raises(ConfigError, match="waypoints: expected at least one, or a figure_eight"):
        fly([])
    with pytest.raises(ConfigError, match="laps: expected waypoints to pass 2 times, found none"):
        fly([], figure_eight={"centre": [1, 0, -1.5]}, laps=2)


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


SECOND = 1_000_000_000
FLOOR = """<mujoco><worldbody>
  <light pos="0 0 4"/><geom name="floor" type="plane" size="9 9 1"/>
</worldbody></mujoco>"""
WAYPOINTS = [[0.0, 0.0, -1.5], [3.0, 0.0, -1.5], [3.0, 2.5, -1.5]]


class OracleConfig(NodeConfig):
    """How wrong it is.

    Attributes:
        shift: Metres that it is off, once the flight is under way.
        blind: Seconds from, and to, which it says nothing.
        anew: Seconds from, and to, which it speaks in a frame that begins where it is then.
    """

    shift: Vector3 = (0.0, 0.0, 0.0)
    blind: tuple[float, float] = (0.0, 0.0)
    anew: tuple[float, float] = (0.0, 0.0)


class Oracle(Node[OracleConfig]):
    """Says the truth at 40 Hz as if it were an estimate, but for what its settings ask."""

    estimates = Output(PoseEstimate)

    @on(Odometry)
    def moved(self, event: Odometry) -> None:
        seconds = event.stamp / SECOND
        start, end = self.config.blind
        if event.stamp % (SECOND // 40) or start < seconds < end:
            return
        x, y, z = event.position
        dx, dy, dz = self.config.shift if seconds > 4 else (0.0, 0.0, 0.0)
        anew = self.config.anew[0] < seconds < self.config.anew[1]
        if anew:
            self._begin = getattr(self, "_begin", event.position)
            dx, dy, dz = (-coordinate for coordinate in self._begin)
        self.estimates.send(
            PoseEstimate(
                stamp=event.stamp,
                source=self.name,
                frame_id="odom_1" if anew else "map",
                position=(x + dx, y + dy, z + dz),
                orientation=event.orientation,
            )
        )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("world") / "floor.xml"
    path.write_text(FLOOR)
    return str(path)


def estimate_and_fly(
    world: str, duration: float = 30.0, delay: str = "60ms", **oracle: Any
) -> NodeResult:
    return run_nodes(
        [
            spec(Multirotor, "drone", {"world": world}),
            spec(Oracle, "oracle", oracle),
            spec(
                VisualPilot,
                "pilot",
                {"waypoints": WAYPOINTS, "speed": 1.0},
                links={"estimates": {"delay": delay}},
            ),
        ],
        duration=duration,
    )


def beside_the_plan(result: NodeResult) -> np.ndarray:
    """Return how far, per axis, the vehicle was from where it was meant to be, shape (n, 3)."""
    truth = {event.stamp: event.position for event in result.of(Odometry)}
    plans = [event for event in result.of(PlannedPose) if event.stamp in truth]
    assert len(plans) > 100
    return np.array([np.subtract(truth[p.stamp], p.position) for p in plans])


@pytest.mark.slow
def test_right_estimates_though_late_keep_the_vehicle_on_its_path(world: str) -> None:
    result = estimate_and_fly(world)
    assert result.reason == "pilot: flight completed"
    assert np.linalg.norm(beside_the_plan(result), axis=1).max() < 0.3


@pytest.mark.slow
def test_an_estimate_that_is_off_takes_the_vehicle_off(world: str) -> None:
    error = beside_the_plan(estimate_and_fly(world, shift=(0.0, 0.0, -0.4)))
    assert error[-100:, 2].mean() == pytest.approx(0.4, abs=0.03)


@pytest.mark.slow
def test_without_estimates_it_stops_and_waits(world: str) -> None:
    result = estimate_and_fly(world, blind=(5.0, 8.0))
    waits = [event for event in result.of(Hover) if 5.0 < event.stamp / SECOND < 8.0]
    assert len(waits) == 1
    while_blind: list[Event] = [
        event for event in result.of(PlannedPose) if 5.7 < event.stamp / SECOND < 8.0
    ]
    assert not while_blind
    assert result.reason == "pilot: flight completed"


def test_a_pilot_that_waits_for_its_first_estimate_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Who waits for motion and who waits for an estimate would wait for each other in silence."""
    run_nodes([spec(VisualPilot, "pilot", {"waypoints": WAYPOINTS})], duration=4.9)
    assert "no pose from" not in caplog.text
    run_nodes([spec(VisualPilot, "pilot", {"waypoints": WAYPOINTS})], duration=5.1)
    assert "no pose from script for 5 s: this pilot waits for the first one" in caplog.text


def off_its_place(result: NodeResult, start: float, end: float) -> float:
    """Return how far the vehicle went, at most, from where it was at a time (seconds)."""
    flown = [e.position for e in result.of(Odometry) if start <= e.stamp / SECOND <= end]
    return float(np.linalg.norm(np.subtract(flown, flown[0]), axis=1).max())


@pytest.mark.slow
def test_estimates_in_another_frame_are_not_followed(world: str) -> None:
    result = estimate_and_fly(world, anew=(5.0, 8.0))
    waits = [event for event in result.of(Hover) if 5.0 < event.stamp / SECOND < 8.0]
    assert len(waits) == 1
    assert off_its_place(result, 6.5, 8.0) < 0.1
    assert np.linalg.norm(beside_the_plan(result), axis=1).max() < 0.3
    assert result.reason == "pilot: flight completed"


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["anew", "blind"])
def test_when_no_estimates_come_any_more_it_lands_where_it_is(world: str, trouble: str) -> None:
    oracle: dict[str, Any] = {trouble: (5.0, 99.0)}
    result = estimate_and_fly(world, **oracle)
    assert result.reason == "pilot: no estimate in map for 10 s: landed"
    assert 15.5 < result.of(Land)[0].stamp / SECOND < 15.7
    assert len(result.of(Landed)) == 1
    begin = next(e.position for e in result.of(Odometry) if e.stamp == 5 * SECOND)
    end = result.of(Odometry)[-1].position
    assert np.hypot(end[0] - begin[0], end[1] - begin[1]) < 1.2  # it flew at 1 m/s


@pytest.mark.parametrize("gain", [-1.0, 0.0])
def test_gains_must_be_positive(gain: float) -> None:
    from runtime.errors import ConfigError

    with pytest.raises(ConfigError, match="gain"):
        spec(VisualPilot, "pilot", {"waypoints": WAYPOINTS, "gain": gain})
