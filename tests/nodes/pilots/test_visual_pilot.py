"""Flying on estimates: on the path if they are right, beside it if not, waiting for them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from events import Event, Hover, Land, Landed, Odometry, PlannedPose, PoseEstimate, Vector3
from nodes.pilots import VisualPilot
from runtime import Node, NodeConfig, Output, on
from runtime.testing import NodeResult, run_nodes, spec
from sims.multirotor import Multirotor

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
            dx, dy, dz = (-each for each in self._begin)
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


def fly(world: str, duration: float = 30.0, delay: str = "60ms", **oracle: Any) -> NodeResult:
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
    result = fly(world)
    assert result.reason == "pilot: flight completed"
    assert np.linalg.norm(beside_the_plan(result), axis=1).max() < 0.3


def test_an_estimate_that_is_off_takes_the_vehicle_off(world: str) -> None:
    error = beside_the_plan(fly(world, shift=(0.0, 0.0, -0.4)))
    assert error[-100:, 2].mean() == pytest.approx(0.4, abs=0.03)


@pytest.mark.slow
def test_without_estimates_it_stops_and_waits(world: str) -> None:
    result = fly(world, blind=(5.0, 8.0))
    waits = [event for event in result.of(Hover) if 5.0 < event.stamp / SECOND < 8.0]
    assert len(waits) == 1
    while_blind: list[Event] = [
        event for event in result.of(PlannedPose) if 5.7 < event.stamp / SECOND < 8.0
    ]
    assert not while_blind
    assert result.reason == "pilot: flight completed"


def off_its_place(result: NodeResult, start: float, end: float) -> float:
    """Return how far the vehicle went, at most, from where it was at a time (seconds)."""
    flown = [e.position for e in result.of(Odometry) if start <= e.stamp / SECOND <= end]
    return float(np.linalg.norm(np.subtract(flown, flown[0]), axis=1).max())


@pytest.mark.slow
def test_estimates_in_another_frame_are_not_followed(world: str) -> None:
    result = fly(world, anew=(5.0, 8.0))
    waits = [event for event in result.of(Hover) if 5.0 < event.stamp / SECOND < 8.0]
    assert len(waits) == 1
    assert off_its_place(result, 6.5, 8.0) < 0.1
    assert np.linalg.norm(beside_the_plan(result), axis=1).max() < 0.3
    assert result.reason == "pilot: flight completed"


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["anew", "blind"])
def test_when_no_estimates_come_any_more_it_lands_where_it_is(world: str, trouble: str) -> None:
    oracle: dict[str, Any] = {trouble: (5.0, 99.0)}
    result = fly(world, **oracle)
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
