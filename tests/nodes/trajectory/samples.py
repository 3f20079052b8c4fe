"""Trajectories for tests, and the same as evo has them."""

from __future__ import annotations

from typing import Any

import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from nodes.trajectory import Trajectory


def walk(n: int = 300, seed: int = 0, step: float = 0.05, start: int = 0) -> Trajectory:
    """Return a smooth path through space that turns as it goes: 20 Hz, `step` metres a pose."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(np.cumsum(rng.normal(0.0, 0.01, (n, 3)), axis=0), axis=0)
    heading = 3.0 * np.sin(heading)
    rotations = Rotation.from_rotvec(heading)
    positions = np.cumsum(rotations.apply(np.array([step, 0.0, 0.0])), axis=0)
    stamps = start + 50_000_000 * np.arange(n, dtype=np.int64)
    return Trajectory(stamps, positions, rotations.as_quat(scalar_first=True))


def moved(trajectory: Trajectory, scale: float = 1.0, seed: int = 1) -> Trajectory:
    """Return the same poses in another frame, and of another scale."""
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    return Trajectory(
        trajectory.stamps,
        scale * rotation.apply(trajectory.positions.copy()) + np.array([3.0, -2.0, 1.0]),
        (rotation * trajectory.rotations()).as_quat(scalar_first=True),
    )


def noisy(trajectory: Trajectory, metres: float = 0.02, seed: int = 2) -> Trajectory:
    """Return the poses with noise on each and drift along them."""
    rng = np.random.default_rng(seed)
    n = len(trajectory)
    drift = np.cumsum(rng.normal(0.0, metres / 10, (n, 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, metres / 10, (n, 3)), axis=0))
    return Trajectory(
        trajectory.stamps,
        trajectory.positions + drift + rng.normal(0.0, metres, (n, 3)),
        (turns * trajectory.rotations()).as_quat(scalar_first=True),
    )


def as_evo(trajectory: Trajectory) -> Any:
    """Return a trajectory as evo has it."""
    return PoseTrajectory3D(
        np.array(trajectory.positions),
        np.array(trajectory.orientations),
        trajectory.stamps / 1e9,
    )


def angle(a: Trajectory, b: Trajectory) -> float:
    """Return the greatest angle between the orientations of two trajectories, radians."""
    return float((a.rotations().inv() * b.rotations()).magnitude().max())
