"""Rows of sensors that are not part of the protocol, as the description of a run says them."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

from events import Event, SensorAnnouncement, Vector3
from events.sensors import SENSOR_KINDS, SensorKind
from nodes.outside.native import client, describe, rows


class SonarEcho(Event):
    """A measurement that only its own package knows."""

    frame_id: str = "base_link"
    strength: float
    direction: Vector3


KIND = SensorKind(
    name="sonar",
    event=SonarEcho,
    announcement=SensorAnnouncement,
    group="echoes",
    fields={"strength": "1", "direction": "m"},
)
ECHO = SonarEcho(stamp=5, source="drone/sonar", strength=0.5, direction=(1.0, 2.0, 3.0))


@pytest.fixture(autouse=True)
def sonar(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(rows, "sensor_kinds", lambda: (*SENSOR_KINDS.values(), KIND))
    for cached in (rows._kinds, rows._records):
        cached.cache_clear()
    yield
    for cached in (rows._kinds, rows._records):
        cached.cache_clear()


def test_rows_of_the_protocol_are_those_of_the_sensors_of_the_table() -> None:
    kinds = {rows.row_kind(kind) for kind in SENSOR_KINDS.values()}
    of_sensors = client.RECORDS.keys() - {"pose_estimate"}
    assert of_sensors <= kinds
    assert {kind for kind in kinds if not rows.described_row(kind)} == of_sensors


def test_a_row_has_the_fields_of_the_event_that_the_description_names() -> None:
    announced = SensorAnnouncement(stamp=0, source="drone/sonar", rate=10.0)
    inputs = [("sonar", rows.kind_of(ECHO), announced)]
    (entry,) = json.loads(json.dumps(describe([], inputs, {})["inputs"]))
    assert entry["kind"] == "sonar_echo"
    columns = [client._column(column) for column in entry["row"]]
    record = np.dtype([("stamp", "<i8"), *columns])
    assert record.itemsize == entry["row_bytes"] == 40
    (row,) = np.frombuffer(rows.rows_of(ECHO).tobytes(), record)
    assert (row["stamp"], row["strength"], [*row["direction"]]) == (5, 0.5, [1.0, 2.0, 3.0])


def test_an_event_of_no_sensor_has_no_rows() -> None:
    assert rows.kind_of(Event(stamp=0, source="x")) == ""
    assert rows.row_kind(SENSOR_KINDS["lidar"]) == "lidar_scan"
