"""The endpoint without a network: what each message does to the vehicle, and what is answered."""

from __future__ import annotations

import asyncio
import math
import socket
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as mav

import events as ev
from extensions.mavlink.tests.outside import (
    SECOND,
    Outside,
    Program,
    arm,
    command,
    mode,
    of,
    results,
    target,
    texts,
)
from runtime.errors import VisnavError
from runtime.logs import NodeLogger
from runtime.testing import run_nodes, spec
from tests.nodes.pilots.test_pilot import Vehicle
from tests.runtime.tools.samples_cli import ROOT, command_here
from visnav_mavlink.links import BURST, MOST_PEERS, Links
from visnav_mavlink.messages import ROWS, TREATMENTS, table
from visnav_mavlink.node import Mavlink, Px4
from visnav_mavlink.settings import MavlinkConfig


async def test_it_is_seen_as_an_autopilot_that_can_fly(outside: Outside) -> None:
    heard = {message.get_type(): message for message in outside.passes(2.0)}
    assert (heard["HEARTBEAT"].get_srcSystem(), heard["HEARTBEAT"].get_srcComponent()) == (1, 1)
    assert heard["SYS_STATUS"].onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK
    assert heard["HOME_POSITION"].x == 1.0
    assert heard["SYSTEM_TIME"].time_boot_ms == pytest.approx(outside.now / 1e6, abs=1000)
    assert heard["GLOBAL_POSITION_INT"].lat > 470000000
    assert heard["LOCAL_POSITION_NED"].y == 2.0
    assert "AUTOPILOT_VERSION" not in heard  # which comes when it is asked for
    (ack,) = results(answers := outside.say(command(mav.MAV_CMD_REQUEST_MESSAGE, 148)))
    assert ack == 0
    assert of("AUTOPILOT_VERSION", answers)


async def test_rates_are_those_that_are_asked_for(outside: Outside) -> None:
    outside.passes(1.0)
    assert len(of("ATTITUDE", outside.passes(2.0))) == pytest.approx(40, abs=1)
    assert results(outside.say(command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 30, 1e5))) == [0]
    assert len(of("ATTITUDE", outside.passes(2.0))) == pytest.approx(20, abs=1)
    assert results(outside.say(command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 30, -1))) == [0]
    assert of("ATTITUDE", outside.passes(1.0)) == []
    unknown = mav.MAV_RESULT_UNSUPPORTED
    assert results(outside.say(command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 1e5))) == [unknown]


async def test_sequence_numbers_rise_by_one_message_after_message(outside: Outside) -> None:
    """As every program's meter of losses counts them: per link, system and component."""
    numbers = [message.get_seq() for message in outside.passes(3.0)]
    assert len(numbers) > 256
    assert numbers == [index % 256 for index in range(len(numbers))]


async def test_a_rate_that_is_accepted_comes(outside: Outside) -> None:
    """At 100 Hz exactly; beyond that the answer says what comes instead."""
    interval = mav.MAV_CMD_SET_MESSAGE_INTERVAL
    for microseconds, count in ((10_000, 200), (33_333, 60), (20_000, 100)):
        outside.passes(0.1)
        assert results(outside.say(command(interval, 30, microseconds))) == [0]
        outside.passes(0.1)
        assert len(of("ATTITUDE", outside.passes(2.0))) == pytest.approx(count, abs=1)
    answers = outside.say(command(interval, 30, 2000))
    assert results(answers) == [0]
    (text,) = of("STATUSTEXT", answers)
    assert text.text == "ATTITUDE: expected at most 100 Hz, which now comes"
    (period,) = of("MESSAGE_INTERVAL", outside.say(command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, 30)))
    assert period.interval_us == 10_000
    assert len(of("ATTITUDE", outside.passes(2.0))) == pytest.approx(200, abs=1)


async def test_rates_are_of_the_peer_that_asks() -> None:
    """A station that wants no heartbeat takes it from nobody else."""
    outside = Outside(other := Program())
    assert results(outside.say(command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, -1))) == [0]
    sent = outside.passes(2.0)
    assert of("HEARTBEAT", sent) == []
    assert of("ATTITUDE", sent)
    assert len(of("HEARTBEAT", other.hear())) == 2
    other.close()
    outside.close()


async def test_every_command_is_acknowledged(outside: Outside) -> None:
    """What is not supported says so; take-off before arming is refused."""
    assert results(outside.say(command(2500))) == [mav.MAV_RESULT_UNSUPPORTED]
    take_off = command(mav.MAV_CMD_NAV_TAKEOFF)
    assert results(outside.say(take_off)) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert results(outside.say(arm(1), take_off)) == [0, 0]
    assert [type(act) for act in outside.acts] == [ev.Arm, ev.Takeoff]
    assert outside.acts[1].altitude == 2.5
    assert (
        outside.say(mav.MAVLink_command_long_message(2, 1, 400, 0, *[0.0] * 7)) == []
    )  # to another


