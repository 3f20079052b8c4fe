"""What the tests of sensors tell them, and where those are."""

from __future__ import annotations

import numpy as np

from events import Quaternion, Vector3
from sims.sensors.sensor import Place, Truth

ORIGIN = (47.641468, -122.140165, 122.0)
PLACE = Place("drone/sensor", "base_link", ORIGIN)


def truth(
    position: Vector3 = (0.0, 0.0, 0.0),
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0),
    velocity: Vector3 = (0.0, 0.0, 0.0),
    angular_velocity: Vector3 = (0.0, 0.0, 0.0),
    seconds: float = 0.0,
    qpos: object = None,
) -> Truth:
    return Truth(round(seconds * 1e9), position, orientation, velocity, angular_velocity, qpos)


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)
