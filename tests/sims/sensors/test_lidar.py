"""Lidars: where their rays go and when, what they hit, and what is made of it.

When the turns of a lidar are made, above all when their ticks come late, as in real time.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Coroutine
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from events import LidarScan
from runtime import Tick
from sims.cameras import model_to_bytes
from sims.sensors.lidar import LATE, LidarRig, LidarSpec, Scanner, pattern_of, solids
from sims.vehicle import Physics, attach_vehicle
from sims.worlds import Dynamics, Motion, load_scene
from tests.sims.vehicle.flight import compiled

Floats = npt.NDArray[np.float64]

ROOM = """
<mujoco>
  <asset>
    <texture name="half" type="2d" builtin="flat" rgb1="0.5 0.5 0.5" width="8" height="8"/>
    <material name="half" texture="half"/>
    <material name="dark" rgba="0.1 0.1 0.1 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1" rgba="1 1 1 1"/>
    <geom name="north" type="box" size="0.1 6 3" pos="6.1 0 3" material="half"/>
    <geom name="south" type="box" size="0.1 6 3" pos="-6.1 0 3" material="dark"/>
    <geom name="west" type="box" size="6 0.1 3" pos="0 4.1 3" rgba="0.8 0.8 0.8 1"/>
    <geom name="east" type="box" size="6 0.1 3" pos="0 -4.1 3" rgba="0.8 0.8 0.8 1"/>
    <geom name="ghost" type="box" size="1 1 1" pos="2 0 1" rgba="1 1 1 0"/>
    <geom name="hidden" type="box" size="1 1 1" pos="-2 0 1" group="3"/>
    <body name="cart" mocap="true" pos="3 2 0.5">
      <geom name="cart" type="box" size="0.3 0.3 0.5" rgba="0 1 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""
STATIC = Dynamics()
START = 300_000_000
STILL = np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0])


def model(text: str = ROOM) -> Any:
    spec = mujoco.MjSpec.from_string(text)
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.5), 0.0)
    return spec.compile()


def spec_of(**settings: Any) -> LidarSpec:
    given: dict[str, Any] = {"name": "lidar", "columns": 180, "elevations": (-30.0, 20.0)}
    return LidarSpec(**(given | settings))


def scan(
    states: Floats = STILL[None], seed: int = 1, dynamics: Dynamics = STATIC, **settings: Any
) -> LidarScan:
    scanner = Scanner(model_to_bytes(model()), dynamics, (spec_of(**settings),), "drone", seed)
    return scanner.scan("lidar", START, states)


def in_world(points: Floats, state: Floats) -> Floats:
    """Take points of a lidar in the body's origin (FRD) to the world's NWU."""
    rotation = Rotation.from_quat(state[..., 3:], scalar_first=True)
    return np.asarray(state[..., :3] + rotation.apply(points * (1.0, -1.0, -1.0)))


def misses(points: Floats) -> Floats:
    """Return how far points (NWU) are from the nearest surface of the room; the cart apart."""
    x, y, z = points.T
    apart = [np.abs(z), np.abs(np.abs(x) - 6.0), np.abs(np.abs(y) - 4.0)]
    nearest = np.minimum.reduce(apart)
    at_cart = (np.abs(x - 3.0) < 0.31) & (np.abs(y - 2.0) < 0.31) & (z < 1.01)
    return np.where(at_cart, 0.0, nearest)


def spinning_states(rate: float, speed: float = 0.0) -> Floats:
    """Return a turn of 101 ms of a vehicle that yaws left (NWU) and flies north."""
    seconds = np.arange(101) * 1e-3
    states = np.tile(STILL, (101, 1))
    states[:, 0] += speed * seconds
    states[:, 3], states[:, 6] = np.cos(rate * seconds / 2), np.sin(rate * seconds / 2)
    return states


def test_points_lie_on_the_surfaces_and_nothing_unseen_is_hit() -> None:
    turn = scan()
    assert len(turn.points) > 0.99 * 180 * 16
    assert misses(in_world(turn.points.astype(np.float64), STILL)).max() < 1e-5


