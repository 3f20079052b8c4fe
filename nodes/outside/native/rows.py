"""Rows of the measurements of sensors on the native interface.

The rows of the project's own sensors are part of the protocol (`client.RECORDS`). Those of other
packages' have a stamp and the measured fields (f64), as the description of the run says.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any, get_type_hints

import numpy as np
import numpy.typing as npt

from events import Event, LidarScan, NavSatFix
from events.sensors import SensorKind
from nodes.outside.native.client import RECORDS
from runtime.sensors import sensor_kinds


def row_kind(sensor: SensorKind) -> str:
    """Return the kind of a sensor's rows: ``nav_sat_fix`` of a `NavSatFix`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", sensor.event.__name__).lower()


def described_row(kind: str) -> dict[str, Any]:
    """Return what the description says of the rows of a kind; nothing of those in the protocol."""
    if kind in RECORDS:
        return {}
    record = _records()[kind]
    return {"row": [[n, *t] for n, *t in record.descr[1:]], "row_bytes": record.itemsize}


def rows_of(event: Event) -> npt.NDArray[Any]:
    """Return a measurement as rows: a scan's points, else a single row."""
    if isinstance(event, LidarScan):
        return _points(event)
    kind = _kinds()[type(event)]
    record = _records()[kind]
    if isinstance(event, NavSatFix):
        covariance = np.reshape(event.position_covariance or (np.nan,) * 9, (3, 3))
        place = event.latitude, event.longitude, event.altitude
        return np.array([(event.stamp, *place, event.velocity, covariance, event.status)], record)
    return np.array([tuple(getattr(event, name) for name in record.names or ())], record)


def kind_of(event: Event) -> str:
    """Return the kind of a measurement's rows; empty if it is of no sensor."""
    return _kinds().get(type(event), "")


def _points(scan: LidarScan) -> npt.NDArray[Any]:
    rows = np.empty(len(scan.times), RECORDS["lidar_scan"])
    rows["stamp"] = scan.stamp + np.round(scan.times.astype(np.float64) * 1e9).astype(np.int64)
    rows["point"], rows["intensity"], rows["ring"] = scan.points, scan.intensities, scan.rings
    return rows


@cache
def _kinds() -> dict[type[Event], str]:
    return {sensor.event: row_kind(sensor) for sensor in sensor_kinds()}


@cache
def _records() -> dict[str, np.dtype[Any]]:
    """Return the type of the rows of each kind of sensor."""
    return {row_kind(sensor): _record(sensor) for sensor in sensor_kinds()}


def _record(sensor: SensorKind) -> np.dtype[Any]:
    if (kind := row_kind(sensor)) in RECORDS:
        return RECORDS[kind]
    hints = get_type_hints(sensor.event)
    fields = [(n, "<f8") if hints[n] is float else (n, "<f8", (3,)) for n in sensor.fields]
    return np.dtype([("stamp", "<i8"), *fields])
