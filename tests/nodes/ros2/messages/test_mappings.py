"""The table of mappings: what else says what there is says the same."""

from __future__ import annotations

from events import Event, SensorAnnouncement, Vector3
from events.sensors import SensorKind
from nodes.ros2.bridge import Ros2Bridge
from nodes.ros2.bridge.settings import Subscription
from nodes.ros2.messages import outgoing
from nodes.ros2.messages.mappings import (
    LARGE,
    MAPPINGS,
    PUBLISHED,
    READERS,
    RECEIVED,
    SMALL,
    _plain,
    rows_of,
)
from nodes.ros2.messages.topics import ALL_GROUPS, PublishingConfig
from tests.nodes.ros2.messages import samples


def test_settings_and_their_description_name_what_the_table_has() -> None:
    assert {row.group for row in PUBLISHED} == {*ALL_GROUPS}
    uses = {row.use for row in READERS.values() if not row.bags}
    described = str(Subscription.__doc__).partition("use: ")[2].partition("mapping: ")[0]
    assert {use for use in uses if f"``{use}``" not in described} == set()
    assert "``position``, ``pose`` (PoseStamped), ``image``" in described
    assert {*Ros2Bridge.declared.outputs} >= {*RECEIVED} > {"images", "imu", "fixes"}


class SonarEcho(Event):
    """A measurement without a message of its own."""

    frame_id: str = "base_link"
    strength: float
    direction: Vector3


def test_a_sensor_without_a_message_of_its_own_has_a_topic_for_each_field() -> None:
    fields = {"strength": "1", "direction": "m"}
    kind = SensorKind(
        name="sonar", event=SonarEcho, announcement=SensorAnnouncement, group="e", fields=fields
    )
    rows = {row.topic: row for row in _plain(kind)}
    out = outgoing.Outgoing(samples.store(), PublishingConfig(), lambda ns: divmod(ns, 10**9))
    echo = SonarEcho(stamp=3, source="drone/sonar", strength=0.5, direction=(1.0, 2.0, 3.0))
    assert rows["{}/strength"].write(out, echo).data == 0.5
    vector = rows["{}/direction"].write(out, echo)
    assert (vector.vector.x, vector.vector.y, vector.vector.z) == (1.0, -2.0, -3.0)
    assert vector.header.stamp.nanosec == 3
    assert {type(rows[topic].write(out, echo)).__name__ for topic in rows} == {
        row.type.replace("/", "__") for row in rows.values()
    }


def test_every_row_is_published_or_read_and_has_a_type_that_there_is() -> None:
    for row in MAPPINGS:
        assert row.kind or row.use
        assert bool(row.kind) == bool(row.topic)
        samples.store().check(row.type)
        assert all(row in rows_of(event) for event in row.events)
    assert not {*LARGE} & {*SMALL}


def test_settings_choose_one_row_of_a_kind() -> None:
    for config in (PublishingConfig(), PublishingConfig(covariance=True, compressed_images="png")):
        kinds = [row.kind for row in PUBLISHED if row.wanted(config)]
        assert len(kinds) == len({*kinds})
