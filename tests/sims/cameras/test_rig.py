"""When images arrive, which are lost, and what else a simulator says of its cameras."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    PoseStamped,
    PositionSetpoint,
    Takeoff,
    TransformStamped,
    VelocitySetpoint,
)
from runtime import Node, Output, on
from runtime.testing import NodeResult, run_node, run_nodes, spec
from runtime.units import Latency
from sims.cameras import CameraSpec, optical_in_body
from sims.cameras.delivery import delay_of
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor

MS = 1_000_000
PERIOD = 40 * MS

WORLD = """<mujoco><worldbody>
  <light pos="0 0 4"/><geom type="plane" size="9 9 1"/><geom type="box" size="1 1 1" pos="3 0 0"/>
</worldbody></mujoco>"""

SPOILT = CameraSpec(name="c", latency=Latency(0.04), jitter=Latency(0.09), loss=0.3)
TINY = {"width": 16, "height": 12}


class Arrival(Event):
    """Something of a stamp came, at `stamp`."""

    what: str
    of: int


class Listener(Node):
    arrivals = Output(Arrival)

    @on(Image, DepthImage, PoseStamped)
    def came(self, event: Event) -> None:
        self.arrivals.send(
            Arrival(
                stamp=self.clock.now(),
                source=self.name,
                what=type(event).__name__,
                of=event.stamp,
            )
        )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("world") / "tiny.xml"
    path.write_text(WORLD)
    return str(path)


def watch(world: str, processes: int = 1, **camera: Any) -> NodeResult:
    """Run a free camera of 25 Hz for two seconds, and note what comes when."""
    config = {
        "world": world,
        "rate": 25,
        "camera_processes": processes,
        "cameras": [{"name": "c"} | TINY | camera],
    }
    nodes = [spec(FreeCamera, "free", config), spec(Listener, "listener")]
    return run_nodes(nodes, duration=2.0, seed=4)


def arrivals(result: NodeResult, what: str = "Image") -> dict[int, int]:
    """Stamp to time of arrival."""
    return {e.of: e.stamp for e in result.of(Arrival) if e.what == what}


def test_delays_are_spread_evenly_over_the_jitter() -> None:
    """As many exposures are lost as is asked for; the same seed loses the same."""
    found = [delay_of(SPOILT, 1, k * 33 * MS) for k in range(4000)]
    delays = [delay for delay in found if delay is not None]
    assert 1.0 - len(delays) / len(found) == pytest.approx(0.3, abs=0.03)
    assert 0.04 <= min(delays) < 0.041
    assert 0.129 < max(delays) <= 0.13
    assert np.mean(delays) == pytest.approx(0.085, abs=0.002)
    assert np.std(delays) == pytest.approx(0.09 / 12**0.5, rel=0.03)
    assert found == [delay_of(SPOILT, 1, k * 33 * MS) for k in range(4000)]
    assert found != [delay_of(SPOILT, 2, k * 33 * MS) for k in range(4000)]


def test_loss_and_jitter_do_not_depend_on_each_other() -> None:
    """Of a camera that loses images, the others come when they would have come anyway."""
    whole = msgspec.structs.replace(SPOILT, loss=0.0)
    prompt = msgspec.structs.replace(SPOILT, jitter=Latency(0))
    for stamp in range(0, 100 * PERIOD, PERIOD):
        delay = delay_of(SPOILT, 1, stamp)
        assert delay in (None, delay_of(whole, 1, stamp))
        assert (delay is None) == (delay_of(prompt, 1, stamp) is None)


@pytest.mark.slow
def test_jitter_delays_and_keeps_the_order(world: str) -> None:
    """Each image comes at its own time, or with the one before it if that is later; and the
    same whether one process renders quickly or two slowly."""
    result = watch(world, latency="40ms", jitter="90ms")
    came = arrivals(result)
    assert list(came) == sorted(came)
    times = list(came.values())
    assert times == sorted(times)
    late = [time - stamp for stamp, time in came.items()]
    assert min(late) >= 40 * MS
    assert max(late) <= 130 * MS
    assert len(set(late)) > 30
    assert sum(b == a for a, b in pairwise(times)) >= 3  # some did wait for the one before
    assert set(came) == {k * PERIOD for k in range(len(came))}
    assert len(came) >= 46
    slow = watch(world, processes=2, latency="40ms", jitter="90ms", render_time="20ms")
    assert slow.of(Arrival) == result.of(Arrival)
    assert slow.of(PoseStamped) == result.of(PoseStamped)
    for one, other in zip(slow.of(Image), result.of(Image), strict=True):
        np.testing.assert_array_equal(one.data, other.data)


@pytest.mark.slow
def test_a_lost_exposure_gives_nothing(world: str, caplog: pytest.LogCaptureFixture) -> None:
    """Neither image nor depth nor pose; the others come in time; and the log says how many."""
    caplog.set_level(logging.INFO, "visnav.free")
    came = watch(world, latency="40ms", loss=0.4)
    stamps = set(arrivals(came))
    assert 18 <= len(stamps) <= 42
    assert set(arrivals(came, "DepthImage")) == stamps
    assert set(arrivals(came, "PoseStamped")) == stamps
    assert {time - stamp for stamp, time in arrivals(came).items()} == {40 * MS}
    (said,) = [r.getMessage() for r in caplog.records if "lost" in r.getMessage()]
    assert int(said.split()[1]) in (49 - len(stamps), 50 - len(stamps))  # one may be on its way


def smeared(result: NodeResult) -> dict[int, bool]:
    """Tell at which stamps the camera with the open shutter saw anything else than the other."""
    seen = {(e.source.partition("/")[2], e.stamp): e.data for e in result.of(Image)}
    return {
        stamp: not np.array_equal(data, seen["open", stamp])
        for (camera, stamp), data in seen.items()
        if camera == "sharp" and ("open", stamp) in seen
    }


SHARP_AND_OPEN = [
    {"name": "sharp", "width": 64, "height": 48, "rate": 10},
    {"name": "open", "width": 64, "height": 48, "rate": 10, "exposure": "90ms"},
]


@pytest.fixture(scope="module")
def free(world: str) -> NodeResult:
    """A free camera that is put elsewhere at 0.15 s, and moves from 0.45 s until that is void."""
    config = {"world": world, "rate": 10, "cameras": SHARP_AND_OPEN, "camera_processes": 1}
    jump = PositionSetpoint(stamp=150 * MS, source="t", position=(0.0, 0.5, -1.0))
    move = VelocitySetpoint(
        stamp=450 * MS, source="t", velocity=(0.0, 3.0, 0.0), frame_id="map", yaw_rate=0.0
    )
    return run_node(FreeCamera, inputs=[jump, move], config=config, duration=1.25)


@pytest.fixture(scope="module")
def vehicle(world: str) -> NodeResult:
    """A vehicle that takes off at 0.6 s; one of its cameras looks down."""
    down = {"name": "down", "orientation": [0, -90, 0], "loss": 1.0} | TINY
    config = {"world": world, "cameras": [*SHARP_AND_OPEN, down], "camera_processes": 1}
    climb = Takeoff(stamp=600 * MS, source="t", altitude=2.0)
    return run_node(Multirotor, inputs=[climb], config=config, duration=3.0)


@pytest.mark.slow
def test_a_free_camera_smears_while_it_moves(free: NodeResult) -> None:
    """With a velocity, and not when it is put elsewhere at once."""
    found = [stamp // (100 * MS) for stamp, is_smeared in smeared(free).items() if is_smeared]
    assert found == [5, 6, 7, 8, 9]


@pytest.mark.slow
def test_a_trajectory_smears(world: str, tmp_path: Path) -> None:
    file = tmp_path / "turn.tum"
    file.write_text("0 0 0 -1 0 0 0 1\n0.3 0 0 -1 0 0 0 1\n0.6 0 0 -1 0 0 0.3826834 0.9238795\n")
    config = {"world": world, "rate": 10, "cameras": SHARP_AND_OPEN, "camera_processes": 1}
    result = run_node(FreeCamera, config=config | {"trajectory": str(file)}, duration=2.0)
    assert list(smeared(result).values())[:6] == [False, False, False, True, True, True]


def test_a_vehicle_smears_while_it_moves(vehicle: NodeResult) -> None:
    found = smeared(vehicle)
    assert [stamp for stamp, is_smeared in found.items() if is_smeared and stamp < 600 * MS] == []
    assert sum(found.values()) >= 8


def test_mountings_are_said_once_at_the_start(free: NodeResult, vehicle: NodeResult) -> None:
    """Of each camera of either simulator, as announced, in the frame of its body."""
    for result, parent, count in ((free, "node", 2), (vehicle, "base_link", 3)):
        said = result.of(TransformStamped)
        assert [(t.stamp, t.static, t.frame_id) for t in said] == [(0, True, parent)] * count
        for transform, announced in zip(said, result.of(CameraAnnouncement), strict=True):
            assert transform.source == announced.source
            assert transform.child_frame_id == announced.frame_id
            assert transform.translation == announced.position
            assert transform.rotation == announced.orientation
    down = CameraSpec(name="down", orientation=(0.0, -90.0, 0.0))
    assert said[2].rotation == optical_in_body(down)[1]
