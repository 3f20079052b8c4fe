"""A vehicle seen as ArduPilot's Copter: its modes, altitudes above home, and guided places."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as mav

import events as ev
from extensions.mavlink.tests.outside import Outside, arm, command, of, results, target, texts

GUIDED, AUTO, RTL, ACRO = 4, 3, 6, 1


@pytest.fixture
async def copter() -> Any:
    made = Outside(autopilot="ardupilot")
    made.parser = ardupilotmega.MAVLink(None, 255, 0)
    yield made
    made.close()


def set_mode(number: int) -> Any:
    return mav.MAVLink_set_mode_message(1, 1, number)


def waypoint(seq: int, north: float, current: int = 0) -> Any:
    """Return an item of DroneKit's: in degrees, above home."""
    return mav.MAVLink_mission_item_message(
        1, 1, seq, 3, 16, current, 1, 0, 0, 0, 0, 47.0 + north / 111_180, 8.0, 3.0
    )


def mode_of(copter: Outside) -> int:
    return int(of("HEARTBEAT", copter.passes(1.1))[-1].custom_mode)


async def test_it_is_seen_as_a_copter_that_can_fly(copter: Outside) -> None:
    sent = copter.passes(1.1)
    assert of("HEARTBEAT", sent)[0].autopilot == mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    flags = of("EKF_STATUS_REPORT", sent)[0].flags
    assert flags & ardupilotmega.EKF_PRED_POS_HORIZ_ABS
    assert mode_of(copter) == GUIDED
    for number in (AUTO, ACRO):
        copter.say(set_mode(number))
        assert mode_of(copter) == GUIDED  # there is no mission, and no such mode
    assert results(copter.say(command(mav.MAV_CMD_DO_SET_MODE, 1, 2))) == [0]
    assert mode_of(copter) == 2


async def test_a_takeoff_is_above_home(copter: Outside) -> None:
    copter.say(arm(1))
    assert results(copter.say(command(mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0))) == [0]
    assert copter.acts[-1].altitude == pytest.approx(3.0, abs=1e-3)
    copter.say(set_mode(GUIDED))  # it is in that mode, and goes on
    assert isinstance(copter.acts[-1], ev.Takeoff)
    assert mode_of(copter) == GUIDED


async def test_guided_places_and_setpoints_are_flown_at_once(copter: Outside) -> None:
    (text,) = texts(copter.say(waypoint(0, 3.0, current=2)))
    assert text.endswith("expected a vehicle in the air")
    copter.flies()
    assert [ack.type for ack in copter.say(waypoint(0, 3.0, current=2))] == [0]
    copter.passes(3.0)
    assert copter.acts[-1].position == pytest.approx((3.0, 0.0, -3.1), abs=1.0)  # 32-bit degrees
    copter.say(target(0b111111000111, vx=1.0))
    copter.passes(2.5)
    assert copter.acts[-1].velocity == (1.0, 0.0, 0.0)
    assert "offboard: no set-point for 3 s: holding" in texts(copter.passes(1.0))
    copter.say(target(0b111111111000, x=4.0))
    assert texts(copter.passes(5.0)) == []
    assert copter.acts[-1].position == (4.0, 0.0, -2.0)


async def test_home_is_the_first_item_of_a_mission(copter: Outside) -> None:
    (count,) = copter.say(mav.MAVLink_mission_request_list_message(1, 1))
    assert count.count == 1
    (home,) = copter.say(mav.MAVLink_mission_request_message(1, 1, 0))
    assert (home.x, home.z) == (pytest.approx(47.000009), pytest.approx(400.1))
    nowhere = mav.MAVLink_mission_item_message(1, 1, 0, 0, 16, 0, 1, 0, 0, 0, 0, 0, 0, math.nan)
    copter.say(mav.MAVLink_mission_count_message(1, 1, 2), nowhere, waypoint(1, 0.0))
    copter.flies()
    copter.say(set_mode(AUTO))
    reached = []
    for _ in range(30):
        reached += [message.seq for message in of("MISSION_ITEM_REACHED", copter.passes(0.1))]
        if isinstance(copter.acts[-1], ev.PositionSetpoint):
            copter.at(copter.acts[-1].position)
    assert reached == [1]
    copter.say(set_mode(RTL))
    assert mode_of(copter) == RTL