def test_each_ray_is_cast_where_the_sensor_is_at_its_own_time() -> None:
    """Turning at 5 rad/s and flying at 6 m/s, the cloud is skewed by half a metre; put where the
    sensor was at each point's own time, it is straight to the half millisecond."""
    states = spinning_states(5.0, 6.0)
    turn = scan(states)
    points, seconds = turn.points.astype(np.float64), turn.times.astype(np.float64)
    poses = np.tile(STILL, (len(seconds), 1))
    poses[:, 0] += 6.0 * seconds
    poses[:, 3], poses[:, 6] = np.cos(2.5 * seconds), np.sin(2.5 * seconds)
    assert misses(in_world(points, poses)).max() < 6.0 * 0.6e-3
    assert misses(in_world(points, states[0])).max() > 0.3


def test_a_mounted_lidar_looks_from_its_own_place() -> None:
    """Upside down and ahead: the uppermost ring meets the floor."""
    turn = scan(position=(0.5, 0.0, -0.2), orientation=(180.0, 0.0, 0.0))
    points = turn.points.astype(np.float64) * (1.0, -1.0, -1.0) + (0.5, 0.0, -0.2)
    assert misses(in_world(points, STILL)).max() < 1e-5
    low = points[turn.rings == 0]
    assert np.median(low[:, 2]) == pytest.approx(1.5, abs=1.0)
    assert low[:, 2].mean() > points[turn.rings == 15][:, 2].mean()


class Away(Motion, frozen=True):
    """The cart stands beside the room until 0.35 s, and in it from then on."""

    solid = True

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        data.mocap_pos[0] = (3.0, 2.0, 0.5) if seconds >= 0.35 else (30.0, 20.0, 0.5)


def test_what_moves_by_itself_is_where_it_is_at_each_rays_time() -> None:
    """A ray at 34 degrees left, in the last tenth of the turn: the cart is there by then. In the
    opposite sense of rotation, in the first tenth, it is not there yet."""

    def ranges(azimuths: tuple[float, float]) -> Floats:
        states = np.tile(STILL, (101, 1))
        turn = scan(states, dynamics=Dynamics((Away(),)), azimuths=azimuths, elevations=(-20, -20))
        points = turn.points.astype(np.float64)
        there = np.abs(np.degrees(np.arctan2(-points[:, 1], points[:, 0])) - 33.7) < 3.0
        assert there.any()
        return np.asarray(np.linalg.norm(points[there], axis=1))

    assert ranges((0.0, 360.0)).max() < 3.7  # the cart
    assert ranges((-60.0, 300.0)).min() > 3.9  # the floor, or the wall behind


def test_the_intensity_is_of_colour_angle_and_range() -> None:
    turn = scan(channels=1, elevations=(0.0, 0.0), full_range=3.0)
    points = turn.points.astype(np.float64)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))

    def at(angle: float) -> float:
        return float(turn.intensities[np.abs(azimuth - angle).argmin()])

    assert at(0.0) == pytest.approx(0.5 * (3 / 6) ** 2, rel=0.03)  # textured
    assert at(180.0) == pytest.approx(0.1 * (3 / 6) ** 2, rel=0.03)  # its material's
    assert at(90.0) == pytest.approx(0.8 * (3 / 4) ** 2, rel=0.03)
    assert at(50.0) == pytest.approx(0.8 * np.sin(np.radians(50)) * (3 / 5.22) ** 2, rel=0.03)
    seen = scan(channels=1, elevations=(0.0, 0.0), full_range=3.0, min_intensity=0.1)
    assert (seen.points[:, 0] > -5.9).all()
    assert 0 < len(seen.points) < len(turn.points)