async def test_it_is_not_disarmed_in_the_air_but_by_force(outside: Outside) -> None:
    outside.flies()
    assert results(outside.say(arm(0))) == [mav.MAV_RESULT_DENIED]
    assert outside.acts == []
    assert results(outside.say(arm(0, 21196))) == [0]
    assert isinstance(outside.acts[0], ev.Disarm)


async def test_offboard_needs_setpoints_and_ends_without(outside: Outside) -> None:
    outside.flies()
    position = 0b101111111000  # its x, y, z and its heading count
    assert results(outside.say(mode(6, 0))) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
    assert results(outside.say(target(position, x=3.0), mode(6, 0))) == [0]
    outside.say(target(position, x=3.0))
    assert outside.acts[-1].position == (3.0, 0.0, -2.0)
    assert outside.acts[-1].yaw == 0.5
    outside.say(target(0b110111000111, vx=1.0, frame=mav.MAV_FRAME_BODY_NED))
    assert outside.acts[-1].velocity == (1.0, 0.0, 0.0)
    assert outside.acts[-1].frame_id == "heading"
    outside.say(mav.MAVLink_set_attitude_target_message(0, 1, 1, 128, [1, 0, 0, 0], 0.1, 0, 0, 0.5))
    assert outside.acts[-1].angular_velocity == pytest.approx((0.1, 0.0, 0.0))
    assert "offboard: no set-point for 0.5 s: holding" in texts(outside.passes(1.0))
    assert isinstance(outside.acts[-1], ev.Hover)
    assert outside.endpoint.vehicle.mode == "hold"


async def test_sticks_fly_in_their_modes_alone(outside: Outside) -> None:
    def sticks(x: int, y: int, z: int, r: int, target: int = 1) -> Any:
        return mav.MAVLink_manual_control_message(target, x, y, z, r, 0)

    words = "expected an armed vehicle in mode POSCTL or ALTCTL"
    assert texts(outside.say(sticks(0, 0, 500, 0), sticks(0, 0, 500, 0))) == [
        f"MANUAL_CONTROL of 245/190 has no effect: {words}"
    ]
    outside.say(arm(1), mode(3, 0), sticks(0, 0, 0, 0))
    assert [type(act) for act in outside.acts] == [ev.Arm]  # the ground is not flown into
    outside.say(sticks(0, 0, 1000, 0))
    assert outside.acts[-1].velocity == (0.0, 0.0, -1.0)
    outside.flies()
    for main in (2, 3):
        outside.say(mode(main, 0), sticks(1000, -500, 250, 500), sticks(0, 0, 0, 0, target=2))
        assert outside.acts[-1].velocity == (2.0, -1.0, 0.5)
        assert (outside.acts[-1].yaw_rate, outside.acts[-1].frame_id) == (0.5, "heading")
    outside.say(sticks(32767, 32767, 32767, 32767))
    assert outside.acts[-1].velocity == (0.0, 0.0, 0.0)


async def test_a_place_is_approached_at_the_cruising_speed(outside: Outside) -> None:
    outside.flies()
    place = mav.MAVLink_command_int_message(
        1, 1, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_CMD_DO_REPOSITION, 0, 0,
        1.0, 0, 0, math.nan, 470000000, 80000000, 4.0,
    )  # fmt: skip
    assert results(outside.say(place)) == [0]
    outside.passes(1.02)
    x, y, z = outside.acts[-1].position
    assert math.dist((x, y, z), (1.0, 2.0, -2.0)) == pytest.approx(1.0, abs=0.05)  # 1 m/s
    outside.passes(5.0)
    assert outside.acts[-1].position == pytest.approx((0.0, 0.0, -4.1), abs=0.02)


def placed(number: int, x: int, y: int, z: float, frame: int = 6, p1: float = -1) -> Any:
    nan = math.nan
    return mav.MAVLink_command_int_message(1, 1, frame, number, 0, 0, p1, 1, 0, nan, x, y, z)


UNKNOWN_PLACE = 2**31 - 1


async def test_a_reposition_without_a_place_holds(outside: Outside) -> None:
    """As ground stations pause; what is unknown of a place is where the vehicle is."""
    reposition = mav.MAV_CMD_DO_REPOSITION
    outside.flies()
    pause = command(reposition, -1, 1, 0)
    assert results(outside.say(pause)) == [0]
    assert [type(act) for act in outside.acts] == [ev.Hover]
    outside.passes(0.5)
    assert len(outside.acts) == 1
    for higher in (
        command(reposition, -1, 1, 0, math.nan, math.nan, math.nan, 403.9),
        placed(reposition, UNKNOWN_PLACE, UNKNOWN_PLACE, 3.8),
    ):
        assert results(outside.say(higher)) == [0]
        outside.passes(3.0)
        assert outside.acts[-1].position == pytest.approx((1.0, 2.0, -3.9), abs=1e-3)
    assert results(outside.say(placed(reposition, 30_000, 40_000, math.nan, frame=1))) == [0]
    outside.passes(3.0)
    assert outside.acts[-1].position == pytest.approx((3.0, 4.0, -2.0))


