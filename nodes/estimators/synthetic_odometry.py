"""An estimator made of the truth: as late and as wrong as its settings say."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from events import Announcement, EstimatorAnnouncement, Odometry, PoseEstimate
from runtime import Node, NodeConfig, Output, Tick, every, on
from runtime.units import Latency

Share = Annotated[float, msgspec.Meta(ge=0, le=100)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class SyntheticOdometryConfig(NodeConfig):
    """Settings of a synthetic estimator: the ground truth with errors.

    Attributes:
        rate: Estimates per second.
        latency: Time on the run's clock from a pose to its estimate.
        drift: Position error in percent of the distance flown, in a horizontal direction by the
            run's seed.
        heading_drift: Heading error, degrees per metre flown, its sign by the run's seed; the path
            turns with it.
        noise: Standard deviation of the position along each axis, metres.
        velocity_noise: The same of the velocity, m/s; if not given, none is sent.
    """

    rate: Annotated[float, msgspec.Meta(gt=0)] = 30
    latency: Latency = Latency(0.015)  # immutable
    drift: Share = 0.0
    heading_drift: Share = 0.0
    noise: NotNegative = 0.0
    velocity_noise: NotNegative | None = None


class SyntheticOdometry(Node[SyntheticOdometryConfig]):
    """Sender of a vehicle's true pose with a chosen drift, noise and latency.

    Of several vehicles, narrow ``odometry`` to one.
    """

    estimates = Output(PoseEstimate)

    def __init__(self) -> None:
        turn, self._sign = self.rng.uniform(0.0, math.tau), self.rng.choice([-1.0, 1.0])
        self._direction = np.array([math.cos(turn), math.sin(turn), 0.0])
        self._truth: Odometry | None = None
        self._start = np.zeros(3)
        self._distance = 0.0

    def announce(self) -> Iterable[Announcement]:
        """Announce the estimates."""
        method = f"truth, {self.config.drift:g} % drift, {self.config.latency * 1e3:g} ms late"
        yield EstimatorAnnouncement(stamp=0, source=self.name, method=method, reads=("truth",))

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Record the true pose and the distance flown."""
        if self._truth is None:
            self._start = np.array(event.position)
        else:
            self._distance += math.dist(self._truth.position, event.position)
        self._truth = event

    @every(hz="rate")
    def estimate(self, _: Tick) -> None:
        """Estimate the newest pose, to be sent after the latency."""
        if self._truth is not None:
            self.start(self._send(self._worsened(self._truth)))

    async def _send(self, estimate: PoseEstimate) -> None:
        await self.clock.sleep(self.config.latency)
        self.estimates.send(estimate)

    def _worsened(self, truth: Odometry) -> PoseEstimate:
        config = self.config
        angle = self._sign * math.radians(config.heading_drift) * self._distance
        turn = Rotation.from_euler("z", angle)
        position = self._start + turn.apply(np.array(truth.position) - self._start)
        position += config.drift / 100 * self._distance * self._direction
        if config.noise:
            position += self.rng.normal(0.0, config.noise, 3)
        orientation = turn * Rotation.from_quat(truth.orientation, scalar_first=True)
        x, y, z = position.tolist()
        velocity = None
        if config.velocity_noise is not None:
            noise = self.rng.normal(0.0, config.velocity_noise, 3)
            along = orientation.apply(np.array(truth.linear_velocity)) + noise
            velocity = float(along[0]), float(along[1]), float(along[2])
        w, qx, qy, qz = orientation.as_quat(scalar_first=True).tolist()
        return PoseEstimate(
            stamp=truth.stamp,
            source=self.name,
            frame_id=truth.frame_id,
            child_frame_id=truth.child_frame_id,
            position=(x, y, z),
            orientation=(w, qx, qy, qz),
            velocity=velocity,
        )
