"""Missions: up and down by either kind of item, gone through by one state, and whose they are."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav

import events as ev
from extensions.mavlink.tests.outside import (
    Outside,
    Program,
    command,
    item,
    mode,
    of,
    results,
    texts,
)

WAYPOINT, FENCE, ALL = mav.MAV_CMD_NAV_WAYPOINT, 1, 255


def place(seq: int, x: float, y: float = 2.0, z: float = -2.0, stay: float = 0) -> Any:
    """Return a waypoint in the local frame, whose integers are 1e-4 m."""
    return mav.MAVLink_mission_item_int_message(
        1, 1, seq, 1, WAYPOINT, 0, 1, stay, 0, 0, math.nan, round(x * 1e4), round(y * 1e4), z, 0
    )


def upload(outside: Program, *items: Any) -> list[Any]:
    return outside.say(mav.MAVLink_mission_count_message(1, 1, len(items), 0), *items)


def acks(answers: list[Any]) -> list[tuple[int, int]]:
    return [(message.type, message.mission_type) for message in of("MISSION_ACK", answers)]


def count(outside: Program, which: int = 0) -> int:
    (answer,) = outside.say(mav.MAVLink_mission_request_list_message(1, 1, which))
    assert answer.mission_type == which
    return int(answer.count)


def start(first: float = -1, last: float = 0) -> Any:
    return command(mav.MAV_CMD_MISSION_START, first, last)


def fly(outside: Outside, seconds: float, follows: bool = True) -> tuple[list[int], list[str]]:
    """Let a vehicle follow its set-points; return what is reached, and what is told."""
    reached, sentences = [], []
    for _ in range(round(10 * seconds)):
        messages = outside.passes(0.1)
        reached += [message.seq for message in of("MISSION_ITEM_REACHED", messages)]
        sentences += texts(messages)
        if follows and outside.acts and isinstance(outside.acts[-1], ev.PositionSetpoint):
            outside.at(outside.acts[-1].position)
    return reached, sentences


def land_here(seq: int) -> Any:
    return mav.MAVLink_mission_item_int_message(
        1, 1, seq, 6, mav.MAV_CMD_NAV_LAND, 0, 1, 0, 0, 0, math.nan, 0, 0, 0.0, 0
    )


def touch_down(outside: Outside) -> tuple[list[int], list[str]]:
    """Let the vehicle land; return what is reached then, and what is told."""
    outside.hear()
    outside.endpoint.flight.handle_event(ev.Landed(stamp=outside.now, source="drone"))
    messages = outside.hear()
    return [message.seq for message in of("MISSION_ITEM_REACHED", messages)], texts(messages)


async def test_a_mission_goes_up_comes_down_and_is_flown(outside: Outside) -> None:
    asked = outside.say(mav.MAVLink_mission_count_message(1, 1, 3, 0))
    assert [message.get_type() for message in asked] == ["MISSION_REQUEST"]
    assert len(of("MISSION_REQUEST", outside.passes(1.1))) == 1
    outside.say(item(0, mav.MAV_CMD_NAV_WAYPOINT), item(1, mav.MAV_CMD_NAV_WAYPOINT, z=3.0))
    answers = outside.say(item(2, mav.MAV_CMD_NAV_LAND))
    assert [message.type for message in of("MISSION_ACK", answers)] == [0]
    (count,) = outside.say(mav.MAVLink_mission_request_list_message(1, 1, 0))
    assert count.count == 3
    (second,) = outside.say(mav.MAVLink_mission_request_int_message(1, 1, 1, 0))
    assert (second.x, second.z) == (470000000, 3.0)
    outside.flies()
    assert results(outside.say(command(mav.MAV_CMD_MISSION_START, 0, 0))) == [0]
    reached = []
    for _ in range(60):
        reached += [message.seq for message in of("MISSION_ITEM_REACHED", outside.passes(0.1))]
        if isinstance(outside.acts[-1], ev.PositionSetpoint):
            outside.at(outside.acts[-1].position)
    assert reached == [0, 1]
    assert isinstance(outside.acts[-1], ev.Land)
    assert touch_down(outside) == ([2], ["mission finished"])


async def test_what_cannot_be_flown_is_refused_at_its_upload(outside: Outside) -> None:
    def results_of(answers: list[Any]) -> list[int]:
        return [message.type for message in of("MISSION_ACK", answers)]

    outside.say(mav.MAVLink_mission_count_message(1, 1, 1, 0))
    spline = outside.say(item(0, mav.MAV_CMD_NAV_SPLINE_WAYPOINT))
    assert results_of(spline) == [mav.MAV_MISSION_UNSUPPORTED]
    fence = outside.say(mav.MAVLink_mission_count_message(1, 1, 4, mav.MAV_MISSION_TYPE_FENCE))
    assert results_of(fence) == [mav.MAV_MISSION_UNSUPPORTED]
    outside.say(mav.MAVLink_mission_count_message(1, 1, 2, 0))
    assert results_of(outside.passes(8.0)) == [mav.MAV_MISSION_OPERATION_CANCELLED]


async def test_local_places_are_tenths_of_millimetres_or_metres(outside: Outside) -> None:
    """As integers and as numbers; either comes back as it is asked for."""
    upload(outside, place(0, 0.5))
    plain = mav.MAVLink_mission_request_message(1, 1, 0, 0)
    by_int = mav.MAVLink_mission_request_int_message(1, 1, 0, 0)
    (number,) = outside.say(plain)
    assert number.get_type() == "MISSION_ITEM"
    assert (number.x, number.y) == pytest.approx((0.5, 2.0))
    fraction = mav.MAVLink_mission_item_message(
        1, 1, 0, 1, WAYPOINT, 0, 1, 0, 0, 0, math.nan, 1.25, 2.75, -2.0, 0
    )
    assert acks(upload(outside, fraction)) == [(0, 0)]
    (integer,) = outside.say(by_int)
    assert (integer.x, integer.y) == (12_500, 27_500)
    degrees = mav.MAVLink_mission_item_message(
        1, 1, 0, 3, WAYPOINT, 0, 1, 0, 0, 0, math.nan, 47.0, 8.0, 2.0, 0
    )
    assert acks(upload(outside, degrees)) == [(0, 0)]
    assert outside.say(by_int)[0].x == 470000000
    assert outside.say(plain)[0].x == pytest.approx(47.0)
    outside.flies()
    upload(outside, place(0, 0.5))
    outside.say(start())
    fly(outside, 1.0)
    assert outside.acts[-2].position == pytest.approx((0.5, 2.0, -2.0))


async def test_items_are_asked_for_by_integers_if_a_program_wants_it_so(outside: Outside) -> None:
    """It says so by refusing the plain request, as MAVSDK does."""
    (asked,) = outside.say(mav.MAVLink_mission_count_message(1, 1, 2, 0))
    assert asked.get_type() == "MISSION_REQUEST"
    no = mav.MAVLink_mission_ack_message(1, 1, mav.MAV_MISSION_UNSUPPORTED, 0)
    (asked,) = outside.say(no)
    assert (asked.get_type(), asked.seq) == ("MISSION_REQUEST_INT", 0)
    assert outside.say(no) == []
    (asked,) = outside.say(place(0, 1.0))
    assert (asked.get_type(), asked.seq) == ("MISSION_REQUEST_INT", 1)
    outside.say(mav.MAVLink_mission_ack_message(1, 1, mav.MAV_MISSION_OPERATION_CANCELLED, 0))
    assert of("MISSION_REQUEST_INT", outside.passes(2.0)) == []


@pytest.mark.parametrize("which", [1, 2])
async def test_the_mission_is_left_by_what_is_about_fences(outside: Outside, which: int) -> None:
    upload(outside, place(0, 1.0), place(1, 2.0))
    assert count(outside, which) == 0
    clear = mav.MAVLink_mission_clear_all_message
    assert acks(outside.say(clear(1, 1, which))) == [(0, which)]
    assert acks(outside.say(clear(1, 1, 7))) == [(mav.MAV_MISSION_UNSUPPORTED, 7)]
    for refused in (
        mav.MAVLink_mission_request_int_message(1, 1, 0, which),
        mav.MAVLink_mission_count_message(1, 1, 4, which),
        mav.MAVLink_mission_item_int_message(
            1, 1, 0, 0, WAYPOINT, 0, 1, 0, 0, 0, 0, 1, 1, 1, which
        ),
    ):
        assert acks(outside.say(refused)) == [(mav.MAV_MISSION_UNSUPPORTED, which)]
    assert count(outside) == 2
    assert acks(outside.say(clear(1, 1, ALL))) == [(0, ALL)]
    assert count(outside) == 0


async def test_a_second_upload_at_once_is_refused_to_the_second() -> None:
    outside = Outside(other := Program(246))
    begin = mav.MAVLink_mission_count_message(1, 1, 1, 0)
    outside.say(begin)
    denied = [(mav.MAV_MISSION_DENIED, 0)]
    clear = mav.MAVLink_mission_clear_all_message(1, 1, 0)
    for disturbing in (begin, place(0, 9.0), clear):
        assert acks(other.say(disturbing)) == denied
    assert acks(outside.say(place(0, 1.0))) == [(0, 0)]
    assert outside.say(mav.MAVLink_mission_request_int_message(1, 1, 0, 0))[0].x == 10_000
    assert acks(outside.say(place(0, 1.0))) == [(0, 0)]  # the answer got lost
    assert acks(other.say(place(0, 1.0))) == [(mav.MAV_MISSION_ERROR, 0)]
    assert acks(upload(other, place(0, 2.0)))[-1] == (0, 0)
    other.close()
    outside.close()


async def test_a_guided_place_of_ardupilot_is_refused_in_words(outside: Outside) -> None:
    guided = mav.MAVLink_mission_item_message(
        1, 1, 0, 3, WAYPOINT, 2, 1, 0, 0, 0, 0, 47.0, 8.0, 2.0, 0
    )
    answers = outside.say(guided)
    assert acks(answers) == [(mav.MAV_MISSION_UNSUPPORTED, 0)]
    assert "guided places are ArduPilot's: send DO_REPOSITION" in texts(answers)[0]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (item(0, mav.MAV_CMD_NAV_DELAY, p1=-1), "expected a delay of 0 to 3600 s, found -1"),
        (item(0, WAYPOINT, frame=20), "expected a local or global frame, found frame 20"),
        (place(0, 2e4), "expected a place within 10 km of the vehicle's origin"),
        (item(0, mav.MAV_CMD_DO_CHANGE_SPEED), "expected a positive speed, found 0"),
        (item(0, 82), "command 82 is not supported"),
    ],
)
async def test_a_refused_item_says_why(outside: Outside, wrong: Any, words: str) -> None:
    answers = upload(outside, wrong)
    assert f"mission refused: item 0: {words}" in texts(answers)[0]
    assert acks(answers) == [(mav.MAV_MISSION_UNSUPPORTED, 0)]


FAR = [place(seq, 5.0 * seq + 5.0) for seq in range(4)]


@pytest.mark.parametrize("by_command", [False, True])
async def test_what_is_jumped_over_is_not_reached(outside: Outside, by_command: bool) -> None:
    upload(outside, *FAR)
    outside.flies()
    outside.say(start())
    assert fly(outside, 1.0) == ([], [])
    if by_command:
        jump: Any = command(mav.MAV_CMD_DO_SET_MISSION_CURRENT, 2)
    else:
        jump = mav.MAVLink_mission_set_current_message(1, 1, 2)
    outside.say(jump)
    outside.passes(0.1)
    reached, sentences = fly(outside, 15.0)
    assert reached == [2, 3]
    assert sentences == ["mission finished"]
    assert texts(outside.say(mav.MAVLink_mission_set_current_message(1, 1, 9))) == [
        "mission: expected an item below 4, found 9"
    ]


async def test_a_jump_ends_the_stay_at_an_item(outside: Outside) -> None:
    """An item is reached once its stay is over, and not when it is left before."""
    upload(outside, place(0, 1.0, stay=5.0), *[place(seq, 1.5) for seq in (1, 2)])
    outside.flies()
    outside.say(start())
    assert fly(outside, 2.0)[0] == []
    outside.say(mav.MAVLink_mission_set_current_message(1, 1, 2))
    assert fly(outside, 2.0)[0] == [2]
    outside.say(start(0))
    assert fly(outside, 8.0)[0] == [0, 1, 2]


async def test_an_upload_in_flight_is_flown_from_its_first_item(outside: Outside) -> None:
    upload(outside, *FAR)
    outside.flies()
    outside.say(start())
    fly(outside, 4.0)
    upload(outside, place(0, 1.0), place(1, 1.5))
    reached, sentences = fly(outside, 12.0)
    assert reached == [0, 1]
    assert sentences == ["mission finished"]
    outside.say(start(), mav.MAVLink_mission_clear_all_message(1, 1, 0))
    assert fly(outside, 1.0) == ([], ["mission cleared: holding"])
    assert isinstance(outside.acts[-1], ev.Hover)


async def test_a_start_has_a_first_and_a_last_item(outside: Outside) -> None:
    short = [place(seq, 1.0 + 0.2 * seq) for seq in range(4)]
    upload(outside, *short)
    outside.flies()
    assert results(outside.say(start(1, 2))) == [0]
    assert fly(outside, 2.0)[0] == [1, 2]
    for first, last, words in ((4, 0, "a first item below 4, found 4"), (2, 1, "after the first")):
        answers = outside.say(start(first, last))
        assert results(answers) == [mav.MAV_RESULT_DENIED]
        assert words in texts(answers)[0]
    assert results(outside.say(start(0, 3))) == [0]
    assert fly(outside, 3.0)[0] == [0, 1, 2, 3]
    outside.say(mode(4, 4))  # a mission that is over begins again
    assert fly(outside, 3.0)[0] == [0, 1, 2, 3]


async def test_a_second_start_begins_anew_and_a_pause_goes_on(outside: Outside) -> None:
    upload(outside, place(0, 1.0), place(1, 9.0), place(2, 9.2))
    outside.flies()
    outside.say(start())
    assert fly(outside, 2.0)[0] == [0]
    outside.say(mode(4, 3))
    assert fly(outside, 1.0)[0] == []
    outside.say(mode(4, 4))
    outside.passes(0.1)
    assert fly(outside, 1.0)[0] == []
    outside.say(start(0))
    outside.passes(0.1)
    assert fly(outside, 12.0)[0] == [0, 1, 2]


async def test_a_mission_lands_at_its_place(outside: Outside) -> None:
    land = mav.MAVLink_mission_item_int_message(
        1, 1, 1, 1, mav.MAV_CMD_NAV_LAND, 0, 1, 0, 0, 0, math.nan, 60_000, 20_000, 0.0, 0
    )
    upload(outside, place(0, 1.5), land)
    outside.flies()
    outside.say(start())
    reached, _ = fly(outside, 2.0)
    assert reached == [0]
    assert fly(outside, 3.0) == ([], [])
    assert isinstance(outside.acts[-1], ev.Land)
    assert outside.acts[-2].position == pytest.approx((6.0, 2.0, -2.0))
    assert touch_down(outside) == ([1], ["mission finished"])


@pytest.mark.parametrize("ends", ["hold", "jump", "kill"])
async def test_a_landing_that_ends_in_the_air_is_not_reached(outside: Outside, ends: str) -> None:
    upload(outside, place(0, 1.5), land_here(1))
    outside.flies()
    outside.say(start(1))
    fly(outside, 0.2)
    assert isinstance(outside.acts[-1], ev.Land)
    if ends == "hold":
        outside.say(mode(4, 3))
    elif ends == "jump":
        outside.say(mav.MAVLink_mission_set_current_message(1, 1, 0))
    else:
        outside.endpoint.flight.handle_event(ev.Disarmed(stamp=outside.now, source="drone"))
    assert touch_down(outside) == ([], [])


async def test_the_item_under_way_and_the_state_are_told_each_second(outside: Outside) -> None:
    """As the specification has it, whoever comes later; so that programs know when it is over."""

    def told() -> set[tuple[int, int, int, int]]:
        messages = of("MISSION_CURRENT", outside.passes(3.0))
        assert len(messages) == 3
        return {(m.seq, m.total, m.mission_state, m.mission_mode) for m in messages}

    assert told() == {(0, 65535, mav.MISSION_STATE_NO_MISSION, 2)}
    upload(outside, place(0, 1.0), place(1, 30.0), land_here(2))
    assert told() == {(0, 3, mav.MISSION_STATE_NOT_STARTED, 2)}
    outside.flies()
    outside.say(start())
    assert fly(outside, 2.0)[0] == [0]
    assert told() == {(1, 3, mav.MISSION_STATE_ACTIVE, 1)}
    outside.say(mode(4, 3))
    assert told() == {(1, 3, mav.MISSION_STATE_PAUSED, 2)}
    outside.say(start(2))
    assert told() == {(2, 3, mav.MISSION_STATE_ACTIVE, 1)}
    touch_down(outside)
    assert told() == {(2, 3, mav.MISSION_STATE_COMPLETE, 2)}


async def test_progress_comes_once_a_second_and_on_request(outside: Outside) -> None:
    """For a station that joins later, too; at another rate if it asks for that."""
    number, interval = mav.MAVLINK_MSG_ID_MISSION_CURRENT, mav.MAV_CMD_SET_MESSAGE_INTERVAL
    outside.passes(0.1)
    upload(outside, place(0, 1.0), place(1, 2.0), place(2, 3.0))
    outside.say(mav.MAVLink_mission_set_current_message(1, 1, 1))
    (current,) = of("MISSION_CURRENT", outside.passes(1.0))
    assert (current.seq, current.total) == (1, 3)
    (current,) = of("MISSION_CURRENT", outside.say(command(mav.MAV_CMD_REQUEST_MESSAGE, number)))
    assert current.seq == 1
    assert results(outside.say(command(interval, number, 1e5))) == [0]
    outside.passes(1.0)
    assert len(of("MISSION_CURRENT", outside.passes(1.0))) == 10