def test_noise_is_along_the_ray_and_as_large_as_announced() -> None:
    clean, noisy = scan(), scan(noise=0.03)
    assert len(clean.points) == len(noisy.points)
    lengths = [np.linalg.norm(turn.points.astype(np.float64), axis=1) for turn in (clean, noisy)]
    assert np.std(lengths[1] - lengths[0]) == pytest.approx(0.03, rel=0.05)
    sine = np.linalg.norm(np.cross(clean.points, noisy.points), axis=1) / np.prod(lengths, axis=0)
    assert sine.max() < 1e-5


def test_drop_outs_and_ranges_leave_points_out() -> None:
    everything = len(scan().points)
    assert len(scan(dropout=0.25).points) / everything == pytest.approx(0.75, abs=0.03)
    lengths = np.linalg.norm(scan(min_range=3.0, max_range=5.0).points, axis=1)
    assert lengths.min() >= 3.0 - 1e-5
    assert lengths.max() <= 5.0 + 1e-5


def test_equal_arguments_give_equal_bits() -> None:
    states = spinning_states(2.0)
    one, again, other = (scan(states, seed, noise=0.02, dropout=0.1) for seed in (1, 1, 2))
    assert np.array_equal(one.points, again.points)
    assert not np.array_equal(one.points[:50], other.points[:50])


@given(
    pattern=st.sampled_from(["spinning", "solid_state"]),
    first=st.floats(-180, 180),
    span=st.floats(1, 360),
    low=st.floats(-90, 90),
    high=st.floats(-90, 90),
    channels=st.integers(1, 8),
    columns=st.integers(1, 50),
    start=st.floats(0, 1e3),
)
def test_rays_are_unit_vectors_in_the_field_of_view_and_in_the_turn(
    pattern: str,
    first: float,
    span: float,
    low: float,
    high: float,
    channels: int,
    columns: int,
    start: float,
) -> None:
    spec = LidarSpec(
        name="lidar",
        pattern=pattern,  # type: ignore[arg-type]
        azimuths=(first, first + span),
        elevations=(min(low, high), max(low, high)),
        channels=channels,
        columns=columns,
    )
    directions, times = pattern_of(spec, start)
    assert directions.shape == (columns, channels, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1.0, atol=1e-9)
    elevation = np.degrees(np.arcsin(np.clip(-directions[..., 2], -1, 1)))
    assert (elevation >= min(low, high) - 1e-5).all()
    assert (elevation <= max(low, high) + 1e-5).all()
    x, y = directions[..., 0], directions[..., 1]
    turned = (np.degrees(np.arctan2(y, x)) - first) % 360.0
    level = np.hypot(x, y) > 1e-6
    inside = (turned <= span + 1e-4) | (turned >= 360.0 - 1e-4)
    assert inside[level].all()
    assert times.shape == (columns,)
    assert (np.diff(times) >= 0).all()
    assert times[0] == 0.0
    assert times[-1] < 0.1


def test_a_rosette_never_repeats_and_fills_its_field() -> None:
    spec = spec_of(
        pattern="solid_state", azimuths=(-35, 35), elevations=(-35, 35), channels=1, columns=2000
    )
    seen: set[tuple[int, int]] = set()
    filled = []
    for turn in range(8):
        x, y, z = pattern_of(spec, turn / 10).directions.reshape(-1, 3).T
        cells = np.floor(np.degrees([np.arctan2(y, x), np.arcsin(z)]) / 2.0).astype(int)
        seen |= set(map(tuple, cells.T.tolist()))
        filled.append(len(seen))
    circle = math.pi * 17.5**2
    assert filled[-1] > 0.9 * circle > 1.15 * filled[0]


