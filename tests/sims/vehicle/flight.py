"""A tiny world and a plain loop to fly in it; no runtime, no clock."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import Any

import mujoco

from events import Arm, Event, PositionSetpoint, VelocitySetpoint
from sims.vehicle import STANDING_HEIGHT, Autopilot, Physics, State, attach_vehicle

WORLD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="50 50 1"/>
    <geom name="wall" type="box" size="1 3 3" pos="5 0 3"/>
    <body name="ball" pos="-8 0 0.05">
      <freejoint/>
      <geom type="sphere" size="0.05" mass="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""
UP = 30.0
"""Metres above the ground at which `airborne` flights start: above the wall."""

_models: dict[tuple[float, float], Any] = {}


def compiled(height: float = STANDING_HEIGHT, yaw: float = 0.0) -> Any:
    """Return the world with the vehicle `drone` at a height; each is compiled once."""
    if (height, yaw) not in _models:
        spec = mujoco.MjSpec.from_string(WORLD)
        attach_vehicle(spec, "drone", (0.0, 0.0, -height), yaw)
        _models[height, yaw] = spec.compile()
    return _models[height, yaw]


class Flight:
    """A vehicle, its autopilot and a 400 Hz loop over both."""

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        self.autopilot = Autopilot(physics.parameters)
        self.ticks = 0
        self.time = 0.0
        self.events: list[type[Event]] = []

    @property
    def stamp(self) -> int:
        return self.ticks * 2_500_000

    def fly(
        self, seconds: float, say: Callable[[int], Event] | None = None
    ) -> list[tuple[float, State]]:
        """Fly on; `say` makes a command of the stamp at every tick. Returns times and states."""
        track = []
        for _ in range(round(seconds * 400)):
            self.physics.advance_to(self.stamp)
            state = self.physics.state()
            if say is not None:
                self.autopilot.command(say(self.stamp))
            motors = self.autopilot.update(self.stamp, state, self.physics.touching())
            self.physics.set_motors(*motors)
            self.events += self.autopilot.take_events()
            track.append((self.ticks / 400, state))
            self.ticks += 1
        return track


def airborne(yaw: float = 0.0) -> Flight:
    """Return a flight that hovers at `UP` metres, motors turning."""
    physics = Physics(compiled(UP, yaw), "drone")
    physics.data.act[:] = physics.parameters.hover_thrust
    flight = Flight(physics)
    flight.autopilot.command(Arm(stamp=0, source="test"))
    flight.autopilot.command(place(0.0, 0.0, -UP, yaw=yaw))
    return flight


def place(x: float, y: float, z: float, yaw: float = 0.0) -> PositionSetpoint:
    return PositionSetpoint(stamp=0, source="test", position=(x, y, z), yaw=yaw)


def velocity(
    stamp: int, x: float, y: float, z: float = 0.0, yaw_rate: float = 0.0, frame_id: str = "map"
) -> VelocitySetpoint:
    return VelocitySetpoint(
        stamp=stamp, source="test", velocity=(x, y, z), yaw_rate=yaw_rate, frame_id=frame_id
    )


def step_response(track: list[tuple[float, float]], target: float) -> tuple[float, float]:
    """Return overshoot, as a share of the step, and the time after which 5 % are never left."""
    start = track[0][1]
    shares = [(t - track[0][0], (value - start) / (target - start)) for t, value in track]
    overshoot = max(share for _, share in shares) - 1.0
    outside = [t for t, share in shares if abs(share - 1.0) > 0.05]
    settled = outside[-1] if outside[-1] < shares[-1][0] else nan
    return overshoot, settled
