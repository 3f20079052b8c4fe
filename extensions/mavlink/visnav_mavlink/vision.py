"""Poses from programs outside, as estimates: which are taken, their stamps, frames, velocities.

A pose counts as measured `delay` before its stamp, whatever that was corrected by, as in PX4's EKF2
(``EKF2_EV_DELAY``; src/modules/ekf2/EKF/estimator_interface.cpp, ``setExtVisionData``). Differences
are as ArduPilot's dialect has them (mavlink.io, ``VISION_POSITION_DELTA``): a turn from the last
body frame to this one, and a way in the axes of this one.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from events import Quaternion, Vector3
from events.frames import from_rpy, multiply, normalize, rotate
from visnav_mavlink.clocks import MOST_CLOCKS, Clocks
from visnav_mavlink.links import Sender, mav
from visnav_mavlink.vehicle import SECOND

PATIENCE = SECOND // 50  # of a pose for the speed of its stamp
SPEEDS_END = SECOND  # without a speed after which poses do not wait for one
MOVED = 1.0  # metres, in which a velocity of exactly zero is none
_LOCAL = {mav.MAV_FRAME_LOCAL_NED: "LOCAL_NED", mav.MAV_FRAME_LOCAL_FRD: "LOCAL_FRD"}
_BODY = {mav.MAV_FRAME_BODY_FRD, mav.MAV_FRAME_BODY_NED}  # the latter is its older name
_COVARIANCE = np.triu_indices(6)
_LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)
_HERE: Vector3 = (0.0, 0.0, 0.0)


class RefusedPoseError(ValueError):
    """A pose is refused; its sender gets the reason unless the message is empty.

    Attributes:
        reason: In a word or two, by which such poses are counted.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Speed(NamedTuple):
    """A ``VISION_SPEED_ESTIMATE``: the sender's stamp (µs), and m/s in the frame of its poses.

    Attributes:
        is_late: Whether the pose of its stamp was published before it came.
    """

    stamp: int
    velocity: Vector3
    is_late: bool


class WaitingPose(NamedTuple):
    """A pose that waits for the speed of its stamp (µs, the sender's), since it came (ns)."""

    stamp: int
    since: int
    fields: dict[str, Any]


@dataclass
class Source:
    """An estimator outside.

    Attributes:
        has_poses: Whether it sends poses, so that differences are not integrated besides.
        last: The sender's stamp (µs) of the last pose or difference; `None` before.
        stamped: The same of the last pose that got a stamp of our clock (ns): `newest`.
        restarts: How often its differences started again.
        position: Sum of its differences; `orientation` as well.
        speed: Newest speed that no pose has.
        speed_arrived_at: Arrival of the newest speed (ns).
        still_at: Where its velocity was zero first, if it always was.
        moves: Whether a velocity other than zero came.
    """

    has_poses: bool = False
    last: int | None = None
    stamped: int = -1
    newest: int | None = None
    restarts: int = 0
    position: Vector3 = _HERE
    orientation: Quaternion = _LEVEL
    speed: Speed | None = None
    speed_arrived_at: int | None = None
    waiting: WaitingPose | None = None
    still_at: Vector3 | None = None
    moves: bool = False


