"""Physics of a world with all its vehicles: stepping, present state and past states."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from sims.vehicle.model import TIMESTEP_NS

Floats = npt.NDArray[np.float64]


class PhysicsDivergedError(Exception):
    """State no longer finite: the world's model or a written state is at fault."""


class Influence(Protocol):
    """Influence on a world besides its physics: wind, self-moving bodies."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Apply the influence at a time; called every millisecond, from the first on."""


class Simulation:
    """A world, stepped by whole milliseconds.

    What is read is exactly that of `time_ns`: the accelerometer too. MuJoCo's ``mj_step`` leaves
    sensors and contacts of *before* its last integration behind, so the present forward pass is
    made when they are first asked for, and the next advance starts from it with ``mj_step2``. The
    motors' thrust is a state of its own (their lag), so a new command changes nothing at its
    instant: the order in which vehicles are controlled does not matter.

    Attributes:
        mocap_velocities: Of the bodies that move by themselves, m/s NWU, shape (nmocap, 3).
        diverged: Whether its state was not finite once, and is of no use any more.

    Raises:
        ValueError: The world has another time step.
    """

    def __init__(self, model: Any, influences: Sequence[Influence] = ()) -> None:
        if abs(model.opt.timestep * 1e9 - TIMESTEP_NS) > 1e-3:
            raise ValueError(
                f"expected a world with a time step of 0.001 s, found {model.opt.timestep} s"
            )
        self.model = model
        self.data: Any = mujoco.MjData(model)
        self._past: deque[tuple[Floats, Floats]] = deque(maxlen=0)  # of each millisecond
        self.diverged = False
        self.influences = tuple(influences)
        self._steps = 0
        self._fresh = False
        self._apply()

    @property
    def time_ns(self) -> int:
        """Nanoseconds simulated since the start or the last `reset`; whole milliseconds."""
        return self._steps * TIMESTEP_NS

    def advance_to(self, stamp_ns: int) -> None:
        """Step to the last whole millisecond up to a time, or raise a `PhysicsDivergedError`."""
        steps = stamp_ns // TIMESTEP_NS - self._steps
        if steps <= 0:
            return
        if self._past.maxlen or self.influences:
            for _ in range(steps):
                if self._past.maxlen:
                    self._past.append((self.data.qpos.copy(), self.data.qvel.copy()))
                self._step(1)
                self._apply()
        else:
            self._step(steps)
        # MuJoCo starts again at time 0 when it finds a number that is not finite.
        if self.data.time < (self._steps - 0.5) * 1e-9 * TIMESTEP_NS:
            self.diverged = True
            raise PhysicsDivergedError(
                f"the simulation diverged before {self.time_ns / 1e9:.3f} s: "
                "its state was no longer finite"
            )

    def state_at(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the state at a time from `time_ns` up to a whole step later.

        Between two steps the world is carried on as the next step will carry it. (Damped joints of
        other bodies, which MuJoCo steps implicitly, may differ slightly.)

        Returns:
            Copies of the generalised positions, shape (nq,), and of the velocities with which these
            change, shape (nv,): MuJoCo's own are half a step old, of the middle of the step before.

        Raises:
            ValueError: The time is before `time_ns`, or more than a step later.
        """
        ahead = stamp_ns - self.time_ns
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        if not 0 <= ahead <= TIMESTEP_NS:
            expected = f"{self.time_ns} to {self.time_ns + TIMESTEP_NS} ns"
            raise ValueError(f"state_at: expected a time of {expected}, found {stamp_ns} ns")
        self.refresh()
        if ahead:
            # As semi-implicit Euler does it: first the velocity, and with that the position.
            next_qvel = qvel + self.data.qacc * (TIMESTEP_NS * 1e-9)
            mujoco.mj_integratePos(self.model, qpos, next_qvel, ahead * 1e-9)
        return qpos, qvel + self.data.qacc * ((ahead + TIMESTEP_NS / 2) * 1e-9)

    def keep(self, seconds: float) -> None:
        """Keep at least the states of the last `seconds` from now on, for `past`."""
        steps = math.ceil(seconds * 1e9 / TIMESTEP_NS) + 1
        if steps > (self._past.maxlen or 0):
            self._past = deque(self._past, maxlen=steps)

    def past(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return the world's state at a kept time, or up to a step ahead.

        On a whole millisecond positions are those of that step, between two as the step carried
        them (semi-implicit Euler); velocities are as of `state_at`. Time begins with 0.

        Returns:
            Generalised positions, shape (nq,), and velocities, shape (nv,); not to be written to.

        Raises:
            ValueError: The time is not kept any more, or is too far ahead.
        """
        stamp_ns = max(stamp_ns, 0)
        if stamp_ns >= self.time_ns:
            return self.state_at(stamp_ns)
        step, rest = divmod(stamp_ns, TIMESTEP_NS)
        oldest = self._steps - len(self._past)
        if step < oldest:
            raise ValueError(
                f"history: expected a time from {oldest * TIMESTEP_NS} ns on, which is what "
                f"`keep` asked for, found {stamp_ns} ns"
            )
        qpos, qvel = self._past[step - oldest]
        newest = step + 1 == self._steps
        later = self.data.qvel if newest else self._past[step + 1 - oldest][1]
        if rest:
            qpos = qpos.copy()
            mujoco.mj_integratePos(self.model, qpos, later, rest * 1e-9)
        return qpos, qvel + (later - qvel) * (0.5 + rest / TIMESTEP_NS)

    def refresh(self) -> None:
        """Have sensors, contacts and accelerations be those of the present instant."""
        if not self._fresh:
            mujoco.mj_forward(self.model, self.data)
            self._fresh = True

    def changed(self) -> None:
        """Take note of a state written into `data`."""
        self._fresh = False

    def add_influence(self, influence: Influence) -> None:
        """Apply an influence each millisecond from the next on, after others, `reset` or not."""
        self.influences += (influence,)

    def trial(self, seconds: float) -> Any:
        """Return MuJoCo's data of some seconds after the start, if nothing is done meanwhile."""
        trial = mujoco.MjData(self.model)
        mujoco.mj_step(self.model, trial, round(seconds * 1e9) // TIMESTEP_NS)
        return trial

    def reset(self) -> None:
        """Go back to the start: time 0, the world as compiled, motors off."""
        mujoco.mj_resetData(self.model, self.data)
        self._steps = 0
        self._fresh = False
        self._past.clear()
        self._apply()

    def _apply(self) -> None:
        before = self.data.mocap_pos.copy()
        for influence in self.influences:
            influence.apply(self.model, self.data, self._steps * TIMESTEP_NS * 1e-9)
        self.mocap_velocities = (self.data.mocap_pos - before) / (TIMESTEP_NS * 1e-9)

    def _step(self, steps: int) -> None:
        self._steps += steps
        if self._fresh:
            self._fresh = False
            mujoco.mj_step2(self.model, self.data)
            steps -= 1
        if steps:
            mujoco.mj_step(self.model, self.data, steps)
