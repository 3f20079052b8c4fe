"""Rays in a world: what they hit, at which distance, and under which angle."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from sims.worlds import Dynamics

Floats = npt.NDArray[np.float64]

DRAWN = np.array([1, 1, 1, 0, 0, 0], np.uint8)
"""Groups of geoms that cameras see, too."""


class Hits(NamedTuple):
    """What rays of one origin meet.

    Attributes:
        distances: Metres; ``inf`` for those that meet nothing. Shape (n,).
        geoms: Numbers of the geoms, or -1. Shape (n,).
        normals: Unit vectors out of the surfaces, in the rays' axes (NWU). Shape (n, 3).
    """

    distances: Floats
    geoms: npt.NDArray[np.int32]
    normals: Floats


class Rays:
    """A model in which rays are cast, at one state after the other.

    Args:
        model: The compiled world; lights and colours of it are changed by its dynamics.
        dynamics: What moves in it by itself.
        body: Name of the body whose geoms rays pass through.
    """

    def __init__(self, model: Any, dynamics: Dynamics, body: str) -> None:
        self.model = model
        self.data: Any = mujoco.MjData(model)
        self._dynamics = dynamics
        self._body = int(model.body(body).id)

    def look(self, qpos: Floats, seconds: float) -> None:
        """Put the world as it is at a time, with generalised positions, shape (nq,)."""
        self.data.qpos[:] = qpos
        self._dynamics.apply(self.model, self.data, seconds)
        mujoco.mj_kinematics(self.model, self.data)

    def cast(
        self,
        origin: Floats,
        directions: Floats,
        reach: float,
        groups: npt.NDArray[np.uint8] = DRAWN,
    ) -> Hits:
        """Cast rays from one place, shape (3,), along unit vectors, shape (n, 3); NWU, metres."""
        count = len(directions)
        geoms, distances = np.empty(count, np.int32), np.empty(count)
        normals = np.empty((count, 3))
        mujoco.mj_multiRay(
            self.model,
            self.data,
            origin,
            np.ascontiguousarray(directions).ravel(),
            groups,
            1,
            self._body,
            geoms,
            distances,
            normals.reshape(-1),
            count,
            mujoco.mjMAXVAL,  # not `reach`: a plane whose middle is farther would not be met
        )
        distances[(geoms < 0) | (distances > reach)] = np.inf
        return Hits(distances, geoms, normals)
