"""Simulated seconds per second, and how much of the time is the runtime's own.

The same flight twice: in a run (supervisor, ticks, events, digest), and in a bare loop that takes
the same physics steps with the same controller and IMU noise. What the run takes beyond the loop
is the runtime's share.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import msgspec
import numpy as np

from bench.lateness import TakeoffNode
from events import Takeoff, VelocitySetpoint
from runtime import NodeConfig, Output, Tick, every
from runtime.config.reading import parse
from runtime.run.execute import execute
from sims.sensors import ImuNoise, ImuParameters
from sims.vehicle import (
    STANDING_HEIGHT,
    Autopilot,
    Physics,
    attach_vehicle,
)
from sims.worlds import load_world

CONTROL, IMU = 400, 200


class LockstepRow(msgspec.Struct, frozen=True, kw_only=True):
    """One way to simulate.

    Attributes:
        case: ``bare loop``, ``run``, ``run with cameras``.
        speed: Simulated seconds per second, median.
        share: Of the time that is the runtime's own (`run` only).
    """

    case: str
    speed: float
    share: float | None = None


class Pilot(TakeoffNode[NodeConfig]):
    """Takes off, then flies gentle curves."""

    setpoints = Output(VelocitySetpoint)

    @every(hz=20)
    def steer(self, tick: Tick) -> None:
        """Fly on, once up."""
        if tick.stamp > 4e9:
            self.setpoints.send(_curve(tick.stamp))


def _curve(stamp: int) -> VelocitySetpoint:
    angle = stamp / 1e9  # a circle of 1 m radius
    velocity = (math.cos(angle), math.sin(angle), 0.0)
    return VelocitySetpoint(stamp=stamp, source="pilot", velocity=velocity)


def measure(
    *, seconds: float = 30.0, repeats: int = 5, progress: Callable[[str], None] = lambda _: None
) -> list[LockstepRow]:
    """Measure, interleaved.

    Args:
        seconds: Simulated, without cameras; a fifth of it with.
        progress: Called with what is being measured.
    """
    bare, run, cameras = [], [], []
    for round_ in range(repeats):
        progress(f"round {round_ + 1} of {repeats}")
        bare.append(_bare(seconds))
        run.append(_run(seconds, []))
        cameras.append(_run(seconds / 5, [{"name": "front"}]))
    share = 1 - median(bare) / median(run)
    return [
        LockstepRow(case="bare loop", speed=seconds / median(bare)),
        LockstepRow(case="run", speed=seconds / median(run), share=share),
        LockstepRow(case="run with cameras", speed=seconds / 5 / median(cameras)),
    ]


def _run(seconds: float, cameras: list[dict[str, Any]]) -> float:
    summary = execute(
        parse(
            {
                "run": {"duration": seconds, "log": "error", "stall": 1},
                "nodes": [
                    {"name": "pilot", "type": f"{__name__}:Pilot"},
                    {
                        "name": "drone",
                        "type": "Multirotor",
                        "cameras": cameras,
                        "control_rate": CONTROL,
                        "imu_rate": IMU,
                    },
                ],
            },
            "bench lockstep",
        )
    )
    return summary.wall_seconds


def _bare(seconds: float) -> float:
    """Fly the same, in a loop."""
    world = load_world("hall")
    attach_vehicle(world, "drone", (0.0, 0.0, -STANDING_HEIGHT), 0.0)
    physics = Physics(world.compile(), "drone")
    autopilot = Autopilot(physics.parameters)
    noise = ImuNoise(ImuParameters(), IMU, np.random.default_rng(0))
    period = 1_000_000_000 // CONTROL
    autopilot.command(Takeoff(stamp=0, source="pilot"))
    begin = time.monotonic()
    for tick in range(int(seconds * CONTROL)):
        stamp = tick * period
        if stamp > 4_000_000_000 and tick % (CONTROL // 20) == 0:
            autopilot.command(_curve(stamp))
        physics.advance_to(stamp)
        touching = physics.touching()
        physics.set_motors(*autopilot.update(stamp, physics.state(), touching))
        autopilot.take_events()
        if tick % (CONTROL // IMU) == 0:
            noise.add(*physics.imu())
            physics.state()
    return time.monotonic() - begin
