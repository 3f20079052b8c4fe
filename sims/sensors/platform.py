"""Base of nodes that carry every sensor: outputs, triggers, exposures, ground truth."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Iterable
from typing import Literal

import events as ev
from runtime import Output, Tick
from runtime.typed import TypeVar
from sims.cameras import CameraSpec, check_cameras
from sims.sensors.sensor import all_sensors
from sims.sensors.suite import SensorsConfig, SensorSuite
from sims.vehicle import State, VehicleMotion
from sims.world import SharedWorld, Simulator, join_world

FRAME = "base_link"  # frame of the body


class PlatformConfig(SensorsConfig):
    """Settings of a body with sensors, however it moves.

    Attributes:
        trigger: ``free``: each camera exposes at its own rate. ``imu``: an IMU sample triggers the
            exposure, so that image, depth, pose and IMU share their stamps; a camera whose rate
            does not divide the IMU's is free as well. In any case the intervals are equal.
    """

    trigger: Literal["free", "imu"] = "free"

    def __post_init__(self) -> None:
        check_cameras(self.cameras)
        super().__post_init__()


P = TypeVar("P", bound=PlatformConfig, default=PlatformConfig)


class SensorPlatform(Simulator[P]):
    """Base of nodes of a body with cameras, an IMU, other sensors, and ground truth.

    A subclass implements `join`, which says how the body moves.
    """

    imu = Output(ev.Imu)
    # An output for each sensor of the table: the body of a class is a namespace to be written to.
    locals().update({model.kind.group: Output(model.kind.event) for model in all_sensors()})
    ranges = Output(ev.Range)
    lidar_scans = Output(ev.LidarScan)

    frame_id = FRAME

    @abstractmethod
    async def join(self, world: SharedWorld) -> VehicleMotion:
        """Take the body's place in a world, and return its motion there."""

    async def on_startup(self) -> None:
        """Build the world and start the renderers."""
        await super().on_startup()
        config = self.config
        await self.rig.start(self._join)  # what draws is imported meanwhile
        self._world.remember(self.rig.past)
        tied = [camera for camera in config.cameras if self._is_tied(camera)]
        for camera in tied:
            self.every(camera.rate, functools.partial(self._trigger, camera.name), camera.name)
        self.every(config.imu_rate, self.sample_sensors, "sample_sensors")
        for camera in config.cameras:  # an image without latency comes after the IMU's sample
            if camera not in tied:
                self.every(camera.rate, functools.partial(self._expose, camera.name), camera.name)
        await self._suite.start()

    async def _join(self) -> SharedWorld:
        self._world = await join_world(self)
        self._motion = await self.join(self._world)
        self._suite = SensorSuite(
            self, self.config, FRAME, self._motion, self._advance, self._world
        )
        self._odometry_stamp = -1
        self._triggered: list[str] = []
        return self._world

    async def run(self) -> None:
        """Send the poses of cameras and sensors on the body, once."""
        await super().run()
        for mounting in self._suite.transforms():
            self.transforms.send(mounting)

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the sensors and the cameras."""
        yield from self._suite.announcements()
        yield from super().announce()
        for camera in self.config.cameras:
            if self.config.trigger == "imu" and not self._is_tied(camera):
                self.log.warning(
                    "%s: %g Hz does not divide the %g Hz of the IMU that is to trigger it: it "
                    "exposes at its own rate, and shares no stamps with the IMU",
                    camera.name,
                    camera.rate,
                    self.config.imu_rate,
                )

    def _is_tied(self, camera: CameraSpec) -> bool:
        periods = self.config.imu_rate / camera.rate
        whole = round(periods) > 0 and math.isclose(periods, round(periods))
        return self.config.trigger == "imu" and whole

    def sample_sensors(self, tick: Tick) -> None:
        """Send an IMU sample and the ground truth, and expose the triggered cameras."""
        stamp = self._advance(tick)
        state, qpos, qvel = self._motion.state_at(stamp)
        self.imu.send(self._suite.imu.sample(stamp, state))
        self._send_odometry(stamp, state)
        for camera in self._triggered:
            self.rig.expose(camera, stamp, qpos, qvel, self._motion.past)
        self._triggered.clear()

    def _trigger(self, camera: str, _: Tick) -> None:
        self._triggered.append(camera)

    def _expose(self, camera: str, tick: Tick) -> None:
        stamp = self._advance(tick)
        state, qpos, qvel = self._motion.state_at(stamp)
        self._send_odometry(stamp, state)
        self.rig.expose(camera, stamp, qpos, qvel, self._motion.past)

    def _advance(self, tick: Tick) -> int:
        """Step the world up to a tick; return the state's stamp, in real time maybe later."""
        self._motion.advance_to(tick.stamp)
        return max(tick.stamp, self._motion.time_ns)

    def _send_odometry(self, stamp: int, state: State) -> None:
        if stamp > self._odometry_stamp:
            self._odometry_stamp = stamp
            self._send_state(stamp, state)
