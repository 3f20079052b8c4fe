"""A replay as a node: when it says what, and how it ends."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import (
    Announcement,
    Event,
    Image,
    Imu,
    Odometry,
    TrackingLost,
    TrajectoryEstimate,
    VehicleAnnouncement,
)
from nodes.data.replay import Replay
from nodes.data.replay.node import Timeline
from runtime import Node, on
from runtime.channels.wire import pack
from runtime.errors import ConfigError, FatalError
from runtime.testing import NodeResult, run_nodes, spec
from tests.nodes.data.dataset.samples import flight
from tests.nodes.data.replay import sets
from tests.runtime.samples_runs import supervisor_of

MS = 1_000_000


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sets.recording(tmp_path_factory.mktemp("recording"))


class Witness(Node):
    """Notes when what came, and does to the replay what a test wants."""

    acted = False
    heard: list[tuple[int, Event]]

    def __init__(self) -> None:
        type(self).heard = self.heard = []

    @on(Event)
    def hear(self, event: Event) -> None:
        self.heard.append((self.clock.now(), event))
        self.act()

    def act(self) -> None: ...


def replay(
    path: Path, witness: type[Witness] = Witness, duration: float = 9.0, **config: Any
) -> NodeResult:
    settings = {"file": str(path), **config}
    witness.acted = False
    nodes = [spec(Replay, "drone", settings), spec(witness, "witness")]
    return run_nodes(nodes, duration=duration)


def test_everything_is_said_when_it_was(path: Path) -> None:
    """Announcements and events are equal to the byte, in order, and the end ends the run."""
    result = replay(path)
    expected = [pack(event).frame() for event in sets.events()]
    sent = [e for e in result.sent if e.source != "*"]  # by which it speaks for all others
    assert [pack(event).frame() for event in sent] == expected
    assert [time for time, _ in Witness.heard] == [e.stamp for _, e in Witness.heard]
    assert result.reason == "the recording ended"
    assert result.seconds == pytest.approx(2 * sets.STEP / 1e9)


def test_a_start_is_time_zero(path: Path) -> None:
    """Stamps move along; what was measured before it is left out; the vehicle stands there."""
    result = replay(path, start="30ms")
    assert [event.stamp for event in result.of(Imu)] == [0, 30 * MS]
    (vehicle,) = result.of(VehicleAnnouncement)
    assert vehicle.position == (1.0, 2.0, -3.0)
    assert result.seconds == 0.03


def test_an_end_is_when_the_run_ends(path: Path) -> None:
    """To the nanosecond, and without the events of that time."""
    result = replay(path, end="60ms")
    assert [event.stamp for event in result.of(Imu)] == [0, 30 * MS]
    assert result.seconds == 0.06


def test_a_loop_begins_again_and_time_goes_on(path: Path) -> None:
    """Stamps rise: the second round follows the first."""
    result = replay(path, loop=True, end="90ms", duration=0.2)
    stamps = [event.stamp for event in result.of(Odometry)]
    assert stamps == [n * 30 * MS for n in range(7)]
    assert result.reason == "duration"


def test_a_loop_of_one_moment_is_an_error(path: Path) -> None:
    """It would go round for ever, and time would stand."""
    with pytest.raises(FatalError, match="loop: expected a recording that takes some time"):
        replay(path, loop=True, start="60ms")


def test_a_recording_that_does_not_say_its_end_lingers(tmp_path: Path) -> None:
    """For those who have something to say of the last image."""
    result = replay(sets.euroc(tmp_path), linger="250ms")
    assert result.seconds == pytest.approx(2 * sets.STEP / 1e9 + 0.25)


def test_a_choice_narrows_it(path: Path) -> None:
    """The camera's images alone; announcements stay."""
    result = replay(path, only=["Image"])
    assert len(result.of(Image)) == sets.FRAMES == len(result.sent) - len(result.of(Announcement))


@pytest.mark.parametrize(
    ("played", "stamps"),
    [
        ([(0, 0)], {10: 10, 30: 30, 50: 50, 80: 80}),
        ([(30, 0)], {30: 0, 50: 20, 80: 50}),  # a start: what was before it is not in this run
        ([(0, 0), (40, 140, True)], {10: 10, 30: 30, 50: 150, 80: 180}),  # a pause
        ([(0, 0), (0, 90)], {10: 100, 30: 120, 50: 140, 80: 170}),  # a loop
        ([(0, 0), (70, 20)], {10: 10, 80: 30}),  # ahead
        ([(0, 0), (40, 60)], {10: 10, 30: 30, 50: 70, 80: 100}),  # back
    ],
)
def test_each_pose_of_a_trajectory_is_when_it_was_played(
    played: list[tuple[int, ...]], stamps: dict[int, int]
) -> None:
    timeline, recorded = Timeline(), [10, 30, 50, 80]
    for position, now, *pause in played:
        timeline.start_stretch(position, now, pause=bool(pause))
    sent = TrajectoryEstimate(
        stamp=80,
        source="slam",
        stamps=np.array(recorded),
        positions=np.array([(float(t), 0.0, 0.0) for t in recorded]),
        orientations=np.array([(1.0, 0.0, 0.0, 0.0)] * 4),
    )
    moved = timeline.moved(sent)
    assert isinstance(moved, TrajectoryEstimate)
    assert dict(zip(moved.positions[:, 0].tolist(), moved.stamps.tolist(), strict=True)) == stamps
    for recorded_at in stamps if len(played) < 2 or played[1][2:] else ():  # and single events
        event = timeline.moved(TrackingLost(stamp=recorded_at, source="slam"))
        assert event is not None
        assert event.stamp == stamps[recorded_at]


