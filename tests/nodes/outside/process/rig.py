"""A rig without a simulator, and the stub of a program as an estimator in a worker."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    VehicleAnnouncement,
)
from nodes.estimators import Estimator, RgbdFrame, TrackingResult
from nodes.outside.process import Process
from runtime import Bundle, Duration, Node, NodeConfig, Output, Tick, every
from runtime.config.model import Config, NodeSpec, OnError, RunConfig
from runtime.run.execute import execute
from runtime.summary import Summary
from runtime.testing import spec

ROOT = Path(__file__).parents[4]
STUB = str(Path(__file__).with_name("stub.py"))
HEIGHT, WIDTH = 6, 8
LOOKING_AHEAD = (0.5, 0.5, 0.5, 0.5)


class EyesConfig(NodeConfig):
    """Settings of the rig."""

    cameras: tuple[str, ...] = ("camera",)
    images: tuple[str, ...] = ("rgb", "depth")
    rate: float = 30.0
    leaves_out: tuple[int, ...] = ()
    inertial: bool = True
    truth: bool = False
    time_offset: float = 0.0


class Eyes(Node[EyesConfig]):
    """Cameras and an IMU on a vehicle that stands."""

    frames = Output(Image)
    depth = Output(DepthImage)
    samples = Output(Imu)
    poses = Output(Odometry)
    count = 0

    def announce(self) -> list[Announcement]:
        mount: dict[str, Any] = {"stamp": 0, "parent_frame_id": "base_link"}
        cameras: list[Announcement] = [
            CameraAnnouncement(
                source=f"drone/{name}",
                images=self.config.images,
                info=CameraInfo.from_fov(WIDTH, HEIGHT, math.pi / 2),
                rate=self.config.rate,
                latency=0.0,
                time_offset=self.config.time_offset,
                frame_id=f"{name}_optical",
                position=(0.2, 0.1 * number, 0.0),
                orientation=LOOKING_AHEAD,
                baseline=0.1 * number,
                stereo=f"drone/{self.config.cameras[0]}" if number else "",
                **mount,
            )
            for number, name in enumerate(self.config.cameras)
        ]
        imu = ImuAnnouncement(
            source="drone/imu",
            rate=200.0,
            frame_id="imu",
            gyroscope_noise_density=1e-4,
            gyroscope_random_walk=1e-5,
            accelerometer_noise_density=1e-3,
            accelerometer_random_walk=1e-4,
            **mount,
        )
        vehicle = VehicleAnnouncement(
            stamp=0,
            source="drone",
            mass=1.0,
            max_thrust=20.0,
            control_rate=400,
            position=(1.0, 2.0, -0.1),
            orientation=(1.0, 0.0, 0.0, 0.0),
        )
        return [vehicle, *cameras, *([imu] if self.config.inertial else [])]

    @every(hz=200)
    def feel(self, tick: Tick) -> None:
        zero = (0.0, 0.0, 0.0)
        self.samples.send(
            Imu(
                stamp=self.clock.now(),
                source="drone/imu",
                frame_id="imu",
                angular_velocity=zero,
                linear_acceleration=(0.0, 0.0, -9.81),
            )
        )

    @every(hz="rate")
    def see(self, tick: Tick) -> None:
        stamp, number = self.clock.now(), self.count
        if self.config.truth:
            still: dict[str, Any] = dict.fromkeys(
                ("linear_velocity", "angular_velocity"), (0.0,) * 3
            )
            pose: dict[str, Any] = {
                "position": (1.0, 2.0, -0.1),
                "orientation": (1.0, 0.0, 0.0, 0.0),
            }
            self.poses.send(Odometry(stamp=stamp, source="drone", **pose, **still))
        self.count += 1
        for eye, name in enumerate(self.config.cameras):
            if number in self.config.leaves_out and eye == len(self.config.cameras) - 1:
                continue
            event: dict[str, Any] = {"stamp": stamp, "source": f"drone/{name}"}
            event["frame_id"] = f"{name}_optical"
            data = np.full((HEIGHT, WIDTH, 3), (number * 7 + eye) % 251, np.uint8)
            colour = "rgb" in self.config.images
            self.frames.send(
                Image(
                    **event,
                    encoding="rgb8" if colour else "mono8",
                    data=data if colour else data[:, :, 0].copy(),
                )
            )
            if "depth" in self.config.images:
                self.depth.send(
                    DepthImage(**event, data=np.full((HEIGHT, WIDTH), 1 + number, np.float32))
                )


class Twin:
    """What the stub answers, for a worker's process."""

    def __init__(self) -> None:
        self.sequence = 0

    def track(self, data: npt.NDArray[np.uint8]) -> TrackingResult:
        """Return the pose of the next image."""
        pose = np.eye(4)
        pose[2, 3] = self.sequence + data.flat[0] / 1000
        self.sequence += 1
        return TrackingResult(pose - np.diag([0, 0, 0, 0.0]))


class AsWorker(Estimator):
    """The stub as an estimator whose tracker runs in a worker."""

    needs = frozenset({"grey", "depth"})
    frames = Bundle(RgbdFrame)

    async def on_ready(self) -> None:
        self.twin = await self.worker(Twin, latency=self.config.latency)

    async def run(self) -> None:
        async for image, _ in self.frames:
            self.publish(image, await self.twin.call(Twin.track, image.data))


def program(
    *modes: str, on_error: OnError = "stop", inputs: Mapping[str, str] | None = None, **config: Any
) -> NodeSpec:
    """Return the node that runs the stub."""
    settings = {
        "command": [sys.executable, STUB, *modes],
        "environment": {
            "PYTHONPATH": str(ROOT / "nodes" / "outside" / "native"),
            "OMP_NUM_THREADS": "1",
        },
        "latency": 0.015,
        "grace": 0.5,
    }
    return spec(Process, "slam", settings | config, on_error, inputs)


def fly(
    node: NodeSpec,
    out: Path,
    duration: float = 0.5,
    clock: Any = "lockstep",
    handlers: list[logging.Handler] | None = None,
    others: tuple[NodeSpec, ...] = (),
    **eyes: Any,
) -> Summary:
    """Run the rig and a node for a while."""
    settings = RunConfig(duration=Duration(duration), seed=3, clock=clock)
    return execute(
        Config(run=settings, nodes=(spec(Eyes, "drone", eyes), *others, node)),
        out,
        handlers=handlers,
    )
