"""What moves or changes in a world by itself: pure functions of simulated time.

Physics, renderers and lidars, each in its own process, apply the same `Dynamics` to their copy of
the model, and so see the same world at the same time.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import mujoco


class Motion(Protocol):
    """One thing that moves or changes. An implementation can be pickled.

    Attributes:
        solid: Whether vehicles can touch what it moves; else the physics need not know of it.
    """

    @property
    def solid(self) -> bool:
        """Whether vehicles can touch what it moves."""

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Put it where, or make it as, it is at a time.

        What is written must not depend on what was there before, only on `seconds`.

        Args:
            model: The compiled world; lights and colours may be written to.
            data: MuJoCo's data of it; ``mocap_pos`` and ``mocap_quat`` may be written to.
            seconds: Simulated time, from 0 on.
        """


class Dynamics(NamedTuple):
    """All that moves or changes in a world by itself.

    Attributes:
        motions: In the order in which they are applied.
        fog: Whether the world is drawn with fog, as MuJoCo's settings of it say.
    """

    motions: tuple[Motion, ...] = ()
    fog: bool = False

    def joined(self, other: Dynamics) -> Dynamics:
        """Return these and what moves or changes besides."""
        return Dynamics(self.motions + other.motions, self.fog or other.fog)

    @property
    def solid(self) -> Dynamics:
        """What of it vehicles can touch."""
        return Dynamics(tuple(motion for motion in self.motions if motion.solid))

    def apply(self, model: Any, data: Any, seconds: float) -> None:
        """Make the world as it is at a time; kinematics and lights are computed after that."""
        for motion in self.motions:
            motion.apply(model, data, seconds)


class Scene(NamedTuple):
    """A world before it is compiled, and what moves in it by itself."""

    spec: mujoco.MjSpec
    dynamics: Dynamics = Dynamics()