class Pausing(Witness):
    """Pauses at the second measurement, for 100 ms."""

    def act(self) -> None:
        if len([e for _, e in self.heard if isinstance(e, Imu)]) == 2 and not self.acted:
            type(self).acted = True
            self.drone = _replay_of(self)
            self.drone.pause()
            self.start(self.resume())

    async def resume(self) -> None:
        await self.clock.sleep(0.1)
        assert self.drone.position == pytest.approx(0.03)
        self.drone.resume()


class Setting(Pausing):
    """Does the same by settings, as one does from outside."""

    def act(self) -> None:
        if len([e for _, e in self.heard if isinstance(e, Imu)]) == 2 and not self.acted:
            type(self).acted = True
            self.drone = _replay_of(self)
            self.set("paused=true")
            self.start(self.resume())

    async def resume(self) -> None:
        await self.clock.sleep(0.1)
        self.set("paused=false")

    def set(self, text: str) -> None:
        supervisor_of(self).parameters.set(f"{self.drone.name}.{text}")


class Going(Setting):
    """Goes back at the last measurement, by a setting."""

    def act(self) -> None:
        if len([e for _, e in self.heard if isinstance(e, Imu)]) == 3 and not self.acted:
            type(self).acted = True
            self.drone = _replay_of(self)
            self.set('position="30ms"')


class Seeking(Witness):
    """Goes back at the last measurement, once."""

    to = 0.03

    def act(self) -> None:
        if len([e for _, e in self.heard if isinstance(e, Imu)]) == 3 and not self.acted:
            type(self).acted = True
            _replay_of(self).seek(self.to)


class Overshooting(Seeking):
    """Goes far beyond the end."""

    to = 500.0


def _replay_of(witness: Node[Any]) -> Replay:
    nodes = supervisor_of(witness).state.all_nodes
    return next(node for node in nodes if isinstance(node, Replay))


def test_a_pause_makes_all_that_follows_later(path: Path) -> None:
    """Stamps stay on the run's clock."""
    replay(path, Pausing)
    stamps = [(time, e.stamp) for time, e in Pausing.heard if isinstance(e, Imu)]
    assert stamps == [(0, 0), (30 * MS, 30 * MS), (160 * MS, 160 * MS)]
    assert len(Pausing.heard) == len(flight(sets.FRAMES)) - 2


class SeekingInAPause(Pausing):
    """Goes to the beginning while it pauses."""

    async def resume(self) -> None:
        self.drone.seek(0.0)
        await self.clock.sleep(0.1)
        assert self.drone.position == 0.0
        self.drone.resume()


def test_seeking_in_a_pause_is_where_it_goes_on(path: Path) -> None:
    """Not before it is over."""
    replay(path, SeekingInAPause)
    times = [time for time, e in SeekingInAPause.heard if isinstance(e, Imu)]
    assert times == [0, 30 * MS, 130 * MS, 160 * MS, 190 * MS]


def test_a_pause_can_be_set_from_outside(path: Path) -> None:
    """As a setting that changes in the run."""
    replay(path, Setting)
    times = [time for time, e in Setting.heard if isinstance(e, Imu)]
    assert times == [0, 30 * MS, 160 * MS]


@pytest.mark.parametrize("witness", [Seeking, Going])
def test_seeking_goes_on_elsewhere_at_once(path: Path, witness: type[Witness]) -> None:
    """What is read ahead is thrown away; time goes on."""
    result = replay(path, witness)
    times = [time for time, e in witness.heard if isinstance(e, Imu)]
    assert times == [0, 30 * MS, 60 * MS, 60 * MS, 90 * MS]
    assert result.reason == "the recording ended"


def test_seeking_beyond_the_end_ends_the_run(path: Path) -> None:
    """There is nothing more to say."""
    result = replay(path, Overshooting)
    assert result.reason == "the recording ended"
    assert len(result.of(Imu)) == 3
    assert len(result.of(Image)) == 2


@pytest.mark.parametrize(
    ("config", "wrong"),
    [
        ({"only": ["nobody"]}, "expected events that are wanted, found none of nobody"),
        ({"start": "50s"}, "expected events that are wanted, found none from 50 s on"),
        ({"file": "missing.mcap"}, "missing.mcap: expected a recording or .*, found nothing there"),
    ],
)
def test_nothing_to_say_is_an_error(path: Path, config: dict[str, Any], wrong: str) -> None:
    """Rather than a run in which nothing happens."""
    with pytest.raises(FatalError, match=wrong):
        replay(path, **config)


def test_a_name_that_nothing_has_is_told(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """It may be mistyped; the rest is said nevertheless."""
    with caplog.at_level(logging.WARNING):
        replay(path, skip=["drone/fornt", "Imu"])
    assert "nothing in the recording is of drone/fornt" in caplog.text
    assert "Imu" not in caplog.text


def test_settings_that_make_no_sense_are_refused(path: Path) -> None:
    """An end before the start, and what is no use of a topic."""
    with pytest.raises(ConfigError, match="end: expected a time after start"):
        replay(path, start="2s", end="1s")
    with pytest.raises(ConfigError, match="as"):
        replay(path, topics=[{"topic": "/x", "as": "sound"}])
