"""Which images and which plan are shown."""

from __future__ import annotations

import msgspec

from events import PlannedPose, PositionSetpoint
from nodes.viewers.common import ImageSelection, PlanSelection


def test_of_thirty_images_a_second_five_are_kept_and_of_one_exposure_all() -> None:
    selection = ImageSelection(5.0)
    stamps = [i * 1_000_000_000 // 30 for i in range(60)]
    kept = {
        kind: [s for s in stamps if selection.select(kind, "drone/camera", "optical", s)]
        for kind in ("Image", "DepthImage")
    }
    assert len(kept["Image"]) == 10
    assert kept["Image"] == kept["DepthImage"]
    assert [s for s in stamps if selection.selected("optical", s)] == kept["Image"]
    assert not selection.selected("another", stamps[0])


def test_without_a_rate_there_are_no_images() -> None:
    assert not ImageSelection(0.0).select("Image", "a", "a", 0)


def test_set_points_are_the_plan_only_where_there_is_none() -> None:
    plan, point = (
        PlannedPose(stamp=0, source="tour", position=(0.0, 0.0, 0.0), yaw=0.0),
        PositionSetpoint(stamp=0, source="tour", position=(0.0, 0.0, 0.0), yaw=0.0),
    )
    selection = PlanSelection()
    assert [selection.select(event) for event in (point, plan, point, plan)] == [
        True,
        True,
        False,
        True,
    ]


def test_each_vehicle_has_a_plan_of_its_own() -> None:
    selection = PlanSelection()
    place = (0.0, 0.0, 0.0)
    plan = PlannedPose(stamp=0, source="p", vehicle="one", position=place, yaw=0.0)
    point = PositionSetpoint(stamp=0, source="p", vehicle="two", position=place)
    assert selection.select(plan)
    assert selection.select(point)
    assert not selection.select(msgspec.structs.replace(point, vehicle="one"))
