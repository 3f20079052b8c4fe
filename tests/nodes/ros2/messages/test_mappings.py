"""The table of mappings: what else says what there is says the same."""

from __future__ import annotations

from nodes.ros2.bridge.settings import Subscription
from nodes.ros2.messages.mappings import LARGE, MAPPINGS, PUBLISHED, READERS, SMALL, rows_of
from nodes.ros2.messages.topics import ALL_GROUPS, PublishingConfig
from tests.nodes.ros2.messages import samples


def test_settings_and_their_description_name_what_the_table_has() -> None:
    assert {row.group for row in PUBLISHED} == {*ALL_GROUPS}
    uses = {row.use for row in READERS.values() if not row.bags}
    described = str(Subscription.__doc__).partition("use: ")[2].partition("mapping: ")[0]
    assert {use for use in uses if f"``{use}``" not in described} == set()


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
