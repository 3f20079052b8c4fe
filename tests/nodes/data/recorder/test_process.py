"""What is in a recording: ROS's messages, read by rosbags, and all events to the byte."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from events import Announcement, DepthImage, Event, Image
from nodes.data.mcap import native
from nodes.data.mcap.mcap_file import McapWriter
from nodes.data.recorder.process import EventWriter
from nodes.data.recorder.writer_process import McapRecorderConfig
from nodes.data.replay.bags import Recorded
from runtime.channels.wire import pack
from tests.nodes.data.recorder.samples import announcements, depth, image, odometry, said, same

SECOND = 1_000_000_000


def record(path: Path, events: list[Event], **settings: Any) -> list[str]:
    """Write events, each published 40 ms after its stamp; return complaints."""
    complaints: list[str] = []
    writer = McapWriter(path)
    topics = EventWriter(writer, McapRecorderConfig(**settings), complaints.append)
    for event in events:
        announced = isinstance(event, Announcement)
        time = 0 if announced else event.stamp + 40_000_000
        topics.write(time, pack(event).frame(), announced)
        if event.stamp % 3 == 0:
            writer.end_chunk()
    writer.close()
    return complaints


def replayed(path: Path) -> list[Event]:
    reader = Recorded(path)
    events = [record.event for record in reader.events(0, None, lambda _, __: True)]
    assert reader.trouble == []
    return [*reader.announcements(), *events]


def messages(path: Path) -> dict[str, list[Any]]:
    with AnyReader([path]) as reader:
        by_topic: dict[str, list[Any]] = {}
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            by_topic.setdefault(connection.topic, []).append(message)
        return by_topic


@pytest.mark.parametrize(
    "settings", [{}, {"image_format": "png"}, {"compression": "lz4"}], ids=["raw", "png", "lz4"]
)
def test_all_events_come_back_as_they_were(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Every kind of event, announcements included, in order and to the byte."""
    events = [*announcements(), *said(SECOND), *said(2 * SECOND)]
    path = tmp_path / "a.mcap"
    assert record(path, events, **settings) == []
    received = replayed(path)
    assert [type(e) for e in received] == [type(e) for e in events]
    assert all(same(*pair) for pair in zip(received, events, strict=True))


@pytest.mark.slow
def test_ros_reads_the_topics_that_the_bridge_has(tmp_path: Path) -> None:
    """All messages can be read; images, poses and transforms are in ROS's names and axes."""
    path = tmp_path / "a.mcap"
    record(path, [*announcements(), *said(SECOND)])
    by_topic = messages(path)
    assert {
        "/drone/front/image_raw", "/drone/front/camera_info", "/drone/front/depth/image_raw",
        "/drone/front/segmentation/image_raw", "/drone/front/pose", "/drone/imu", "/drone/odom",
        "/odometry/pose", "/drone/down/range", "/scores/odometry/ate", "/tf", "/tf_static",
        "/map/points",
    } <= {*by_topic}  # fmt: skip
    received = by_topic["/drone/front/image_raw"][0]
    assert received.data.tobytes() == image(SECOND).data.tobytes()
    assert (received.encoding, received.header.stamp.sec) == ("rgb8", 1)
    x, y, z = odometry(SECOND).position
    place = by_topic["/drone/odom"][0].pose.pose.position
    assert (place.x, place.y, place.z) == (y, x, -z)
    own = [name for name in by_topic if name.startswith("/visnav/")]
    assert len(own) == len(announcements()) + len(said(0))


def test_what_is_large_is_in_the_file_once(tmp_path: Path) -> None:
    """The event's own message has no pixels when a message of ROS's has them."""
    path = tmp_path / "a.mcap"
    record(path, [*announcements(), *said(SECOND)])
    with AnyReader([path]) as reader:
        own = {c.topic: data for c, _, data in reader.messages() if "/visnav" in c.topic}
    assert native.missing_arrays(own["/visnav/drone/front/Image"])
    assert native.missing_arrays(own["/visnav/map/PointCloud"])
    assert not native.missing_arrays(own["/visnav/odometry/TrackedFeatures"])


def test_times_are_those_of_publication(tmp_path: Path) -> None:
    """A range of a recording goes by them, not by stamps."""
    path = tmp_path / "a.mcap"
    record(path, [image(stamp) for stamp in range(0, 10 * SECOND, SECOND)])
    reader = Recorded(path)
    records = list(reader.events(3 * SECOND, 5 * SECOND, lambda _, __: True))
    assert [record.time for record in records] == [3 * SECOND + 40_000_000, 4 * SECOND + 40_000_000]
    assert [record.event.stamp for record in records] == [3 * SECOND, 4 * SECOND]


def test_jpeg_and_millimetres_lose_what_they_must(tmp_path: Path) -> None:
    """An image comes back about as it was, and depth to the millimetre; all else is the same."""
    path = tmp_path / "a.mcap"
    column = np.arange(0, 250, 2).astype(np.uint8)[:, None, None]
    smooth = np.broadcast_to(column, (125, 40, 3)).copy()
    sent = Image(stamp=1, source="drone/front", frame_id="f", data=smooth)
    record(path, [*announcements(), sent, depth(2)], image_format="jpeg", depth_format="png")
    *_, near, far = replayed(path)
    assert isinstance(near, Image)
    assert near.frame_id == "f"
    assert abs(near.data.astype(int) - smooth).max() <= 4
    assert isinstance(far, DepthImage)
    expected = depth(2).data.copy()
    there = (expected > 0.0) & (expected <= 65.535)
    assert np.isinf(far.data[~there]).all()
    assert abs(far.data[there] - expected[there]).max() <= 0.00051
    topics = messages(path)
    assert topics["/drone/front/image_raw/compressed"][0].format.startswith("rgb8; jpeg")
    assert topics["/drone/front/depth/image_raw/compressedDepth"][0].format.startswith("16UC1;")


def test_an_event_that_ros_cannot_have_is_recorded_nevertheless(tmp_path: Path) -> None:
    """Its stamp does not fit into 32 bits of seconds: that is said, and nothing is lost."""
    path = tmp_path / "a.mcap"
    late = image(3_000_000_000 * SECOND)
    complaints = record(path, [*announcements(), late])
    assert len(complaints) == 1
    assert "Image of drone/front has no message" in complaints[0]
    assert same(replayed(path)[-1], late)
