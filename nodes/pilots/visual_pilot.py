"""A scripted flight on an estimator's poses: visual navigation in closed loop."""

from __future__ import annotations

import math

from events import Hover, PlannedPose, PoseEstimate, Vector3, VelocitySetpoint
from events.frames import yaw_of
from nodes.pilots.pilot import Pilot, PilotConfig, Positive
from nodes.pilots.waypoint_path import WaypointPath
from runtime import Duration, Output, on
from runtime.config.parameters import Changeable


class VisualPilotConfig(PilotConfig):
    """Settings of a visual pilot, besides those of every scripted flight.

    Attributes:
        gain: Correction for the distance from the path, (m/s)/m.
        yaw_gain: Correction for the error of the heading, (rad/s)/rad.
        max_correction: Highest speed of the correction, metres per second.
        estimate_timeout: Age of the newest estimate beyond which the vehicle stops and waits for
            the next one.
        landing_timeout: Time for which it waits; then it lands where it is, and the run ends.
    """

    gain: Changeable[Positive] = 1.0
    yaw_gain: Changeable[Positive] = 1.0
    max_correction: Changeable[Positive] = 0.5
    estimate_timeout: Changeable[Duration] = Duration(0.5)  # immutable
    landing_timeout: Changeable[Duration] = Duration(10.0)


class VisualPilot(Pilot[VisualPilotConfig]):
    """Flies a vehicle along waypoints by the poses that an estimator gives.

    It knows no other pose, and sends velocities in the frame of the vehicle's own heading, so every
    error of the estimate, that of the heading included, shows in the flight. (The vehicle itself
    holds its attitude and velocity, by its true state.)

    Waypoints are in the frame of the first estimate. Estimates in any other frame are ignored:
    those of a restarted estimator, for example, are in ``odom_1``, whose origin is where the
    vehicle was then. Without estimates the vehicle hovers; it goes on when estimates in the first
    frame come again, and lands when they do not.
    """

    setpoints = Output(VelocitySetpoint)
    plans = Output(PlannedPose)

    def __init__(self) -> None:
        super().__init__()
        self._frame = ""
        self._refused = ""

    @on(PoseEstimate)
    def estimates(self, event: PoseEstimate) -> None:
        """Note the estimated pose, if it is in the frame of the flight."""
        frame = self._frame = self._frame or event.frame_id
        if event.frame_id != frame:
            if event.frame_id != self._refused:
                self._refused = event.frame_id
                self.log.warning(
                    "%s: expected estimates in %s, found %s: not followed",
                    event.source,
                    frame,
                    event.frame_id,
                )
            return
        self.update_pose(event)

    async def follow(self, path: WaypointPath) -> None:
        """Send the path's velocity, corrected for the distance of the estimate from the path."""
        clock = self.clock
        step, last = round(path.step * 1e9), len(path.position) - 1
        start = clock.now()
        for index in range(last + 1):
            await clock.sleep_until(start + index * step)
            waited = await self._wait_for_estimate()
            if waited is None:
                return
            start += waited
            now = clock.now()
            x, y, z = path.position[index].tolist()
            yaw = float(path.yaw[index])
            vehicle = self.config.vehicle
            self.plans.send(
                PlannedPose(
                    stamp=now, source=self.name, vehicle=vehicle, position=(x, y, z), yaw=yaw
                )
            )
            assert self.pose is not None
            # Compared with the path at the stamp of the image, so that its age does not matter.
            then = min(max(round((self.pose.stamp - start) / step), 0), last)
            config = self.config  # which may change during the flight
            correction = config.gain * (path.position[then] - self.pose.position)
            size = math.sqrt(float(correction @ correction))
            if size > config.max_correction:
                correction *= config.max_correction / size
            north, east, down = (path.velocity[index] + correction).tolist()
            yaw_error = _wrap(float(path.yaw[then]) - yaw_of(self.pose.orientation))
            # The estimated heading now: the path's, less the error.
            velocity = _turned((north, east, down), yaw_error - yaw)
            self.setpoints.send(
                VelocitySetpoint(
                    stamp=now,
                    source=self.name,
                    vehicle=vehicle,
                    frame_id="heading",
                    velocity=velocity,
                    yaw_rate=float(path.yaw_rate[index]) + config.yaw_gain * yaw_error,
                )
            )

    async def _wait_for_estimate(self) -> int | None:
        """Stop while the newest estimate is too old.

        Returns:
            Time that this took (ns); `None` if it took so long that the flight is over.
        """
        start = self.clock.now()
        assert self.pose is not None
        if start - self.pose.stamp <= self.config.estimate_timeout * 1e9:
            return 0
        self.log.warning(
            "no estimate in %s for %g s: waiting for one", self._frame, self.config.estimate_timeout
        )
        self.send_command(Hover)
        while (now := self.clock.now()) - self.pose.stamp > self.config.estimate_timeout * 1e9:
            if now - start > self.config.landing_timeout * 1e9:
                missed = f"no estimate in {self._frame} for {self.config.landing_timeout:g} s"
                self.log.error("%s: landing", missed)
                self.outcome = f"{missed}: landed"
                return None
            await self.clock.sleep(1 / self.config.rate)
        return self.clock.now() - start


def _turned(vector: Vector3, angle: float) -> Vector3:
    """Return a vector turned about the vertical by an angle, clockwise seen from above."""
    x, y, z = vector
    c, s = math.cos(angle), math.sin(angle)
    return (c * x - s * y, s * x + c * y, z)


def _wrap(angle: float) -> float:
    return math.remainder(angle, math.tau)
