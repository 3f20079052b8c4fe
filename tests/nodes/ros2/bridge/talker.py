"""A node for the tests: says one of everything again and again, and writes down what it hears."""

from __future__ import annotations

import json
from collections.abc import Iterable

import msgspec
import numpy as np

from events import (
    Announcement,
    DepthImage,
    Event,
    FluidPressure,
    Image,
    Imu,
    LidarScan,
    MagneticField,
    NavSatFix,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Range,
    Score,
    Setpoint,
)
from runtime import Node, NodeConfig, Output, Tick, every, on
from tests.nodes.ros2.bridge.mappings import Battery
from tests.nodes.ros2.messages import samples


class TalkerConfig(NodeConfig):
    """Attributes: enough: Events to hear before the run ends; rate: Hertz."""

    enough: int = 2
    rate: float = 20.0


class Talker(Node[TalkerConfig]):
    """Says one of everything."""

    things = Output(Event)

    def __init__(self) -> None:
        self._heard: dict[str, Event] = {}

    def announce(self) -> Iterable[Announcement]:
        others = Announcement(stamp=0, source="*")
        return [samples.vehicle(), samples.camera(), samples.imu(), samples.estimator(), others]

    @every(hz="rate")
    def talk(self, tick: Tick) -> None:
        now = self.clock.now()
        optical, pose = "drone/camera_optical", ((1.0, 2.0, -3.0), (1.0, 0.0, 0.0, 0.0))
        depth, points = np.full((48, 64), 2.5, np.float32), np.eye(3, dtype=np.float32)
        zero = (0.0, 0.0, 0.0)
        for event in (
            samples.odometry(now),
            samples.image(now),
            DepthImage(stamp=now, source="drone/camera", frame_id=optical, data=depth),
            Imu(
                stamp=now,
                source="drone",
                angular_velocity=zero,
                linear_acceleration=(0.0, 0.0, -9.81),
            ),
            PoseEstimate(
                stamp=now, source="vo", frame_id="map", position=pose[0], orientation=pose[1]
            ),
            PoseStamped(stamp=now, source="drone/camera", position=pose[0], orientation=pose[1]),
            PointCloud(
                stamp=now, source="mapper", points=points, colors=np.full((3, 3), 9, np.uint8)
            ),
            Range(stamp=now, source="drone", range=1.0, min_range=0.1, max_range=5.0),
            FluidPressure(stamp=now, source="drone", fluid_pressure=1e5),
            MagneticField(stamp=now, source="drone", magnetic_field=(1e-5, 2e-5, 3e-5)),
            NavSatFix(stamp=now, source="drone", latitude=47.0, longitude=8.0, altitude=400.0),
            LidarScan(
                stamp=now,
                source="drone/lidar",
                frame_id="base_link",
                points=points,
                intensities=np.zeros(len(points), np.float32),
                times=np.zeros(len(points), np.float32),
                rings=np.zeros(len(points), np.uint16),
            ),
            Battery(stamp=now, source="drone", percentage=0.75),
            Score(stamp=now, source="e", subject="vo", metric="ate", value=0.25, unit="m"),
        ):
            self.things.send(event)

    @on(Setpoint, PoseEstimate, Image)
    def listen(self, event: Event) -> None:
        kind = type(event).__name__
        if kind not in self._heard:
            self._heard[kind] = event
            if len(self._heard) == self.config.enough:
                self.stop("heard enough")

    async def on_shutdown(self) -> None:
        assert self.out is not None
        said_of = {k: msgspec.to_builtins(e, enc_hook=repr) for k, e in self._heard.items()}
        (self.out / "heard.json").write_text(json.dumps(said_of))