class Vision:
    """All poses from outside.

    Args:
        publish_pose: Publishes a pose: its stamp and fields.
        refuse: Reports why messages of a kind and a sender have no effect.
        report_once: Sends a sentence, the first time, to all programs and to the log.
    """

    def __init__(
        self,
        clocks: Clocks,
        publish_pose: Callable[..., None],
        refuse: Callable[[str, Sender, str], None],
        report_once: Callable[[str], None],
    ) -> None:
        self._clocks = clocks
        self._publish_pose, self._refuse, self._report_once = publish_pose, refuse, report_once
        self._sources: dict[Sender, Source] = {}
        self.refused: Counter[str] = Counter()
        self._accepted = self._restamped = self._with_velocity = self._unmatched_speeds = 0

    def handle(self, sender: Sender, message: Any, now: int) -> None:
        """Publish a message's pose, or report why it is refused."""
        kind, source = message.get_type(), self._source_of(sender)
        try:
            if kind == "VISION_SPEED_ESTIMATE":
                self._handle_speed(sender, source, message, now)
            elif kind == "VISION_POSITION_DELTA":
                self._handle_delta(sender, source, message, now)
            else:
                self._handle_pose(sender, source, message, now)
        except RefusedPoseError as refusal:
            self.refused[refusal.reason] += 1
            if reason := str(refusal):
                self._refuse(kind, sender, reason)

    def update(self, now: int) -> None:
        """Publish poses whose speeds do not come."""
        for source in self._sources.values():
            if source.waiting is not None and now - source.waiting.since >= PATIENCE:
                self._release(source)

    def summary(self) -> str:
        """Return in a sentence how many poses were accepted and refused, and why."""
        for source in self._sources.values():
            self._release(source)
        notes = [f"{self._restamped} restamped"] if self._restamped else []
        if self._accepted and (delay := self._clocks.delay):
            notes.append(f"each {delay / 1e6:g} ms earlier by delay")
        notes += [f"{self._with_velocity} with a velocity"] if self._with_velocity else []
        text = f"{self._accepted} {'pose' if self._accepted == 1 else 'poses'} taken"
        text += f" ({', '.join(notes)})" if notes else ""
        if refused := self.refused.total():
            reasons = ", ".join(f"{n} {reason}" for reason, n in self.refused.most_common())
            text += f", {refused} refused: {reasons}"
        return text + (
            f"; {self._unmatched_speeds} speeds without a pose" if self._unmatched_speeds else ""
        )

    def _handle_pose(self, sender: Sender, source: Source, message: Any, now: int) -> None:
        kind = message.get_type()
        if kind == "ODOMETRY":
            if message.frame_id not in _LOCAL:
                reason = f"expected frame_id LOCAL_NED or LOCAL_FRD, found {message.frame_id}"
                raise RefusedPoseError("frame_id", reason)
            if getattr(message, "quality", 0) < 0:
                raise RefusedPoseError("quality", "its quality says failed; others are judged")
        if kind in {"ODOMETRY", "ATT_POS_MOCAP"}:
            size = math.hypot(*message.q)
            orientation = tuple(part / size for part in message.q) if 0.5 < size < 2.0 else ()
        else:
            angles = message.roll, message.pitch, message.yaw
            orientation = from_rpy(*angles) if all(map(math.isfinite, angles)) else ()
        position = message.x, message.y, message.z
        if not orientation or not all(map(math.isfinite, position)):
            raise RefusedPoseError("not a number", "its numbers are none; others are judged")
        stamp = message.time_usec if hasattr(message, "time_usec") else message.usec
        counter = getattr(message, "reset_counter", 0)
        source.has_poses = True
        fields = {
            "stamp": self._stamp(sender, source, stamp, now),
            "frame_id": f"odom_{counter}" if counter else "odom",
            "position": position,
            "orientation": orientation,
            "covariance": _covariance(
                message.pose_covariance if kind == "ODOMETRY" else message.covariance
            ),
        }
        velocity = None
        if kind == "ODOMETRY":
            velocity = self._velocity(sender, source, message, position, orientation)
        self._join(source, stamp, fields, velocity, now)

    def _velocity(
        self,
        sender: Sender,
        source: Source,
        message: Any,
        position: Vector3,
        orientation: Any,
    ) -> Vector3 | None:
        """Return an ``ODOMETRY``'s velocity in the frame of its pose, m/s; `None` if unknown."""
        velocity = message.vx, message.vy, message.vz
        frame = message.child_frame_id
        if not all(map(math.isfinite, velocity)):
            return None
        if frame not in _BODY | {message.frame_id}:
            expected = f"expected child_frame_id BODY_FRD or {_LOCAL[message.frame_id]}"
            self._refuse("velocity in ODOMETRY", sender, f"{expected}, found {frame}")
            return None
        if any(velocity):
            source.moves = True
        elif not source.moves:
            source.still_at = source.still_at or position
            if math.dist(source.still_at, position) > MOVED:
                reason = "is zero while it moves, and so judged: send NaN if it is unknown"
                self._report_once("velocity in ODOMETRY of {}/{} {}".format(*sender, reason))
                source.moves = True
        return rotate(orientation, velocity) if frame in _BODY else velocity

    def _handle_speed(self, sender: Sender, source: Source, message: Any, now: int) -> None:
        """Join a speed to the pose that waits for it, or else store it for the next one."""
        kind, velocity = message.get_type(), (message.x, message.y, message.z)
        if not all(map(math.isfinite, velocity)):
            self._refuse(kind, sender, "its numbers are none; others are judged")
            return
        source.speed_arrived_at = now
        waiting, before = source.waiting, source.speed
        if waiting is not None and waiting.stamp == message.usec:
            self._release(source, velocity)
            return
        source.speed = Speed(message.usec, velocity, message.usec == source.last)
        if before is not None and not before.is_late:
            self._unmatched_speeds += 1
            reason = "expected a pose of the same usec beside it, such as VISION_POSITION_ESTIMATE"
            self._refuse(kind, sender, f"{reason}; ODOMETRY has both in one")

    def _handle_delta(self, sender: Sender, source: Source, message: Any, now: int) -> None:
        """Add a difference to those before; the first after a gap is a new frame's origin."""
        turn, shift = message.angle_delta, message.position_delta
        if source.has_poses:
            raise RefusedPoseError(
                "differences beside poses", "poses of its sender are judged instead"
            )
        if not all(map(math.isfinite, (*turn, *shift))):
            raise RefusedPoseError("not a number", "its numbers are none; others are judged")
        stamp, period = message.time_usec, message.time_delta_usec
        before, source.last = source.last, stamp
        if before is None or not 2 * abs(stamp - period - before) <= max(period, 2000):
            if before is not None and source.position != _HERE:
                source.restarts += 1
                reason = "a difference before it is missing: those after it are in another frame"
                self._refuse(message.get_type(), sender, reason)
            source.position, source.orientation = _HERE, _LEVEL
            return
        source.orientation = normalize(multiply(source.orientation, _turned(turn)))
        x, y, z = rotate(source.orientation, (shift[0], shift[1], shift[2]))
        source.position = source.position[0] + x, source.position[1] + y, source.position[2] + z
        fields = {
            "stamp": self._stamp(sender, source, stamp, now),
            "frame_id": f"odom_{source.restarts}" if source.restarts else "odom",
            "position": source.position,
            "orientation": source.orientation,
            "covariance": (),
        }
        self._join(source, stamp, fields, None, now)

    def _stamp(self, sender: Sender, source: Source, stamp: int, now: int) -> int:
        """Return when a pose of a sender's stamp (µs) was measured, in our clock (ns).

        Poses that a better measure of the clock puts before the last one are not taken, since that
        one's stamp was wrong.
        """
        corrected = self._clocks.stamp(sender, 1000 * stamp, now)
        is_later, source.stamped = stamp > source.stamped, stamp
        if is_later and source.newest is not None and corrected <= source.newest:
            raise RefusedPoseError("restamped to before the last", "")
        source.newest = corrected
        self._restamped += corrected != 1000 * stamp
        return corrected - self._clocks.delay

    def _join(
        self,
        source: Source,
        stamp: int,
        fields: dict[str, Any],
        velocity: Vector3 | None,
        now: int,
    ) -> None:
        """Publish a pose with the speed of its stamp, or store it until that arrives."""
        self._release(source)
        source.last = stamp
        if velocity is None and source.speed is not None and source.speed.stamp == stamp:
            velocity, source.speed = source.speed.velocity, None
        source.waiting = WaitingPose(stamp, now, fields)
        has_speeds = (
            source.speed_arrived_at is not None and now - source.speed_arrived_at < SPEEDS_END
        )
        if velocity is not None or not has_speeds:
            self._release(source, velocity)

    def _release(self, source: Source, velocity: Vector3 | None = None) -> None:
        """Publish the stored pose."""
        waiting, source.waiting = source.waiting, None
        if waiting is not None:
            self._accepted += 1
            self._with_velocity += velocity is not None
            self._publish_pose(**waiting.fields, velocity=velocity)

    def _source_of(self, sender: Sender) -> Source:
        if sender not in self._sources and len(self._sources) >= MOST_CLOCKS:
            self._sources.clear()
        return self._sources.setdefault(sender, Source())


def _covariance(upper: Any) -> tuple[float, ...]:
    """Return a covariance row by row from its upper triangle; empty if unknown."""
    if not (np.isfinite(upper).all() and np.any(upper)):
        return ()
    matrix = np.zeros((6, 6))
    matrix[_COVARIANCE] = upper
    return tuple((matrix + np.triu(matrix, 1).T).ravel().tolist())


def _turned(vector: Any) -> Quaternion:
    """Return the rotation about a vector by its length, radians."""
    angle = math.hypot(*vector)
    x, y, z = (math.sin(angle / 2) / angle * part if angle else 0.0 for part in vector)
    return math.cos(angle / 2), x, y, z
