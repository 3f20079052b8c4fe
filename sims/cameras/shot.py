"""What a renderer is asked for: one exposure of one camera, and how the world moves meanwhile."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Motion(NamedTuple):
    """True states of the world while a shutter is open.

    Attributes:
        seconds: Times of the states after the exposure's stamp, rising, shape (k,).
        qpos: Generalised positions at these times, shape (k, nq).
    """

    seconds: Floats
    qpos: Floats


class Shot(NamedTuple):
    """One exposure of one camera.

    Attributes:
        camera: Its name, as in its settings.
        stamp: Nanoseconds on the run's clock: the middle row's mid-exposure.
        qpos: The model's generalised positions then, shape (nq,).
        qvel: Its generalised velocities then, shape (nv,): constant while the shutter is open,
            unless `motion` is known. None: at rest.
        motion: The states from the beginning of the first row's exposure to the end of the last
            one's; needed by a rolling shutter.
        exposure: Seconds that the shutter is open.
        gain: Factor of the amplifier.
    """

    camera: str
    stamp: int
    qpos: Floats
    qvel: Floats | None = None
    motion: Motion | None = None
    exposure: float = 0.0
    gain: float = 1.0

    def moves(self) -> bool:
        """Return whether the state may change while the shutter is open."""
        return self.qvel is not None or self.motion is not None

    def state(self, model: Any, seconds: float) -> Floats:
        """Return the generalised positions some seconds after the stamp, shape (nq,).

        Between two known states the velocity is constant, as `mj_integratePos` understands it.
        """
        if seconds == 0.0 or not self.moves():
            return self.qpos
        if self.motion is None:
            assert self.qvel is not None
            start, velocity, since = self.qpos, self.qvel, seconds
        else:
            times, states = self.motion
            if len(times) == 1:
                return np.asarray(states[0])
            after = int(np.clip(np.searchsorted(times, seconds), 1, len(times) - 1))
            start, velocity = states[after - 1], np.empty(model.nv)
            step = float(times[after] - times[after - 1])
            mujoco.mj_differentiatePos(model, velocity, step, start, states[after])
            since = seconds - float(times[after - 1])
        moved: Floats = start.copy()
        mujoco.mj_integratePos(model, moved, velocity, since)
        return moved