async def test_a_refused_place_says_why(outside: Outside) -> None:
    reposition = mav.MAV_CMD_DO_REPOSITION
    denied = [mav.MAV_RESULT_DENIED]
    answers = outside.say(command(reposition))
    assert results(answers) == denied
    assert texts(answers) == ["reposition denied: expected an armed vehicle, found it disarmed"]
    outside.flies()
    for wrong, words in (
        (placed(reposition, 480000000, 80000000, 3.0), "expected a place within 10 km of the"),
        (
            placed(reposition, 1, 1, 3.0, frame=20),
            "expected a local or global frame, found frame 20",
        ),
        (placed(reposition, 910000000 * 2, 0, 3.0), "expected latitude, longitude and altitude"),
    ):
        answers = outside.say(wrong)
        assert results(answers) == denied
        assert words in texts(answers)[0]
    assert outside.acts == []


async def test_it_lands_where_it_is_told_to(outside: Outside) -> None:
    land = mav.MAV_CMD_NAV_LAND
    outside.flies()
    for here in (command(land), command(land, 0, 0, 0, 0, 0, 0, 0)):
        outside.say(mode(4, 3))
        assert results(outside.say(here)) == [0]
        assert isinstance(outside.acts[-1], ev.Land)
    outside.say(mode(4, 3), placed(land, 50_000, 20_000, 0, frame=1))
    outside.passes(1.0)
    assert not isinstance(outside.acts[-1], ev.Land)
    assert outside.endpoint.vehicle.mode == "hold"
    outside.at((5.0, 2.0, -2.0))
    outside.passes(2.0)
    assert isinstance(outside.acts[-1], ev.Land)


async def test_a_takeoff_that_cannot_be_says_why(outside: Outside) -> None:
    take_off = mav.MAV_CMD_NAV_TAKEOFF
    outside.say(arm(1))
    answers = outside.say(command(take_off, 0, 0, 0, math.nan, math.nan, math.nan, 10.0))
    assert results(answers) == [mav.MAV_RESULT_DENIED]
    assert texts(answers) == [
        "takeoff denied: expected an altitude 0.3 m or more above the vehicle, found 10 m above "
        "sea level, which is 390.1 m below it"
    ]
    assert results(outside.say(placed(take_off, 0, 0, 3.0))) == [0]  # above home, by its frame
    assert outside.acts[-1].altitude == pytest.approx(3.0, abs=1e-3)
    outside.at((1.0, 2.0, -3.1))
    outside.say(mode(4, 6))
    for where in ("landing", "in the air"):
        answers = outside.say(command(take_off))
        assert results(answers) == [mav.MAV_RESULT_TEMPORARILY_REJECTED]
        assert f"found it {where}" in texts(answers)[0]
        assert isinstance(outside.acts[-1], ev.Land if where == "landing" else ev.Hover)
        outside.say(mode(4, 3))


async def test_a_return_goes_on_when_its_program_has_ended(outside: Outside) -> None:
    outside.flies()
    outside.passes(0.1)
    outside.say(command(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH))
    outside.passes(5.0, heartbeat=False)
    assert outside.endpoint.vehicle.mode == "return"
    outside.at((1.0, 2.0, -2.6))
    outside.passes(1.0, heartbeat=False)
    assert isinstance(outside.acts[-1], ev.Land)


