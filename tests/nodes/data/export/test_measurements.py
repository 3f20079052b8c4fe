"""What small sensors measured, as CSV files of a recorded run."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from events import Event, FluidPressure, NavSatFix, Range
from nodes.data.export import export_measurements
from nodes.data.mcap.mcap_file import McapWriter
from nodes.data.recorder.process import EventWriter
from nodes.data.recorder.writer_process import McapRecorderConfig
from runtime.channels.wire import pack


def record(path: Path, events: list[Event]) -> None:
    writer = McapWriter(path)
    topics = EventWriter(writer, McapRecorderConfig(), lambda _: None)
    for event in events:
        topics.write(event.stamp, pack(event).frame(), False)
    writer.close()


def test_each_sensor_has_a_file_of_its_measurements(tmp_path: Path) -> None:
    events: list[Event] = []
    for k in range(3):
        stamp = k * 20_000_000
        pressure = 1e5 + k / 3
        events += [
            FluidPressure(stamp=stamp, source="drone/barometer", fluid_pressure=pressure),
            Range(
                stamp=stamp,
                source="drone/down",
                range=math.inf if k else 1.5,
                min_range=0.1,
                max_range=9.0,
            ),
        ]
    events.append(
        NavSatFix(
            stamp=7,
            source="drone/gnss",
            latitude=47.6,
            longitude=-122.1,
            altitude=122.5,
            velocity=(1.0, 2.0, -0.5),
        )
    )
    record(tmp_path / "recording.mcap", events)
    written = export_measurements(tmp_path, epoch=1000)
    assert [path.name for path in written] == [
        "drone+barometer.FluidPressure.csv",
        "drone+down.Range.csv",
        "drone+gnss.NavSatFix.csv",
    ]
    rows = written[0].read_text().splitlines()
    assert rows[0] == "stamp (ns),fluid_pressure (Pa)"
    assert [float(row.split(",")[1]) for row in rows[1:]] == [1e5, 1e5 + 1 / 3, 1e5 + 2 / 3]
    assert [int(row.split(",")[0]) for row in rows[1:]] == [1000, 20_001_000, 40_001_000]
    assert written[1].read_text().splitlines()[1:] == ["1000,1.5", "20001000,inf", "40001000,inf"]
    assert written[2].read_text().splitlines() == [
        "stamp (ns),latitude (°),longitude (°),altitude (m),"
        "velocity_x (m/s),velocity_y (m/s),velocity_z (m/s)",
        "1007,47.6,-122.1,122.5,1.0,2.0,-0.5",
    ]


def test_without_a_recording_it_is_said_what_leaves_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected a recording .*McapRecorder is in it"):
        export_measurements(tmp_path)


def test_a_recording_without_measurements_gives_no_files(tmp_path: Path) -> None:
    record(tmp_path / "recording.mcap", [])
    with pytest.raises(ValueError, match="expected measurements of small sensors, found none"):
        export_measurements(tmp_path)
    assert not list((tmp_path / "export" / "csv").iterdir())