def test_a_built_in_worlds_looks_are_scanned_as_their_solids() -> None:
    scene = load_scene("hall", bare=True)
    attach_vehicle(scene.spec, "drone", (0.0, 0.0, -1.5), 0.0)
    compiled = scene.spec.compile()
    met = solids(compiled)
    names = [compiled.geom(i).name for i in range(compiled.ngeom)]
    assert not any(met[i] for i, name in enumerate(names) if name.endswith(".look"))
    assert sum(met) > 50


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"azimuths": (0.0, 400.0)}, "azimuths: expected up to 360 degrees.*found 0 to 400"),
        ({"azimuths": (90.0, 90.0)}, "azimuths"),
        ({"elevations": (10.0, -10.0)}, "elevations: expected the lowest and the highest"),
        ({"max_range": 0.05}, "max_range: expected more than the 0.1 m of min_range"),
    ],
)
def test_impossible_settings_are_refused_by_name(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        LidarSpec(name="lidar", **settings)


def test_another_vehicle_is_hit_and_its_own_is_not() -> None:
    """Two vehicles 1.5 m apart, each with a lidar in its middle; the other one is the nearest."""
    spec = mujoco.MjSpec.from_string(ROOM)
    attach_vehicle(spec, "one", (0.0, 0.0, -1.5), 0.0)
    attach_vehicle(spec, "two", (0.0, 1.5, -1.5), 0.0)
    both = spec.compile()
    for vehicle, side in (("one", 1.0), ("two", -1.0)):
        lidar = spec_of(elevations=(-3.0, 3.0), columns=720)
        scanner = Scanner(model_to_bytes(both), STATIC, (lidar,), vehicle, 0)
        points = scanner.scan("lidar", 0, both.qpos0[None]).points
        near = points[np.linalg.norm(points, axis=1) < 1.9]
        assert len(near) > 50
        assert (near[:, 1] * side > 1.0).all()


def test_the_floor_of_the_hall_is_met_far_from_its_middle() -> None:
    spec, dynamics = load_scene("hall", bare=True)
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    settings = spec_of(max_range=5.0, elevations=(-90.0, -60.0), channels=4, columns=12)
    state = np.array([6.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # the middle is out of reach
    scanner = Scanner(model_to_bytes(spec.compile()), dynamics, (settings,), "drone", 1)
    points = scanner.scan("lidar", START, state[None]).points
    assert points[:, 2] == pytest.approx(np.ones(48), abs=1e-5)


MS = 1_000_000


class Scanning:
    """Stands for the node and its worker: notes which states are scanned."""

    log = logging.getLogger("scanning")

    def __init__(self) -> None:
        self.rng = np.random.default_rng([0])
        self.scanned: list[tuple[int, int]] = []
        self.turn: Callable[[Tick], None] = lambda _: None
        self.clock = self.lidar_scans = self
        self.model_bytes, self.dynamics = b"", None
        self.name = "drone"

    async def offload(self, call: Callable[[], Any]) -> Any:
        return call()

    async def worker(self, *_: Any) -> Any:
        return self

    def every(self, _: float, call: Callable[[Tick], None], __: str) -> None:
        self.turn = call

    def start(self, coro: Coroutine[Any, Any, None]) -> None:
        asyncio.run(coro)

    def now(self) -> int:
        return 0

    def send(self, _: Any) -> None:
        """Send nothing."""

    async def call_for(self, _: float, __: Any, ___: str, start: int, states: Any) -> None:
        self.scanned.append((start, len(states)))


def test_a_turn_that_ends_late_is_made_whole_and_one_that_ends_too_late_is_skipped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    physics, node = Physics(compiled(), "drone"), Scanning()
    spec = LidarSpec(name="lidar", rate=10.0)
    lidar: Any = type("Mounted", (), {"spec": spec, "source": "drone/lidar"})()

    def advance(tick: Tick) -> int:
        physics.advance_to(tick.stamp)
        return max(tick.stamp, physics.time_ns)

    rig: Any = LidarRig(node, [lidar], physics, advance)  # type: ignore[arg-type]
    asyncio.run(rig.start(node))
    late = round(LATE * 1e9)
    ends = [0, 100 * MS, 100 * MS + 150 * MS, 250 * MS + 100 * MS + late + 10 * MS]
    ends.append(ends[-1] + 100 * MS)
    for index, end in enumerate(ends):
        node.turn(Tick(end, index, 0, 0))
    assert node.scanned == [(ends[0], 101), (ends[1], 151), (ends[3], 101)]
    assert "turns skipped" in caplog.text
