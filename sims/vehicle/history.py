"""The states of a world in its recent past, for whatever measures at times of its own."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from sims.vehicle.model import TIMESTEP_NS

Floats = npt.NDArray[np.float64]


class Stepped(Protocol):
    """What a history must know of its simulation."""

    model: Any
    data: Any

    @property
    def time_ns(self) -> int:
        """Time of the present state, whole milliseconds."""

    def state_at(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the state at a time from then to a step later."""


class History:
    """The states of a simulation's last milliseconds, as long a time as somebody has asked for.

    Args:
        simulation: The simulation, which calls `add` before each of its steps if `kept` is true.
    """

    def __init__(self, simulation: Stepped) -> None:
        self._simulation = simulation
        self._states: deque[tuple[Floats, Floats]] = deque(maxlen=0)

    @property
    def kept(self) -> bool:
        """Whether anybody has asked for a past."""
        return bool(self._states.maxlen)

    def keep(self, seconds: float) -> None:
        """Keep at least the states of the last `seconds` from now on."""
        steps = math.ceil(seconds * 1e9 / TIMESTEP_NS) + 1
        if steps > (self._states.maxlen or 0):
            self._states = deque(self._states, maxlen=steps)

    def add(self) -> None:
        """Keep the present state, from which the next step is about to begin."""
        data = self._simulation.data
        self._states.append((data.qpos.copy(), data.qvel.copy()))

    def clear(self) -> None:
        """Forget all states."""
        self._states.clear()

    def at(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the world's state at a time in the past that is kept, or a step ahead at most.

        On a whole millisecond positions are those of that step, between two as the step carried
        them (semi-implicit Euler); velocities are as of `Simulation.state_at`. Before time 0 all
        is as it was then.

        Returns:
            Generalised positions, shape (nq,), and velocities, shape (nv,); not to be written to.

        Raises:
            ValueError: The time is not kept any more, or is too far ahead.
        """
        now = self._simulation.time_ns
        stamp_ns = max(stamp_ns, 0)
        if stamp_ns >= now:
            return self._simulation.state_at(stamp_ns)
        steps = now // TIMESTEP_NS
        step, rest = divmod(stamp_ns, TIMESTEP_NS)
        oldest = steps - len(self._states)
        if step < oldest:
            raise ValueError(
                f"history: expected a time from {oldest * TIMESTEP_NS} ns on, which is what "
                f"`keep` asked for, found {stamp_ns} ns"
            )
        qpos, qvel = self._states[step - oldest]
        if step + 1 < steps:
            _, later = self._states[step + 1 - oldest]
        else:
            later = self._simulation.data.qvel
        if rest:
            qpos = qpos.copy()
            mujoco.mj_integratePos(self._simulation.model, qpos, later, rest * 1e-9)
        return qpos, qvel + (later - qvel) * (0.5 + rest / TIMESTEP_NS)
