"""A vehicle's sensors: their settings, and their events, each at its rate and in time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import mujoco

from events import Announcement, Event, Imu, TransformStamped
from events.frames import flip_yz, flip_yz_rotation
from runtime import Node, Tick
from sims.calibration import generator_of
from sims.sensors.calibration import announced, difference
from sims.sensors.imu import ImuModel, ImuParameters, Motion, mean_between, motion_at
from sims.sensors.lidar import Lidar, LidarRig, LidarSpec
from sims.sensors.rays import RangeFinder, RangeFinderSpec, Rays
from sims.sensors.sensor import (
    Mounted,
    Place,
    Sensor,
    Truth,
    all_sensors,
)
from sims.vehicle import State, VehicleMotion
from sims.world import Rate, SharedWorld, SimulatorConfig

_RATE = 200


class SensorsConfig(SimulatorConfig):
    """Settings of a vehicle's sensors.

    Attributes:
        imu_rate: Rate of the IMU and of the ground truth (`odometry`; also at each exposure), Hz.
        imu: Noise of the IMU, or the name of a preset.
        {sensors}
        range_finders: The range finders.
        lidars: The lidars.
    """

    imu_rate: Rate = _RATE
    imu: ImuParameters = ImuParameters()
    # A setting for each sensor of the table: the body of a class is a namespace to be written to.
    __annotations__ |= {model.kind.name: model.spec_type | None for model in all_sensors()}
    locals().update(dict.fromkeys([model.kind.name for model in all_sensors()]))
    range_finders: tuple[RangeFinderSpec, ...] = ()
    lidars: tuple[LidarSpec, ...] = ()

    def __post_init__(self) -> None:
        if self.imu.rate:
            if self.imu_rate not in (_RATE, self.imu.rate):
                rates = f"{self.imu_rate:g} and {self.imu.rate:g} Hz"
                raise ValueError(f"imu.rate: expected imu_rate or this, found {rates}")
            msgspec.structs.force_setattr(self, "imu_rate", self.imu.rate)
        for field in ("gyroscope_bandwidth", "accelerometer_bandwidth"):
            bandwidth, half = getattr(self.imu, field), self.imu_rate / 2
            if bandwidth >= half:
                rates = f"{bandwidth:g} Hz of {self.imu_rate:g} Hz"
                raise ValueError(f"imu.{field}: expected less than half of imu_rate, found {rates}")
        names = {"imu", *(sensor.kind.name for sensor in all_sensors())}
        for field in ("cameras", "range_finders", "lidars"):
            for spec in getattr(self, field):
                if spec.name in names:
                    raise ValueError(
                        f"{field}: {spec.name}: expected a name of its own, found that of "
                        "another sensor"
                    )
                names.add(spec.name)


SensorsConfig.__doc__ = str(SensorsConfig.__doc__).replace(
    "{sensors}", "\n        ".join(f"{model.kind.name}: {model.meaning}" for model in all_sensors())
)


def mount_imu(world: mujoco.MjSpec, vehicle: str, parameters: ImuParameters) -> None:
    """Put the sensors of a vehicle's model where its IMU is, before the world is compiled."""
    if parameters.mounted:
        site = world.site(f"{vehicle}/imu")
        site.pos, site.quat = flip_yz(parameters.position), flip_yz_rotation(parameters.rotation)


class VehicleImu(ImuModel):
    """IMU of a vehicle: its model, fed from the vehicle's motion."""

    def __init__(
        self, node: Node[Any], config: SensorsConfig, body: VehicleMotion, place: Place
    ) -> None:
        constants = generator_of(node.rng, "imu")
        super().__init__(config.imu, config.imu_rate, node.rng, constants, place)
        self._body = body
        self._before: tuple[int, Motion] | None = None
        self._frame_id = self.announcement().frame_id

    def sample(self, stamp: int, state: State) -> Imu:
        """Return the measurement of the present, in a state of the same stamp."""
        rates, force = self._body.imu(stamp)
        if self.spec.sampling == "mean":
            motion = motion_at(self.spec, state.orientation, state.velocity, state.angular_velocity)
            if self._before is not None and stamp > self._before[0]:
                seconds = (stamp - self._before[0]) / 1e9
                rates, force = mean_between(self._before[1], motion, seconds, self._body.gravity)
            self._before = stamp, motion
        rates, force = self.measure(rates, force, self._body.thrusts)
        return Imu(
            stamp=stamp,
            source=self.source,
            frame_id=self._frame_id,
            angular_velocity=rates,
            linear_acceleration=force,
        )

    def forget(self) -> None:
        """Forget the last motion, after a jump of the vehicle."""
        self._before = None


