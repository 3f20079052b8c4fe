"""From the physics' states to the events of a vehicle's sensors, each at its rate and in time."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import numpy as np

from events import (
    Event,
    FluidPressure,
    SensorAnnouncement,
    TransformStamped,
)
from runtime import Node, Tick
from runtime.sender import Sender
from sims.sensors.barometer import Barometer
from sims.sensors.sensor import Place, Sensor, Truth
from sims.sensors.settings import SensorsConfig


class SensorOutputs(msgspec.Struct, frozen=True):
    """Outputs of the node that carries the sensors."""

    pressures: Sender[FluidPressure]


class SensorSuite:
    """All sensors of one body but its cameras and its IMU.

    Every measurement has the stamp of the state that it is of, and is sent `latency` later. A
    sensor's random numbers depend on the run's seed, its node's name and its own only.

    Args:
        node: The node that carries the sensors; a sensor's source is ``<node>/<sensor>``.
        config: Their settings.
        outputs: Where the events go.
        frame_id: Frame of the body.
        truth: Returns what is true at a tick.
    """

    def __init__(
        self,
        node: Node[Any],
        config: SensorsConfig,
        outputs: SensorOutputs,
        frame_id: str,
        truth: Callable[[Tick], Truth],
    ) -> None:
        self._node = node
        self._outputs = outputs
        self._truth = truth

        def make(model: type[Sensor[Any]], spec: Any, name: str) -> Sensor[Any]:
            place = Place(f"{node.name}/{name}", frame_id, config.origin)
            return model(spec, place, generator_of(node.rng, name))

        self.sensors = [
            make(model, spec, name)
            for model, spec, name in ((Barometer, config.barometer, "barometer"),)
            if spec is not None
        ]

    def start(self) -> None:
        """Have all sensors measure at their rates; call it in `on_startup`."""
        for sensor in self.sensors:
            measure = functools.partial(self._measure, sensor)
            self._node.every(sensor.spec.rate, measure, sensor.source.partition("/")[2])

    def announcements(self) -> Iterable[SensorAnnouncement]:
        """Return the announcements of the sensors."""
        return (sensor.announcement() for sensor in self.sensors)

    def transforms(self) -> Iterable[TransformStamped]:
        """Return the pose of each sensor's frame in the body's, constant for the run."""
        for sensor in self.sensors:
            yield TransformStamped(
                stamp=self._node.clock.now(),
                source=sensor.source,
                frame_id=sensor.place.parent_frame_id,
                child_frame_id=sensor.source,
                translation=sensor.spec.position,
                rotation=sensor.spec.rotation,
                static=True,
            )

    def _measure(self, sensor: Sensor[Any], tick: Tick) -> None:
        if tick.stamp >= sensor.spec.startup_delay * 1e9:
            self._send_later(sensor, sensor.measure(self._truth(tick)))

    def _send_later(self, sensor: Sensor[Any], event: Event) -> None:
        send = getattr(self._outputs, sensor.port).send
        if not sensor.spec.latency:
            send(event)
            return

        async def wait() -> None:
            await self._node.clock.sleep_until(event.stamp + round(sensor.spec.latency * 1e9))
            send(event)

        self._node.start(wait())


def generator_of(parent: np.random.Generator, name: str) -> np.random.Generator:
    """Return a generator that depends on a node's and a sensor's name; the parent's stays."""
    entropy = parent.bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
    return np.random.default_rng([*entropy, zlib.crc32(name.encode())])
