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

import numpy as np

from bench.benchmarks import Progress, Row
from bench.harness import paired, silent
from bench.lateness import TakeoffNode
from events import DepthImage, Image, Takeoff, VelocitySetpoint
from runtime import NodeConfig, Output, Tick, every
from runtime.channels.wire import Digest
from runtime.config.reading import parse
from runtime.run.execute import execute
from runtime.summary import Summary
from runtime.workers.shared_memory import SharedPipe, anonymous_file
from sims.cameras import CameraSpec
from sims.cameras.development import Development
from sims.cameras.optics import generator
from sims.sensors.imu import ImuNoise, ImuParameters
from sims.vehicle import STANDING_HEIGHT, Autopilot, Physics, attach_vehicle
from sims.worlds import load_world

CONTROL, IMU = 400, 200
RATE, SIDE = 30, 512
NOISE, DEPTH_NOISE = 2.0, 0.0015
SHORT = 2.0


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


def measure(*, seconds: float = 30.0, repeats: int = 5, progress: Progress = silent) -> list[Row]:
    """Measure, interleaved.

    Args:
        seconds: Simulated, without cameras; a fifth of it with.
    """
    ways: dict[str, Callable[[], float]] = {
        "bare loop": lambda: _bare(seconds),
        "run": lambda: _run(seconds, []),
        "run with cameras": lambda: _run(seconds / 5, [{"name": "front"}]),
    }
    bare, run, cameras = (median(times) for times in paired(ways, repeats, progress).values())
    return [
        {"case": "bare loop", "speed": seconds / bare, "share": None},
        {"case": "run", "speed": seconds / run, "share": 1 - bare / run},
        {"case": "run with cameras", "speed": seconds / 5 / cameras, "share": None},
    ]


def _run(seconds: float, cameras: list[dict[str, Any]]) -> float:
    rates = {"control_rate": CONTROL, "imu_rate": IMU}
    pilot = {"name": "pilot", "type": f"{__name__}:Pilot"}
    drone = {"name": "drone", "type": "Multirotor", "cameras": cameras, **rates}
    return lockstep_run(seconds, pilot, drone).wall_seconds


def lockstep_run(seconds: float, *nodes: dict[str, Any]) -> Summary:
    """Run nodes in lockstep as fast as possible, and return the summary."""
    run = {"duration": seconds, "log": "error", "stall": 1}
    return execute(parse({"run": run, "nodes": [*nodes]}, "bench lockstep"))


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


def measure_parts(
    *, seconds: float = 30.0, repeats: int = 3, progress: Progress = silent
) -> list[Row]:
    """Measure; pairs of a long and a short run follow each other.

    Args:
        seconds: Simulated; by a third of it the longer run is longer.
    """
    wholes, workers = [], []
    for number in range(repeats):
        progress(f"parts: {number + 1} of {repeats}")
        short, _ = _fly(SHORT)
        long, cpu = _fly(SHORT + seconds / 3)
        wholes.append(1e3 * (long - short) / (seconds / 3 * RATE))
        workers.append(cpu)
    whole, drawn, odometry = median(wholes), *map(median, zip(*workers, strict=True))
    noise, copies, hashing = _noise(), _copies(), _hashing()
    parts = {"rendering": drawn - noise, "noise": noise, "copies": copies}
    parts |= {"odometry": odometry, "hashing": hashing}
    parts |= {"rest": whole - sum(parts.values()), "all": whole}
    return [{"part": part, "ms": ms, "share": ms / whole} for part, ms in parts.items()]


def _fly(seconds: float) -> tuple[float, tuple[float, float]]:
    """Return the processor time of a run (s), and of a call of renderer and odometry (ms)."""
    camera = {"name": "camera", "rate": RATE, "noise": NOISE, "depth_noise": DEPTH_NOISE}
    before = sum(os.times()[:4])
    summary = lockstep_run(
        seconds,
        {"name": "drone", "type": "Multirotor", "cameras": [camera]},
        {"name": "pilot", "type": f"{__name__}:Starter"},
        {"name": "odometry", "type": "VisualOdometry"},
        {"name": "evaluation", "type": "Evaluation"},
    )
    spent = sum(os.times()[:4]) - before
    cpu = {name.partition(".")[0]: worker.cpu_p50_ms for name, worker in summary.workers.items()}
    return spent, (cpu["drone"], cpu["odometry"])


def _noise() -> float:
    colours, depth = random_images(SIDE)
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
    images = random_images(SIDE)

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
    colours, depth = random_images(SIDE)
    digest = Digest()
    image = Image(stamp=0, source="drone/camera", frame_id="camera", data=colours)
    far = DepthImage(stamp=0, source="drone/camera", frame_id="camera", data=depth)

    def take_in() -> None:
        digest(None, image)
        digest(None, far)

    return _cost(take_in)


def random_images(side: int) -> tuple[Any, Any]:
    """Return a colour image and a depth image of random pixels."""
    random = np.random.default_rng(0)
    colours = random.integers(0, 256, (side, side, 3), np.uint8)
    return colours, random.uniform(1.0, 8.0, (side, side)).astype(np.float32)


def _cost(do: Callable[[], None], calls: int = 100) -> float:
    times = []
    for _ in range(calls):
        begin = time.process_time()
        do()
        times.append(time.process_time() - begin)
    return 1e3 * median(times)