class SensorSuite:
    """All sensors of a vehicle, a source ``<node>/<sensor>`` each, but its cameras.

    Every measurement has the stamp of its state, and is sent `latency` later. A sensor's random
    numbers depend on the run's seed, its node's name and its own only.

    Args:
        body: The vehicle's motion.
        advance: Steps the world up to a tick, and returns the stamp of the state then.
    """

    def __init__(
        self,
        node: Node[Any],
        config: SensorsConfig,
        frame_id: str,
        body: VehicleMotion,
        advance: Callable[[Tick], int],
        world: SharedWorld,
    ) -> None:
        self._node = node
        self._body = body
        self._advance = advance
        self._world = world
        self._frame_id = frame_id
        self._random = node.rng.bit_generator.state

        def place(name: str) -> Place:
            return Place(f"{node.name}/{name}", frame_id, config.origin)

        self._make_imu = functools.partial(VehicleImu, node, config, body, place("imu"))

        def making(
            model: Callable[..., Sensor[Any]], spec: Any, name: str, *rest: Any
        ) -> Callable[[], Sensor[Any]]:
            return lambda: model(spec, place(name), generator_of(node.rng, name), *rest)

        self._making = [
            making(model, spec, model.kind.name)
            for model in all_sensors()
            if (spec := getattr(config, model.kind.name)) is not None
        ]
        if config.range_finders:
            rays = Rays(body.model, world.dynamics, f"{node.name}/base_link")
            self._making += [making(RangeFinder, s, s.name, rays) for s in config.range_finders]
        self._begin()
        lidars = [Lidar(spec, place(spec.name)) for spec in config.lidars]
        self.mounted: list[Mounted[Any]] = [*self.sensors, *lidars]
        self.lidars = LidarRig(node, lidars, body, advance)

    async def start(self) -> None:
        """Start the measurements of all sensors; call in `on_startup`."""
        await self.lidars.start(self._world)
        self._random = self._node.rng.bit_generator.state
        for index, sensor in enumerate(self.sensors):
            measure = functools.partial(self._measure, index)
            self._node.every(sensor.spec.rate, measure, sensor.source.partition("/")[2])

    def reset(self) -> None:
        """Begin anew with the start's random numbers; lidars and pending sends go on."""
        self._node.rng.bit_generator.state = self._random
        self._begin()

    def _begin(self) -> None:
        self.imu = self._make_imu()
        """The IMU, whose samples the vehicle's node takes and sends itself."""
        self.sensors = [make() for make in self._making]

    def announcements(self) -> Iterable[Announcement]:
        """Return the announcements of the sensors."""
        for sensor in (self.imu, *self.mounted):
            announced = self._known(sensor)
            if sensor.spec.wrong is not None:  # told once the run is over
                self._node.note_truth(
                    announced.source, difference(announced, sensor.announcement())
                )
            yield announced

    def transforms(self) -> Iterable[TransformStamped]:
        """Return the announced pose of each sensor's frame in the body's, constant for the run."""
        own = (self.imu,) if self.imu.spec.framed else ()
        for sensor in (*own, *self.mounted):
            known = self._known(sensor)
            yield TransformStamped(
                stamp=self._node.clock.now(),
                source=sensor.source,
                frame_id=self._frame_id,
                child_frame_id=sensor.source,
                translation=known.position,
                rotation=known.orientation,
                static=True,
            )

    def _known(self, sensor: Mounted[Any]) -> Any:
        """Return the announcement of a sensor, with the errors of its calibration."""
        true, error = sensor.announcement(), sensor.spec.wrong
        if error is None:
            return true
        return announced(true, error, self._node.rng, sensor.source.partition("/")[2])

    def _measure(self, index: int, tick: Tick) -> None:
        sensor = self.sensors[index]
        if tick.stamp >= sensor.spec.startup_delay * 1e9:
            stamp = self._advance(tick)
            state, qpos, _ = self._body.state_at(stamp)
            wind = self._world.wind_at(self._node.name)
            truth = Truth(stamp=stamp, qpos=qpos, wind=wind, **msgspec.structs.asdict(state))
            self._send_later(sensor, sensor.measure(truth))

    def _send_later(self, sensor: Sensor[Any], event: Event) -> None:
        send = getattr(self._node, sensor.kind.group).send
        if not sensor.spec.latency:
            send(event)
            return

        async def wait() -> None:
            await self._node.clock.sleep_until(event.stamp + round(sensor.spec.latency * 1e9))
            send(event)

        self._node.start(wait())