async def test_parameters_are_listed_read_and_set(outside: Outside) -> None:
    values = outside.say(mav.MAVLink_param_request_list_message(1, 1))
    assert {value.param_id for value in values} == {
        "MIS_TAKEOFF_ALT",
        "MPC_XY_CRUISE",
        "RTL_RETURN_ALT",
    }
    real = mav.MAV_PARAM_TYPE_REAL32
    (now,) = outside.say(mav.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", 4.0, real))
    assert now.param_value == 4.0
    kept = outside.say(mav.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", math.nan, real))
    assert [message.param_value for message in of("PARAM_VALUE", kept)] == [4.0]
    unknown = mav.MAVLink_param_request_read_message(1, 1, b"CAL_GYRO0_ID", -1)
    text = "PARAM_REQUEST_READ of 245/190 has no effect: parameter CAL_GYRO0_ID is unknown here"
    answers = outside.say(unknown, unknown)
    assert texts(answers) == [text]
    errors = [(error.param_id, error.error) for error in of("PARAM_ERROR", answers)]
    assert errors == [("CAL_GYRO0_ID", mav.MAV_PARAM_ERROR_DOES_NOT_EXIST)] * 2
    (beyond,) = of("PARAM_ERROR", outside.say(mav.MAVLink_param_request_read_message(1, 1, b"", 9)))
    assert (beyond.param_index, beyond.target_component) == (9, 190)
    whole = mav.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", 3.0, mav.MAV_PARAM_TYPE_INT32)
    assert of("PARAM_VALUE", outside.say(whole))[0].param_value == 4.0


async def test_parameters_without_effect_are_kept_and_told_so(outside: Outside) -> None:
    """With their type, whose bytes stand in the value; they are listed with the others."""
    whole = mav.MAV_PARAM_TYPE_INT32
    setting = mav.MAVLink_param_set_message(1, 1, b"COM_RCL_EXCEPT", 5.6e-45, whole)
    answers = outside.say(setting, setting)
    given = [(value.param_value, value.param_type) for value in of("PARAM_VALUE", answers)]
    assert given == [(pytest.approx(5.6e-45), whole)] * 2
    (text,) = texts(answers)
    assert text.endswith("no effect: COM_RCL_EXCEPT is kept, but nothing here is set by it")
    assert len(outside.say(mav.MAVLink_param_request_list_message(1, 1))) == 4
    by_number = mav.MAVLink_param_request_read_message(1, 1, b"", 3)
    assert outside.say(by_number)[0].param_id == "COM_RCL_EXCEPT"


async def test_who_is_not_heard_any_more_is_missed(outside: Outside) -> None:
    outside.flies()
    outside.passes(5.0)
    assert outside.acts == []
    outside.passes(4.0, heartbeat=False)
    assert [type(act) for act in outside.acts] == [ev.Hover]


async def test_poses_from_outside_are_estimates_of_their_stamp() -> None:
    outside = Outside(vision=True)
    outside.now = 100 * SECOND
    pose = (0.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2)
    covariance = [float(n) for n in range(1, 22)]
    outside.say(
        mav.MAVLink_vision_position_estimate_message(99_900_000, *pose, covariance, 2),
        mav.MAVLink_vision_position_estimate_message(99_950_000, *pose, [math.nan] * 21, 0),
        mav.MAVLink_vision_position_estimate_message(1, math.nan, *pose[1:], covariance, 0),
    )
    first, second = outside.seen
    assert first["stamp"] == 99_900_000_000
    assert first["frame_id"] == "odom_2"
    assert first["orientation"] == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))
    assert first["covariance"][:8] == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 2.0, 7.0)
    assert second["stamp"] == 99_950_000_000
    assert second["covariance"] == ()
    (sync,) = outside.say(mav.MAVLink_timesync_message(0, 77))
    assert (sync.tc1, sync.ts1) == (outside.now, 77)
    outside.close()


