"""The range finder: distances that geometry tells, along its axis and in its cone."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from events import Quaternion, Vector3
from events.frames import from_rpy
from sims.sensors.rays import RangeFinder, RangeFinderSpec, Rays, cone
from sims.vehicle import attach_vehicle
from sims.worlds import Dynamics
from tests.sims.sensors.truths import PLACE, random, truth

ROOM = """
<mujoco>
  <worldbody>
    <geom type="plane" size="50 50 1"/>
    <geom type="box" size="1 3 3" pos="5 0 3"/>
    <geom type="box" size="1 1 1" pos="0 -3 1" group="3" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


def finder(seed: int = 0, **given: Any) -> RangeFinder:
    spec = mujoco.MjSpec.from_string(ROOM)
    attach_vehicle(spec, "drone", (0.0, 0.0, -1.0), 0.0)
    rays = Rays(spec.compile(), Dynamics(), "drone/base_link")
    settings: dict[str, Any] = {"name": "range", "noise": 0.0, "min_range": 0.05} | given
    return RangeFinder(RangeFinderSpec(**settings), PLACE, random(seed), rays)


def measured(
    sensor: RangeFinder,
    position: Vector3 = (0.0, 0.0, -1.0),
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0),
) -> float:
    x, y, z = position
    w, a, b, c = orientation
    qpos = np.array([x, -y, -z, w, a, -b, -c])
    return sensor.measure(truth(position, orientation, qpos=qpos)).range


def test_it_measures_from_its_own_place_along_its_own_axis() -> None:
    assert measured(finder()) == pytest.approx(4.0)
    assert measured(finder(position=(0.3, 0.0, 0.0))) == pytest.approx(3.7)
    assert measured(finder(orientation=(0, -90, 0))) == pytest.approx(1.0)
    assert measured(finder(orientation=(0, -45, 0))) == pytest.approx(math.sqrt(2.0))
    assert measured(finder(), (0.0, 0.5, -1.0), from_rpy(0.0, 0.0, 0.3)) == pytest.approx(
        4.0 / math.cos(0.3)
    )


def test_it_sees_neither_its_own_vehicle_nor_what_is_not_drawn() -> None:
    assert measured(finder(orientation=(0, 0, 90))) == math.inf


def test_out_of_reach_is_infinite_on_either_side() -> None:
    assert measured(finder(max_range=3.9)) == math.inf
    assert measured(finder(min_range=4.1)) == -math.inf
    with pytest.raises(ValueError, match=r"range: max_range: expected more than the 5 m"):
        RangeFinderSpec(name="range", min_range=5.0, max_range=5.0)


def test_ground_whose_middle_is_out_of_reach_is_met() -> None:
    """A plane has no bounding sphere: a cut-off of MuJoCo's would take its middle for all of it."""
    down = finder(orientation=(0, -90, 0), max_range=5.0)
    assert measured(down, (40.0, 20.0, -1.0)) == pytest.approx(1.0)
    assert measured(down, (40.0, 20.0, -6.0)) == math.inf


def test_in_a_cone_the_nearest_counts() -> None:
    """Looking down from 1 m with 60 degrees is 1 m still; at a slant, the near side."""
    assert measured(finder(orientation=(0, -90, 0), field_of_view=60)) == pytest.approx(1.0)
    slanted = finder(orientation=(0, -60, 0), field_of_view=60)
    assert measured(slanted) == pytest.approx(1.0, rel=0.01)
    assert measured(finder(orientation=(0, -60, 0))) == pytest.approx(1.0 / math.sin(math.pi / 3))
    angles = np.arccos(cone(math.radians(60))[:, 0])
    assert len(angles) == 25
    assert angles.max() == pytest.approx(math.radians(30))


def test_the_noise_is_the_announced_one() -> None:
    sensor = finder(noise=0.05)
    ranges = np.array([measured(sensor) for _ in range(2000)])
    assert ranges.std() == pytest.approx(sensor.announcement().noise, rel=0.06)
    assert ranges.mean() == pytest.approx(4.0, abs=0.005)
