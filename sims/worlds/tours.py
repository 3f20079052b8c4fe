"""A standard flight through each world: a closed path that keeps its distance from everything."""

from __future__ import annotations

import tomllib
from pathlib import Path

from events.base import Vector3

CLEARANCE = 0.8
"""Least distance (metres) of the straight lines between a tour's points from every solid."""


def _tours() -> dict[str, tuple[Vector3, ...]]:
    found = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {name: tuple((x, y, z) for x, y, z in points) for name, points in found.items()}


TOURS = _tours()
TOURS["night"] = TOURS["yard"]
"""Each world's tour: waypoints in NED (metres), in order; from the last it goes back to the first.
Each is about 50 to 60 m long."""
