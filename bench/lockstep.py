"""Simulated seconds per second, and how much of the time is the runtime's own.

The same flight twice: in a run (supervisor, ticks, events, digest), and in a bare loop that takes
the same physics steps with the same controller and IMU noise. What the run takes beyond the loop
is the runtime's share.

And where the processor time of a run with images goes: milliseconds a frame, by part. The standard
tour's first seconds are flown twice, and the shorter run is taken from the longer one: what is left
is what frames cost, without start and end. The workers' own time is in the run's summary; noise,
copies and hashing are measured on images of the same size, outside the run.
"""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import msgspec
import numpy as np

from bench.lateness import TakeoffNode
from bench.system import in_turns
from events import DepthImage, Image, Takeoff, VelocitySetpoint
from runtime import NodeConfig, Output, Tick, every
from runtime.channels.digest import Digest
from runtime.config.reading import parse
from runtime.run.execute import execute
from runtime.workers.shared_memory import SharedPipe, anonymous_file
from sims.cameras import CameraSpec
from sims.cameras.development import Development
from sims.cameras.response import generator
from sims.sensors import ImuNoise, ImuParameters
from sims.vehicle import STANDING_HEIGHT, Autopilot, Physics, attach_vehicle
from sims.worlds import load_world

CONTROL, IMU = 400, 200
RATE, SIDE = 30, 512
NOISE, DEPTH_NOISE = 2.0, 0.0015
SHORT = 2.0


class LockstepRow(msgspec.Struct, frozen=True, kw_only=True):
    """Speed of a way to simulate.

    Attributes:
        speed: Simulated seconds per second, median.
        share: Of the time that is the runtime's own (`run` only).
    """

    case: str
    speed: float
    share: float | None = None


class PartRow(msgspec.Struct, frozen=True, kw_only=True):
    """Part of the cost of a frame.

    Attributes:
        ms: Processor time of all processes, milliseconds a frame, median.
    """

    part: str
    ms: float
    share: float


class Starter(TakeoffNode[NodeConfig]):
    """Takes off."""


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
    """
    ways: dict[str, Callable[[], float]] = {
        "bare loop": lambda: _bare(seconds),
        "run": lambda: _run(seconds, []),
        "run with cameras": lambda: _run(seconds / 5, [{"name": "front"}]),
    }
    taken: dict[str, list[float]] = {way: [] for way in ways}
    for number, way in in_turns(ways, repeats):
        progress(f"round {number + 1} of {repeats}")
        taken[way].append(ways[way]())
    bare, run, cameras = (median(times) for times in taken.values())
    return [
        LockstepRow(case="bare loop", speed=seconds / bare),
        LockstepRow(case="run", speed=seconds / run, share=1 - bare / run),
        LockstepRow(case="run with cameras", speed=seconds / 5 / cameras),
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


def measure_parts(*, seconds: float = 10.0, repeats: int = 3) -> list[PartRow]:
    """Measure; pairs of a long and a short run follow each other.

    Args:
        seconds: Simulated, by which the longer run is longer.
    """
    wholes, workers = [], []
    for _ in range(repeats):
        short, _ = _fly(SHORT)
        long, cpu = _fly(SHORT + seconds)
        wholes.append(1e3 * (long - short) / (seconds * RATE))
        workers.append(cpu)
    whole, drawn, odometry = median(wholes), *map(median, zip(*workers, strict=True))
    noise, copies, hashing = _noise(), _copies(), _hashing()
    parts = {"rendering": drawn - noise, "noise": noise, "copies": copies}
    parts |= {"odometry": odometry, "hashing": hashing}
    parts |= {"rest": whole - sum(parts.values()), "all": whole}
    return [PartRow(part=part, ms=ms, share=ms / whole) for part, ms in parts.items()]


def _fly(seconds: float) -> tuple[float, tuple[float, float]]:
    """Return the processor time of a run (s), and of a call of renderer and odometry (ms)."""
    camera = {"name": "camera", "rate": RATE, "noise": NOISE, "depth_noise": DEPTH_NOISE}
    nodes: list[dict[str, Any]] = [
        {"name": "drone", "type": "Multirotor", "cameras": [camera]},
        {"name": "pilot", "type": f"{__name__}:Starter"},
        {"name": "odometry", "type": "VisualOdometry"},
        {"name": "evaluation", "type": "Evaluation"},
    ]
    before = sum(os.times()[:4])
    run = {"duration": seconds, "log": "error", "stall": 1}
    summary = execute(parse({"run": run, "nodes": nodes}, "bench lockstep"))
    spent = sum(os.times()[:4]) - before
    cpu = {name.partition(".")[0]: worker.cpu_p50_ms for name, worker in summary.workers.items()}
    return spent, (cpu["drone"], cpu["odometry"])


def _noise() -> float:
    colours, depth = _images()
    random = generator(1, "camera", 0)

    camera = Development(CameraSpec(name="camera", noise=NOISE, depth_noise=DEPTH_NOISE))

    def add() -> None:
        camera.develop([colours], random)
        camera.measure(depth, (), random)

    return _cost(add)


def _copies() -> float:
    """Return the cost (ms) of handing images to the run, and on to the odometry."""
    files = anonymous_file(), anonymous_file()
    ours, theirs = socket.socketpair()
    here = SharedPipe(ours, *files)
    there = SharedPipe(theirs, *map(os.dup, reversed(files)))
    images = _images()

    def hand_over() -> None:
        for _ in range(2):
            there.unpack(bytearray(here.pack(images)[8:]))
            here.unpack(bytearray(there.pack(None)[8:]))  # brings back what is read

    try:
        return _cost(hand_over)
    finally:
        here.close()
        there.close()


def _hashing() -> float:
    colours, depth = _images()
    digest = Digest()
    image = Image(stamp=0, source="drone/camera", frame_id="camera", data=colours)
    far = DepthImage(stamp=0, source="drone/camera", frame_id="camera", data=depth)

    def take_in() -> None:
        digest(None, image)
        digest(None, far)

    return _cost(take_in)


def _images() -> tuple[Any, Any]:
    random = np.random.default_rng(0)
    colours = random.integers(0, 256, (SIDE, SIDE, 3), np.uint8)
    return colours, random.uniform(1.0, 8.0, (SIDE, SIDE)).astype(np.float32)


def _cost(do: Callable[[], None], calls: int = 100) -> float:
    times = []
    for _ in range(calls):
        begin = time.process_time()
        do()
        times.append(time.process_time() - begin)
    return 1e3 * median(times)
