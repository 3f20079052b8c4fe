"""Figures of what an estimator can mean at all: stamps, velocities, covariances, commands.

Errors of positions do not show these: poses stamped at their arrival, velocities of zero or
covariances filled in by hand come with positions that are right.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from events import Command, Disarm, Disarmed, Land, Landed, Reset, TakenOff, VehicleEvent
from nodes.judging.evaluation.record import SAME, Stamps, answered, nearest
from runtime.time.clock import SECOND

Floats = npt.NDArray[np.float64]


def at_images(
    frames: Stamps,
    poses: Stamps,
    offset: int = 0,
    ages: Stamps | None = None,
    latency: int = 0,
) -> float | None:
    """Return the share of the answered images with a pose at their stamp, percent.

    A stamp may be off by a millisecond or a tenth of the images' period (clocks are calibrated no
    better), and by the announced offset of the camera's clock. A pose that came before its image
    was delivered is none of it: stamps of arrivals may be those of later images by chance. Where
    poses are denser than images, as those of an inertial estimator, half of their period is enough,
    and they may come before.

    Args:
        frames: Stamps of the images (ns), strictly rising, shape (n,), n ≥ 1.
        poses: Those of the poses, shape (m,).
        offset: Of the camera's clock (ns).
        ages: From each pose's stamp to its arrival (ns), shape (m,), if known.
        latency: From an image's exposure to its delivery, as announced (ns). Half of it is enough,
            lest it be less than announced.

    Returns:
        `None` if no image is answered.
    """
    has_pose = answered(frames, poses)
    if not has_pose.any():
        return None
    period = int(np.median(np.diff(frames))) if len(frames) > 1 else 0
    between = int(np.median(np.diff(poses))) if len(poses) > 1 else 0
    dense = 3 * between <= 2 * period
    tolerance = max(SAME, period // 10, between // 2 + SAME if dense else 0) + abs(offset)
    rows, distance = nearest(frames, poses)
    near = distance <= tolerance
    if ages is not None and not dense:
        near &= 2 * ages >= latency
    stamped = np.zeros(len(frames), np.bool_)
    stamped[rows[near]] = True
    return 100.0 * float((stamped & has_pose).sum() / has_pose.sum())


_STANDING = 0.1  # m/s: below it, errors of velocities are not held against the speed


def velocity_error_percent(errors: Floats, velocities: Floats) -> float | None:
    """Return the root mean square of velocity errors in percent of that of the true speed.

    Args:
        errors: Lengths of the errors, m/s, shape (n,).
        velocities: True velocities, m/s, shape (n, 3).

    Returns:
        `None` if the vehicle stood, below 0.1 m/s.
    """
    speed = math.sqrt(float(np.mean(np.sum(velocities**2, axis=1))))
    if speed < _STANDING:
        return None
    return 100.0 * math.sqrt(float(np.mean(errors**2))) / speed


_ANYWHERE = 10.0  # metres that a position may always be uncertain by
_ANYHOW = math.sqrt(math.pi**2 / 3.0 + 2.0)
"""Root mean square of the angles of uniformly random rotations, rad (132°).

Their density is ``(1 - cos a) / π`` on [0, π] (R. E. Miles, "On random rotations in R³", 1965).
"""


def too_large_percent(covariances: Floats, path: float) -> float:
    """Return the share of the covariances that say less than what is known without, percent.

    A position known no better than by the length of the whole path (or 10 m, if that is more), or
    an orientation no better than one at random.

    Args:
        covariances: Of (x, y, z, roll, pitch, yaw), shape (n, 6, 6), n ≥ 1.
        path: Metres.
    """
    variances = np.einsum("nii->ni", covariances)
    position, orientation = variances[:, :3].sum(axis=1), variances[:, 3:].sum(axis=1)
    large = (position > max(path, _ANYWHERE) ** 2) | (orientation > _ANYHOW**2)
    return 100.0 * float(large.mean())


class CommandLog:
    """Commands to vehicles by sender, and the vehicles' take-offs and landings."""

    def __init__(self) -> None:
        self._commands: list[Command] = []
        self._events: list[VehicleEvent] = []

    def add(self, event: Command | VehicleEvent) -> None:
        """Record a command or an event of a vehicle."""
        if isinstance(event, Command):
            self._commands.append(event)
        elif isinstance(event, TakenOff | Landed | Disarmed):
            self._events.append(event)

    def text(self, sent_by: Callable[[str], bool]) -> str:
        """Return commands, such as ``land at 12.3 s``; empty if there are none.

        Args:
            sent_by: Whether a source is that of the commands wanted.
        """
        return ", ".join(_text(command) for command in self._commands if sent_by(command.source))

    def ended(self, sent_by: Callable[[str], bool], vehicle: str) -> str:
        """Return the command that ended a vehicle's flight, if it is one of those; else "".

        The vehicle was to land, disarm or return to its start, did so, and flew no more. Whoever
        alone has commanded the vehicle has flown it, and may end that.

        Args:
            sent_by: As of `text`.
        """
        events = [event for event in self._events if event.source == vehicle]
        flown = [k for k, event in enumerate(events) if isinstance(event, TakenOff)]
        commands = [command for command in self._commands if command.vehicle in {"", vehicle}]
        if not flown or len(events) == flown[-1] + 1 or all(sent_by(c.source) for c in commands):
            return ""
        taken_off, over = events[flown[-1]].stamp, events[flown[-1] + 1].stamp
        ending = (
            command
            for command in commands
            if isinstance(command, Land | Disarm | Reset) and taken_off <= command.stamp <= over
        )
        first = next(ending, None)
        return "" if first is None or not sent_by(first.source) else _text(first)


def _text(command: Command) -> str:
    name = "".join(f" {c.lower()}" if c.isupper() else c for c in type(command).__name__).strip()
    return f"{name} at {command.stamp / SECOND:.4g} s"