def vision(stamp: int) -> Any:
    return mav.MAVLink_vision_position_estimate_message(stamp // 1000, *[0.0] * 6, [0.0] * 21, 0)


@pytest.mark.parametrize("behind", [8.0, -3.0])
async def test_stamps_of_another_clock_are_corrected_from_the_first_pose_on(behind: float) -> None:
    """By the earliest arrival, so that their distances stay; and the program is told."""
    outside = Outside(vision=True)
    sentences: list[str] = []
    outside.now = 100 * SECOND
    start, offset = outside.now, round(behind * SECOND)
    latencies = [round(ms * 1e6) for ms in (60, 90, 40, 120)]
    for number, latency in enumerate(latencies):
        taken = start + number * SECOND // 10
        outside.now = taken + latency
        sentences += texts(outside.say(vision(taken - offset)))
    stamps = [pose["stamp"] - start for pose in outside.seen]
    late = [latencies[0], latencies[0], latencies[2], latencies[2]]  # of the earliest until then
    expected = [number * SECOND // 10 + late[number] for number in range(4)]
    assert stamps == pytest.approx(expected, abs=1e3)
    word = "behind" if behind > 0 else "ahead"
    (text,) = sentences
    assert text.startswith("poses of 245/190: stamps are ")
    assert text.endswith(
        f"s {word}, of another clock: corrected by the earliest arrival; delay 0 ms"
    )
    outside.close()


async def test_a_clock_that_answers_is_measured() -> None:
    """Then the poses' latency is right; without a difference nothing is told."""
    outside = Outside(vision=True)
    outside.now = 100 * SECOND
    (asked,) = of("TIMESYNC", outside.passes(0.1, heartbeat=False))
    outside.now = asked.ts1 + SECOND // 100
    answer = mav.MAVLink_timesync_message(asked.ts1 + SECOND // 200 - 8 * SECOND, asked.ts1)
    assert outside.say(answer) == []
    taken = outside.now
    outside.now += SECOND // 5
    (text,) = texts(outside.say(vision(taken - 8 * SECOND)))
    assert text.endswith(
        "stamps are 8.0 s behind, of another clock: corrected by TIMESYNC; delay 0 ms"
    )
    assert outside.seen[-1]["stamp"] == pytest.approx(taken, abs=1e3)
    other = Outside(vision=True)
    assert other.say(vision(other.now - SECOND // 2)) == []
    assert other.seen[-1]["stamp"] == pytest.approx(other.now - SECOND // 2, abs=1e3)
    other.close()
    outside.close()


async def test_only_the_signed_are_heard_if_there_is_a_key() -> None:
    outside = Outside(signing_key="5a" * 32)
    assert results(outside.say(arm(1))) == [0]
    outside.parser.signing.sign_outgoing = False
    outside.say(arm(0))
    assert [type(act) for act in outside.acts] == [ev.Arm]
    outside.close()


async def test_a_flood_waits_and_our_own_name_is_not_heard(outside: Outside) -> None:
    outside.passes(0.1)
    outside.say(*[mav.MAVLink_ping_message(0, 1, 0, 0)] * (BURST + 1))
    assert outside.endpoint._links.counts["pauses in a flood"] >= 1
    outside.passes(0.1)
    outside.parser = mav.MAVLink(None, 1, 1)
    assert outside.say(arm(1)) == []
    assert outside.acts == []


async def polled() -> None:
    """Let the loop look at its sockets, as often as one leads to another."""
    for _ in range(20):
        await asyncio.sleep(0)


async def test_streams_are_so_many_are_answered_and_end() -> None:
    heard: list[Any] = []
    links = Links((1, 1), b"", lambda *arguments: heard.append(arguments), NodeLogger("mavlink"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
    links.open("tcp://{}:{}".format(*address))
    ends = [socket.create_connection(address) for _ in range(MOST_PEERS + 1)]
    ping = mav.MAVLink_ping_message(0, 1, 0, 0)
    ends[0].sendall(ping.pack(mav.MAVLink(None, 245, 190)))
    await polled()
    assert [sender for _, sender, _ in heard] == [(245, 190)]
    assert len(links.peers) == MOST_PEERS
    assert links.counts["connections refused"] == 1
    links.send(ping)
    (answer,) = mav.MAVLink(None).parse_buffer(ends[0].recv(4096))
    assert answer.get_srcSystem() == 1
    for end in ends:
        end.close()
    await polled()
    assert links.peers == []
    links.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("run.speed=2", "expected run.speed = 1.0 or less, for programs keep real time, found 2"),
        ("mavlink.telemetry=odometri", 'telemetry: expected an estimator, found "odometri"'),
        ("mavlink.vehicle=plane", "expected plane to fly, found none"),
        ("mavlink.endpoints=['udp://there']", "endpoints: expected udp://HOST:PORT"),
    ],
)
def test_what_is_wrong_in_a_file_is_said_before_the_flight(change: str, message: str) -> None:
    done = command_here(
        "check", "extensions/mavlink/examples/mavsdk.toml", "--set", change, folder=ROOT
    )
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("node", "settings", "message"),
    [
        (Mavlink, {"endpoints": []}, r'to say which it flies: write vehicle = "v" into its entry'),
        (Px4, {"port": 0}, r"expected one vehicle whose motors to drive, found v, w: set vehicle"),
    ],
)
def test_of_several_vehicles_one_is_named(node: Any, settings: Any, message: str) -> None:
    nodes = [spec(Vehicle, "v"), spec(Vehicle, "w"), spec(node, "outside", settings)]
    with pytest.raises(VisnavError, match=message):
        run_nodes(nodes, duration=1)


@pytest.mark.parametrize(
    "wrong",
    ["127.0.0.1:14540", "udp://:14540", "udp://127.0.0.1", "http://a:1", "udp://a:99999"],
)
def test_endpoints_are_udp_or_tcp(wrong: str) -> None:
    right = "tcp://127.0.0.1:5760"
    MavlinkConfig(endpoints=(right,))
    expected = "endpoints: expected udp://HOST:PORT or tcp://HOST:PORT, found"
    with pytest.raises(ValueError, match=f"{expected} '{wrong}'"):
        MavlinkConfig(endpoints=(right, wrong))


@pytest.mark.parametrize("wrong", ["secret", "5a" * 31])
def test_a_key_has_64_digits(wrong: str) -> None:
    with pytest.raises(ValueError, match="signing_key: expected 64 hexadecimal digits"):
        MavlinkConfig(signing_key=wrong)


KINDS = [
    mav.MAVLink_command_long_message, mav.MAVLink_command_int_message,
    mav.MAVLink_set_position_target_local_ned_message,
    mav.MAVLink_set_position_target_global_int_message, mav.MAVLink_mission_count_message,
    mav.MAVLink_mission_item_int_message, mav.MAVLink_mission_item_message,
    mav.MAVLink_mission_request_int_message, mav.MAVLink_param_request_read_message,
    mav.MAVLink_set_mode_message, mav.MAVLink_vision_position_estimate_message,
    mav.MAVLink_odometry_message, mav.MAVLink_set_attitude_target_message,
    mav.MAVLink_manual_control_message, mav.MAVLink_att_pos_mocap_message,
    mav.MAVLink_param_set_message, mav.MAVLink_request_data_stream_message,
    mav.MAVLink_mission_ack_message, mav.MAVLink_mission_set_current_message,
    mav.MAVLink_mission_request_message, mav.MAVLink_timesync_message,
    mav.MAVLink_file_transfer_protocol_message, mav.MAVLink_param_ext_set_message,
    mav.MAVLink_vision_speed_estimate_message, ardupilotmega.MAVLink_vision_position_delta_message,
]  # fmt: skip
NUMBERS = {
    "uint8_t": 0xFF, "uint16_t": 0xFFFF, "uint32_t": 0xFFFFFFFF, "uint64_t": 2**64 - 1,
    "int8_t": 127, "int16_t": 32767, "int32_t": 2**31 - 1, "int64_t": 2**63 - 1,
}  # fmt: skip


@st.composite
def hostile(draw: st.DrawFn) -> bytes:
    """A valid message with any numbers, or bytes that are none."""
    if draw(st.booleans()):
        return draw(st.binary(max_size=300))
    kind = draw(st.sampled_from(KINDS))
    values: list[Any] = []
    for name, what, size in zip(kind.fieldnames, kind.fieldtypes, _sizes(kind), strict=True):
        most = NUMBERS.get(what)
        one = st.floats(width=32) if most is None else st.integers(0, most)
        if name.startswith("target"):
            one = st.sampled_from([0, 1])
        elif name == "command":
            one = st.sampled_from(
                [16, 20, 21, 22, 176, 178, 192, 224, 300, 400, 410, 510, 511, 512, 9]
            )
        if what == "char":
            values.append(draw(st.binary(max_size=16)))
        elif size:
            values.append(draw(st.lists(one, min_size=size, max_size=size)))
        else:
            values.append(draw(one))
    data: bytes = kind(*values).pack(mav.MAVLink(None, 245, 190))
    return data


def _sizes(kind: Any) -> list[int]:
    by_order = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    return [by_order[name] for name in kind.fieldnames]


def generic(kind: Any) -> Any:
    """Return a message of this kind for the vehicle, its fields all ones or halves."""
    values: list[Any] = []
    for what, size in zip(kind.fieldtypes, _sizes(kind), strict=True):
        one = 0.5 if what in {"float", "double"} else 1
        values.append(b"1" if what == "char" else [one] * size if size else one)
    return kind(*values)


ANSWERED = {
    "COMMAND_LONG": {"COMMAND_ACK"}, "COMMAND_INT": {"COMMAND_ACK"},
    "MISSION_COUNT": {"MISSION_ACK"}, "MISSION_ITEM": {"MISSION_ACK"},
    "MISSION_ITEM_INT": {"MISSION_ACK"}, "MISSION_CLEAR_ALL": {"MISSION_ACK"},
    "MISSION_REQUEST_LIST": {"MISSION_COUNT"}, "MISSION_REQUEST": {"MISSION_ACK"},
    "MISSION_REQUEST_INT": {"MISSION_ACK"}, "PARAM_REQUEST_LIST": {"PARAM_VALUE"},
    "PARAM_REQUEST_READ": {"PARAM_VALUE"}, "LOG_REQUEST_LIST": {"LOG_ENTRY"},
    "LOG_REQUEST_DATA": {"LOG_DATA"}, "FILE_TRANSFER_PROTOCOL": {"FILE_TRANSFER_PROTOCOL"},
    "PARAM_EXT_SET": {"PARAM_EXT_ACK"}, "MISSION_REQUEST_PARTIAL_LIST": {"MISSION_ACK"},
    "PARAM_SET": {"PARAM_ERROR"},
    "MISSION_WRITE_PARTIAL_LIST": {"MISSION_ACK"}, "SET_GPS_GLOBAL_ORIGIN": {"GPS_GLOBAL_ORIGIN"},
}  # fmt: skip
"""Answers to one message of each kind, besides words; nothing to all others."""
TREATED_WITH_WORDS = {
    "SET_MODE", "MISSION_COUNT", "PARAM_SET", "REQUEST_DATA_STREAM",
    "SET_POSITION_TARGET_GLOBAL_INT", "MANUAL_CONTROL",
}  # fmt: skip
"""Kinds that are obeyed, but whose generic message cannot be, and is told so."""


async def test_each_kind_of_message_is_treated_as_the_table_has_it() -> None:
    """What is refused is told once to each sender; nothing raises, and nothing is unknown."""
    outside = Outside(vision=True)
    counts, acts = outside.endpoint._links.counts, outside.acts
    for kind in mav.mavlink_map.values():
        name, message = kind.msgname, generic(kind)
        if name in {"TIMESYNC", "PING"}:
            continue  # generic ones are answers themselves
        row, poses = TREATMENTS.get(name), len(outside.seen)
        answers = outside.say(message)
        others = {answer.get_type() for answer in answers} - {"STATUSTEXT"}
        assert others == ANSWERED.get(name, set()), name
        refusal = [text for text in texts(answers) if text.startswith(f"{name} of 245/190 has no")]
        if row is None or row.treatment == "refused":
            assert len(refusal) == 1, name
            assert texts(outside.say(message)) == [], name
        elif row.treatment == "not for a vehicle":
            assert answers == [], name
        elif name not in TREATED_WITH_WORDS and others != {"MISSION_ACK"}:
            assert refusal == [], name
        is_pose = row is not None and row.treatment == "judged" and "SPEED" not in name
        outside.passes(0.03)  # in which a pose may wait for a speed
        assert (len(outside.seen) > poses) == is_pose, name
        assert acts == [], name
    assert counts["errors"] == 0
    outside.close()


async def test_the_table_is_what_is_done_and_what_the_page_shows(outside: Outside) -> None:
    done = {kind for kind, row in TREATMENTS.items() if row.treatment in {"obeyed", "judged"}}
    answered = {kind for kind, row in TREATMENTS.items() if row.treatment == "answered"}
    assert {*outside.endpoint._handlers} == (done | answered) - {"HEARTBEAT", "PING"}
    assert sum(len(row.kinds.split()) for row in ROWS) == len(TREATMENTS)
    page = (ROOT / "extensions/mavlink/docs/mavlink.md").read_text()
    assert table() in page


async def test_a_message_of_another_dialect_is_told_once(outside: Outside) -> None:
    message = ardupilotmega.MAVLink_fence_point_message(1, 1, 0, 0, 47.0, 8.0)
    data = message.pack(ardupilotmega.MAVLink(None, 245, 190))
    text = "UNKNOWN_160 of 245/190 has no effect: it is not known here"
    assert texts(outside.say(data, data)) == [text]


async def test_an_error_loses_nothing_else_of_a_read(outside: Outside) -> None:
    def fails(*_: Any) -> None:
        raise OverflowError

    outside.endpoint._handlers["PARAM_SET"] = fails
    both = b"".join(
        message.pack(outside.parser)
        for message in (
            mav.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", 4.0, 9),
            mav.MAVLink_param_request_list_message(1, 1),
        )
    )
    assert len(of("PARAM_VALUE", outside.say(both))) == 3
    assert outside.endpoint._links.counts["errors"] == 1


async def test_another_vehicle_behind_the_same_link_is_not_taken_for_an_estimator() -> None:
    outside = Outside(vision=True)
    pose = mav.MAVLink_vision_position_estimate_message(1, *[0.0] * 6, [0.0] * 21, 0)
    value = mav.MAVLink_param_value_message(b"MIS_TAKEOFF_ALT", 1.0, 9, 3, 0)
    outside.parser = mav.MAVLink(None, 2, 1)
    assert outside.say(pose, value) == []
    assert outside.seen == []
    outside.parser = mav.MAVLink(None, 2, 191)
    outside.say(pose)
    assert len(outside.seen) == 1
    outside.close()


async def test_streams_of_rates_are_set(outside: Outside) -> None:
    assert outside.say(mav.MAVLink_request_data_stream_message(1, 1, 10, 4, 1)) == []
    outside.passes(1.0)
    assert len(of("ATTITUDE", outside.passes(2.0))) == pytest.approx(8, abs=1)
    assert texts(outside.say(mav.MAVLink_request_data_stream_message(1, 1, 3, 4, 1))) == [
        "REQUEST_DATA_STREAM of 245/190 has no effect: stream 3 has no messages here"
    ]


def sampled(vehicle: Any, stamp: int) -> None:
    """Let an IMU measure that is turned upside down about the body's x."""
    vehicle.imu_orientation = (0.0, 1.0, 0.0, 0.0)
    vehicle.add_sample(
        ev.Imu(
            stamp=stamp, source="drone/imu", angular_velocity=(0.1, 0.2, 0.3),
            linear_acceleration=(1.0, 2.0, 9.8),
        )
    )  # fmt: skip


async def test_samples_of_the_imu_come_in_the_axes_of_the_body(outside: Outside) -> None:
    """A flag says of each group whether it is new since the last message to this program."""
    vehicle, number = outside.endpoint.vehicle, mav.MAVLINK_MSG_ID_HIGHRES_IMU
    field = ev.MagneticField(stamp=1, source="drone/magnetometer", magnetic_field=(2e-5, 0.0, 4e-5))
    pressure = ev.FluidPressure(stamp=1, source="drone/barometer", fluid_pressure=101325.0)
    sampled(vehicle, 5_000_000)
    vehicle.add_sample(field)
    (imu,) = of("HIGHRES_IMU", outside.passes(0.04))
    assert (imu.time_usec, imu.temperature) == (5000, 0.0)
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((1.0, -2.0, -9.8))
    assert (imu.xgyro, imu.ygyro, imu.zgyro) == pytest.approx((0.1, -0.2, -0.3))
    assert (imu.xmag, imu.ymag, imu.zmag) == pytest.approx((0.2, 0.0, 0.4))
    assert imu.fields_updated == 0b111111111
    assert of("HIGHRES_IMU", outside.passes(0.2)) == []  # nothing new
    vehicle.add_sample(pressure)
    sampled(vehicle, 9_000_000)
    (imu,) = of("HIGHRES_IMU", outside.passes(0.1))
    assert imu.fields_updated == 0b101000111111
    assert (imu.abs_pressure, imu.pressure_alt) == pytest.approx((1013.25, 0.0), abs=1e-3)
    assert imu.xmag == pytest.approx(0.2)
    whole = of("HIGHRES_IMU", outside.say(command(mav.MAV_CMD_REQUEST_MESSAGE, number)))
    assert [message.fields_updated for message in whole] == [0b101111111111]


async def test_what_is_new_is_so_for_each_program() -> None:
    outside = Outside(other := Program())
    vehicle, number = outside.endpoint.vehicle, mav.MAVLINK_MSG_ID_HIGHRES_IMU
    sampled(vehicle, 1)
    raw = mav.MAV_DATA_STREAM_RAW_SENSORS
    outside.say(mav.MAVLink_request_data_stream_message(1, 1, raw, 100, 1))
    other.say(command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, 2e5))
    outside.passes(0.2)
    other.hear()
    flags: list[int] = []
    for step in range(60):
        if step == 25:
            source = "drone/magnetometer"
            vehicle.add_sample(ev.MagneticField(stamp=1, source=source, magnetic_field=(1.0, 0, 0)))
        sampled(vehicle, step)
        flags += [message.fields_updated for message in of("HIGHRES_IMU", outside.passes(0.01))]
    assert [flag > 0b111111 for flag in flags] == [step == 25 for step in range(60)]
    slower = [message.fields_updated > 0b111111 for message in of("HIGHRES_IMU", other.hear())]
    assert len(slower) == 3
    assert sum(slower) == 1
    other.close()
    outside.close()


async def test_what_never_comes_is_not_accepted(outside: Outside) -> None:
    outside.passes(0.1)
    unsupported = [mav.MAV_RESULT_UNSUPPORTED]
    interval = mav.MAV_CMD_SET_MESSAGE_INTERVAL
    answers = outside.say(command(interval, mav.MAVLINK_MSG_ID_HIGHRES_IMU, 1e5))
    assert results(answers) == unsupported
    assert texts(answers) == ["HIGHRES_IMU: expected a vehicle with an IMU, found none"]
    answers = outside.say(command(interval, 193, 1e5))
    assert results(answers) == unsupported
    assert texts(answers) == ["EKF_STATUS_REPORT: it is ArduPilot's"]
    raw = mav.MAV_DATA_STREAM_RAW_SENSORS
    (text,) = texts(outside.say(mav.MAVLink_request_data_stream_message(1, 1, raw, 10, 1)))
    assert text.endswith(f"stream {raw} has no messages here")
    assert of("HIGHRES_IMU", outside.passes(1.0)) == []


async def test_a_failed_pose_is_not_judged() -> None:
    outside = Outside(vision=True)
    for quality in (-1, 0, 50):
        unknown = [math.nan] + [0.0] * 20
        outside.say(
            mav.MAVLink_odometry_message(
                0, 1, 12, 0, 0, 0, [1, 0, 0, 0], *[0.0] * 6, unknown, unknown, 0, 0, quality
            )
        )
    assert len(outside.seen) == 2
    outside.close()


@pytest.mark.slow
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(hostile(), min_size=1, max_size=8))
async def test_no_message_breaks_the_endpoint(data: list[bytes]) -> None:
    """Whatever comes, every act is a valid event, and the endpoint goes on."""
    outside = Outside(vision=True)
    try:
        outside.flies()
        outside.say(*data)
        outside.passes(0.2)
        assert results(outside.say(command(2500))) == [mav.MAV_RESULT_UNSUPPORTED]
        outside.passes(1.0)
        assert outside.endpoint._links.counts["messages"] >= 1
        assert outside.endpoint._links.counts["errors"] == 0
    finally:
        outside.close()
