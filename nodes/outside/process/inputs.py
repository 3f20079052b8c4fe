"""Measurements and other nodes' estimates for a program, from their arrival to the next frame."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    BarometerAnnouncement,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    PoseEstimate,
    Range,
    RangeAnnouncement,
    TrackingEvent,
    TrackingLost,
)
from events.geometry import pose_matrix
from nodes.outside.native.client import RECORDS
from runtime.errors import suggest

MOST_BYTES = 64 << 20  # most bytes waiting for the next frame; beyond, the oldest are dropped


class Sensor(NamedTuple):
    """A kind of sensor: its announcement, and the kind and fields of its rows."""

    announced: type[Announcement]
    kind: str
    event: type[Event]
    fields: Callable[[Any], tuple[Any, ...]]


def _fix(event: NavSatFix) -> tuple[Any, ...]:
    covariance = np.reshape(event.position_covariance or (np.nan,) * 9, (3, 3))
    place = event.latitude, event.longitude, event.altitude
    return (*place, event.velocity, covariance, event.status)


SENSORS = {
    "imu": Sensor(
        ImuAnnouncement, "imu", Imu, lambda e: (e.angular_velocity, e.linear_acceleration)
    ),
    "barometer": Sensor(
        BarometerAnnouncement,
        "fluid_pressure",
        FluidPressure,
        lambda e: (e.fluid_pressure, e.variance),
    ),
    "magnetometer": Sensor(
        MagnetometerAnnouncement, "magnetic_field", MagneticField, lambda e: (e.magnetic_field,)
    ),
    "gnss": Sensor(NavSatAnnouncement, "nav_sat_fix", NavSatFix, _fix),
    "range": Sensor(
        RangeAnnouncement, "range", Range, lambda e: (e.range, e.min_range, e.max_range)
    ),
    "lidar": Sensor(LidarAnnouncement, "lidar_scan", LidarScan, tuple),  # see `_points`
}  # kinds of sensor by their names in the setting ``reads``

_BY_EVENT = {sensor.event: sensor for sensor in SENSORS.values()}


def _points(scan: LidarScan) -> npt.NDArray[Any]:
    rows = np.empty(len(scan.times), RECORDS["lidar_scan"])
    rows["stamp"] = scan.stamp + np.round(scan.times.astype(np.float64) * 1e9).astype(np.int64)
    rows["point"], rows["intensity"], rows["ring"] = scan.points, scan.intensities, scan.rings
    return rows


class Message(NamedTuple):
    """Rows of an input: index of the input, when the last row came (ns), and the rows."""

    number: int
    arrived: int
    rows: npt.NDArray[Any]


class Inputs:
    """Inputs of a program: their choice, and what has come of them since the last frame.

    Args:
        names: Of each: a kind of sensor, the last part of a sensor's source, or an estimator.
    """

    def __init__(self, names: Sequence[str]) -> None:
        # Name, kind of the rows, and announcement of each; empty before `choose`.
        self.chosen: list[tuple[str, str, Announcement]] = []
        self.dropped = 0  # number of messages dropped for want of room
        self._names = names
        self._announced: list[Announcement] = []
        self._numbers: dict[str, int] = {}  # by source
        self._waiting: deque[Message] = deque()
        self._bytes = 0
        self._frames: dict[str, list[str]] = {}  # of each estimator, in the order of their use

    def announced(self, announcement: Announcement) -> None:
        """Note a sensor or an estimator."""
        kinds = [sensor.announced for sensor in SENSORS.values()]
        if isinstance(announcement, (EstimatorAnnouncement, *kinds)):
            self._announced.append(announcement)

    def choose(
        self,
        body: str,  # source of the body whose sensors are meant; empty for the first found
        imu: ImuAnnouncement | None,  # comes first if the names mean no IMU
    ) -> Iterable[str]:
        """Choose among what was announced, and yield an error for each that is missing."""
        self.chosen = []
        for name in self._names:
            found = self._find(name, body)
            if found is None:
                sources = [each.source for each in self._announced]
                known = f"found {', '.join(sources) or 'none'}{suggest(name, sources)}"
                yield f"reads: expected a sensor or an estimator called {name}, {known}"
            elif (other := next((n for n, _, each in self.chosen if each is found), "")) != "":
                yield f"reads: expected each once, found {found.source} as {other} and as {name}"
            else:
                self.chosen.append((name, _kind(found), found))
                body = body or found.source.rpartition("/")[0]
        if imu is not None and all(kind != "imu" for _, kind, _ in self.chosen):
            self.chosen.insert(0, ("imu", "imu", imu))
        self._numbers = {each.source: number for number, (*_, each) in enumerate(self.chosen)}

    def _find(self, name: str, body: str) -> Announcement | None:
        sensor = SENSORS.get(name)
        for each in self._announced:
            estimator = isinstance(each, EstimatorAnnouncement)
            if sensor is not None and isinstance(each, sensor.announced):
                if body in ("", each.source.rpartition("/")[0]):
                    return each
            elif each.source == name or (not estimator and each.source.endswith(f"/{name}")):
                return each
        return None

    def take(self, event: Event, now: int) -> str:
        """Keep an event until the next frame; return the name of its input, if that is news."""
        number = self._numbers.get(event.source)
        rows = None if number is None else self._rows(event, self.chosen[number][1])
        if number is None or rows is None:
            return ""
        self._waiting.append(Message(number, now, rows))
        self._bytes += rows.nbytes
        while self._bytes > MOST_BYTES and len(self._waiting) > 1:
            self._bytes -= self._waiting.popleft().rows.nbytes
            self.dropped += 1
        return "" if isinstance(event, TrackingEvent) else self.chosen[number][0]

    def drain(self) -> list[Message]:
        """Return what has come since, in the order of arrival; rows of an input in one message."""
        found = []
        for number, together in itertools.groupby(self._waiting, lambda each: each.number):
            messages = [*together]
            scans = self.chosen[number][1] == "lidar_scan"
            for some in [[each] for each in messages] if scans else [messages]:
                rows = np.concatenate([each.rows for each in some])
                found.append(Message(number, some[-1].arrived, rows))
        self._waiting.clear()
        self._bytes = 0
        return found

    def _rows(self, event: Event, kind: str) -> npt.NDArray[Any] | None:
        """Return an event as rows of a kind; `None` if it is another's."""
        if isinstance(event, LidarScan):
            return _points(event)
        if isinstance(event, PoseEstimate | TrackingLost):
            return self._estimate(event)
        sensor = _BY_EVENT.get(type(event))
        if sensor is None or sensor.kind != kind:
            return None
        return np.array([(event.stamp, *sensor.fields(event))], RECORDS[kind])

    def _estimate(self, event: PoseEstimate | TrackingLost) -> npt.NDArray[Any]:
        frames = self._frames.setdefault(event.source, [])
        pose, velocity, covariance = np.full((3, 4), np.nan), (np.nan,) * 3, np.full((6, 6), np.nan)
        if isinstance(event, PoseEstimate):
            if event.frame_id not in frames:
                frames.append(event.frame_id)
            pose = pose_matrix(event.position, event.orientation)[:3]
            velocity = event.velocity or velocity
            if event.covariance:
                covariance = np.reshape(event.covariance, (6, 6))
            frame = frames.index(event.frame_id)
        else:
            frame = max(len(frames) - 1, 0)
        row = event.stamp, frame, pose, velocity, covariance
        return np.array([row], RECORDS["pose_estimate"])


def _kind(announced: Announcement) -> str:
    found = (sensor.kind for sensor in SENSORS.values() if isinstance(announced, sensor.announced))
    return next(found, "pose_estimate")
