"""A scripted flight on an estimator's poses: the closed loop."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec

from events import Hover, PlannedPose, PoseEstimate, Quaternion, Vector3, VelocitySetpoint
from nodes.path import Path
from nodes.tour import Pilot, TourConfig
from runtime import Duration, Output, on
from runtime.parameters import Changeable

Positive = Annotated[float, msgspec.Meta(gt=0)]


class VisualPilotConfig(TourConfig):
    """Settings of a visual pilot, besides a tour's.

    Attributes:
        gain: Metres per second for each metre beside the path.
        yaw_gain: Radians per second for each radian off the heading.
        catch_up: Metres per second that the correction never exceeds.
        patience: How old the newest estimate may be; then the vehicle stops and waits.
        give_up: How long it waits; then it lands where it is, and the run ends.
    """

    gain: Changeable[Positive] = 1.0
    yaw_gain: Changeable[Positive] = 1.0
    catch_up: Changeable[Positive] = 0.5
    patience: Changeable[Duration] = Duration(0.5)  # immutable
    give_up: Changeable[Duration] = Duration(10.0)


class VisualPilot(Pilot[VisualPilotConfig]):
    """Flies a vehicle along waypoints, knowing of its pose only what an estimator says.

    It asks for velocities along the vehicle's own heading, so whatever is wrong with the estimate,
    heading included, shows in the flight. (Attitude and velocity are held by the vehicle itself.)

    The frame of the first estimate is the one it flies in, and that of its waypoints. Estimates in
    another frame are none to it: those of a restarted estimator begin where the vehicle is then, in
    ``odom_1``. It hovers, goes on when estimates in its frame come again, and else lands.
    """

    setpoints = Output(VelocitySetpoint)
    plans = Output(PlannedPose)

    def __init__(self) -> None:
        super().__init__()
        self._frame = ""
        self._refused = ""

    @on(PoseEstimate)
    def estimated(self, event: PoseEstimate) -> None:
        """Note where the vehicle seems to be, if that is in the frame of the flight."""
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
        self.see(event)

    async def follow(self, path: Path) -> None:
        """Ask for the path's velocity, and for more where the estimate is beside the path."""
        clock = self.clock
        step, last = round(path.step * 1e9), len(path.position) - 1
        begin = clock.now()
        for index in range(last + 1):
            await clock.sleep_until(begin + index * step)
            waited = await self._wait_for_sight()
            if waited is None:
                return
            begin += waited
            now = clock.now()
            x, y, z = path.position[index].tolist()
            yaw = float(path.yaw[index])
            self.plans.send(PlannedPose(stamp=now, source=self.name, position=(x, y, z), yaw=yaw))
            assert self.here is not None
            # Against the path at the time of the picture: its age then does not matter.
            seen = min(max(round((self.here.stamp - begin) / step), 0), last)
            to_go = path.position[seen] - self.here.position
            config = self.config  # which may change on the way
            correction = config.gain * to_go
            size = math.sqrt(float(correction @ correction))
            if size > config.catch_up:
                correction *= config.catch_up / size
            north, east, down = (path.velocity[index] + correction).tolist()
            yaw_error = _wrap(float(path.yaw[seen]) - heading(self.here.orientation))
            # What the vehicle's nose seems to point at now: the path's heading, less what is off.
            velocity = _turned((north, east, down), yaw_error - yaw)
            self.setpoints.send(
                VelocitySetpoint(
                    stamp=now,
                    source=self.name,
                    frame_id="heading",
                    velocity=velocity,
                    yaw_rate=float(path.yaw_rate[index]) + config.yaw_gain * yaw_error,
                )
            )

    async def _wait_for_sight(self) -> int | None:
        """Stop while the newest estimate is too old.

        Returns:
            How long that took (ns); `None` if it took so long that the flight is over.
        """
        start = self.clock.now()
        assert self.here is not None
        if start - self.here.stamp <= self.config.patience * 1e9:
            return 0
        self.log.warning(
            "no estimate in %s for %g s: waiting for one", self._frame, self.config.patience
        )
        self.orders.send(Hover(stamp=start, source=self.name))
        while (now := self.clock.now()) - self.here.stamp > self.config.patience * 1e9:
            if now - start > self.config.give_up * 1e9:
                missed = f"no estimate in {self._frame} for {self.config.give_up:g} s"
                self.log.error("%s: landing", missed)
                self.outcome = f"{missed}: landed"
                return None
            await self.clock.sleep(1 / self.config.rate)
        return self.clock.now() - start


def heading(orientation: Quaternion) -> float:
    """Return where the x axis points, radians clockwise from north seen from above."""
    w, x, y, z = orientation
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _turned(vector: Vector3, angle: float) -> Vector3:
    """Return a vector turned about the vertical by an angle, clockwise seen from above."""
    x, y, z = vector
    c, s = math.cos(angle), math.sin(angle)
    return (c * x - s * y, s * x + c * y, z)


def _wrap(angle: float) -> float:
    return math.remainder(angle, math.tau)
