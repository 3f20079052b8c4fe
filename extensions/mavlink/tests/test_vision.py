"""Poses from outside: their stamps, velocities and differences, and what is said of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import common as mav

from extensions.mavlink.tests.outside import SECOND, Outside, Program, texts
from visnav_mavlink.settings import MavlinkConfig

NAN = math.nan
FRAME = SECOND // 30
EAST = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A body whose nose points east."""


@pytest.fixture
async def seeing() -> Any:
    made = Outside(vision=True)
    made.now = 100 * SECOND
    yield made
    made.close()


def odometry(
    stamp: int,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (NAN, NAN, NAN),
    frames: tuple[int, int] = (mav.MAV_FRAME_LOCAL_FRD, mav.MAV_FRAME_BODY_FRD),
    q: tuple[float, ...] = EAST,
    quality: int = 0,
) -> Any:
    unknown = [NAN] + [0.0] * 20
    return mav.MAVLink_odometry_message(
        stamp // 1000, *frames, *position, list(q), *velocity, 0, 0, 0, unknown, unknown, 0, 0,
        quality,
    )  # fmt: skip


def pose(stamp: int) -> Any:
    return mav.MAVLink_vision_position_estimate_message(stamp // 1000, *[0.0] * 6, [0.0] * 21, 0)


def speed(stamp: int, *velocity: float) -> Any:
    return mav.MAVLink_vision_speed_estimate_message(stamp // 1000, *velocity, [0.0] * 9, 0)


def test_a_delay_is_a_short_duration() -> None:
    """A number of milliseconds, as PX4 has it, is refused rather than taken for seconds."""
    from runtime.testing import spec
    from visnav_mavlink import Mavlink

    assert MavlinkConfig().delay == 0.0
    with pytest.raises(Exception, match=r'did you mean "60ms"'):
        spec(Mavlink, "vision", {"delay": 60}).config  # noqa: B018


@pytest.mark.parametrize("behind", [0.0, 8.0])
async def test_a_delay_is_taken_off_each_stamp(behind: float) -> None:
    """Also off those that are corrected: then all of a constant latency is known."""
    late, offset = 60_000_000, round(behind * SECOND)
    outside = Outside(vision=True, delay=late / SECOND)
    outside.now = 100 * SECOND
    for number in range(3):
        taken = 100 * SECOND + number * FRAME
        outside.now = taken + late
        outside.say(pose(taken - offset))
        expected = taken if offset else taken - late
        assert outside.seen[-1]["stamp"] == pytest.approx(expected, abs=1e3)
    outside.close()


async def test_no_pose_is_stamped_before_an_earlier_one(seeing: Outside) -> None:
    """When a quicker message shows that those before were late; a sender's own repeats stay."""
    start, offset = seeing.now, 8 * SECOND
    for number, latency in enumerate((0.2, 0.2, 0.02, 0.02, 0.02, 0.02, 0.02)):
        taken = start + number * FRAME
        seeing.now = taken + round(latency * SECOND)
        seeing.say(pose(taken - offset))
    stamps = [seen["stamp"] - start for seen in seeing.seen]
    late = [0.2, FRAME / SECOND + 0.2, *(number * FRAME / SECOND + 0.02 for number in (7, 8))]
    assert stamps[:2] == pytest.approx([round(s * SECOND) for s in late[:2]], abs=1e3)
    assert stamps == sorted(stamps)
    assert len(stamps) == 2
    for number in (7, 8, 8):
        seeing.now = start + number * FRAME + SECOND // 50
        seeing.say(pose(start + number * FRAME - offset))
    stamps = [seen["stamp"] - start for seen in seeing.seen]
    assert stamps[2:] == pytest.approx([round(s * SECOND) for s in [*late[2:], late[3]]], abs=1e3)
    assert seeing.endpoint.finish() == (
        "5 poses taken (5 restamped), 5 refused: 5 restamped to before the last"
    )


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ((mav.MAV_FRAME_LOCAL_FRD, mav.MAV_FRAME_BODY_FRD), (-2.0, 1.0, 3.0)),
        ((mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_NED), (-2.0, 1.0, 3.0)),
        ((mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_NED), (1.0, 2.0, 3.0)),
        ((mav.MAV_FRAME_LOCAL_FRD, mav.MAV_FRAME_LOCAL_FRD), (1.0, 2.0, 3.0)),
    ],
)
async def test_velocities_are_in_the_frame_of_the_pose(
    seeing: Outside, frames: tuple[int, int], expected: tuple[float, ...]
) -> None:
    before = seeing.now - FRAME
    assert seeing.say(odometry(before, velocity=(1.0, 2.0, 3.0), frames=frames)) == []
    assert seeing.seen[-1]["velocity"] == pytest.approx(expected)
    seeing.say(odometry(seeing.now, velocity=(1.0, NAN, 3.0), frames=frames))
    assert seeing.seen[-1]["velocity"] is None


async def test_a_velocity_of_an_unknown_frame_is_left_out_and_its_pose_is_not(
    seeing: Outside,
) -> None:
    frames = mav.MAV_FRAME_LOCAL_FRD, mav.MAV_FRAME_LOCAL_NED
    answers = seeing.say(*[odometry(seeing.now, velocity=(1.0, 0.0, 0.0), frames=frames)] * 2)
    assert texts(answers) == [
        "velocity in ODOMETRY of 245/190 has no effect: expected child_frame_id BODY_FRD or "
        "LOCAL_FRD, found 1"
    ]
    assert [seen["velocity"] for seen in seeing.seen] == [None, None]


async def test_velocities_that_stay_zero_are_told_from_those_of_a_hover(seeing: Outside) -> None:
    still = (0.0, 0.0, 0.0)
    assert texts(seeing.say(odometry(seeing.now, velocity=still))) == []
    assert texts(seeing.say(odometry(seeing.now, (0.9, 0.0, 0.0), still))) == []
    (text,) = texts(seeing.say(*[odometry(seeing.now, (1.1, 0.0, 0.0), still)] * 2))
    assert text == (
        "velocity in ODOMETRY of 245/190 is zero while it moves, and so judged: "
        "send NaN if it is unknown"
    )
    other = Outside(vision=True)
    other.say(odometry(other.now, velocity=(0.1, 0.0, 0.0)))
    assert texts(other.say(odometry(other.now, (5.0, 0.0, 0.0), still))) == []
    other.close()


async def test_speeds_are_joined_to_the_poses_of_their_stamp(seeing: Outside) -> None:
    """In whatever order both come; the first pose cannot know that a speed will."""
    stamps = [seeing.now + number * FRAME for number in range(6)]
    for number, stamp in enumerate(stamps):
        seeing.now = stamp
        both = pose(stamp), speed(stamp, 1.0, float(number), 0.0)
        assert seeing.say(*(both if number < 4 else reversed(both))) == []
    velocities = [seen["velocity"] for seen in seeing.seen]
    assert velocities == [None, *((1.0, float(number), 0.0) for number in range(1, 6))]
    assert [seen["stamp"] // 1000 for seen in seeing.seen] == [stamp // 1000 for stamp in stamps]


async def test_poses_do_not_wait_for_speeds_that_do_not_come(seeing: Outside) -> None:
    seeing.say(pose(seeing.now), speed(seeing.now, 1.0, 0.0, 0.0))
    seeing.now += FRAME
    seeing.say(pose(seeing.now))
    assert len(seeing.seen) == 1
    seeing.passes(0.03)
    assert [seen["velocity"] for seen in seeing.seen] == [None, None]
    seeing.say(pose(seeing.now), pose(seeing.now + FRAME))
    assert len(seeing.seen) == 3
    seeing.passes(1.1)
    assert len(seeing.seen) == 4
    seeing.say(pose(seeing.now))
    assert len(seeing.seen) == 5


async def test_speeds_alone_are_told_what_they_lack(seeing: Outside) -> None:
    for number in range(3):
        answers = seeing.say(speed(seeing.now + number * FRAME, 1.0, 0.0, 0.0))
        assert [text[-69:] for text in texts(answers)] == [
            "beside it, such as VISION_POSITION_ESTIMATE; ODOMETRY has both in one"
        ] * (number == 1)
    (text,) = texts(seeing.say(speed(seeing.now, NAN, 0.0, 0.0)))
    assert text.endswith("its numbers are none; others are judged")
    assert seeing.seen == []
    assert seeing.endpoint.finish() == "0 poses taken; 2 speeds without a pose"


class Camera:
    """Differences of a body that flies a circle about the origin, its nose along the path."""

    def __init__(self, outside: Outside, program: Program | None = None) -> None:
        self.outside, self.stamp = outside, outside.now
        self._parser = ardupilotmega.MAVLink(None, 245, 190)
        self._parser.signing = (program or outside).parser.signing

    def look(self, turn: float = 0.1, way: float = 0.2, wrong: float = 0.0) -> list[Any]:
        """Send the difference since the image before, radians and metres."""
        self.outside.now = self.stamp = self.stamp + FRAME
        # A chord lies half a turn before the new heading, in whose axes it is given.
        chord = [way * math.cos(turn / 2), -way * math.sin(turn / 2), wrong]
        message = ardupilotmega.MAVLink_vision_position_delta_message(
            self.stamp // 1000, FRAME // 1000, [0.0, 0.0, turn], chord, 90.0
        )
        return self.outside.say(message.pack(self._parser))


async def test_differences_are_added_up_to_poses(seeing: Outside) -> None:
    camera = Camera(seeing)
    for _ in range(64):
        assert camera.look(math.tau / 64) == []
    # The first one's image is the origin.
    assert len(seeing.seen) == 63
    camera.look(math.tau / 64)
    assert seeing.seen[-1]["position"] == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)
    half = seeing.seen[31]
    radius = 0.2 / 2 / math.sin(math.pi / 64)
    assert math.hypot(*half["position"]) == pytest.approx(2 * radius, rel=1e-4)
    assert half["position"][1] > 0  # to the right
    assert half["orientation"] == pytest.approx((0.0, 0.0, 0.0, 1.0), abs=1e-4)
    assert {seen["frame_id"] for seen in seeing.seen} == {"odom"}
    assert half["stamp"] == pytest.approx(100 * SECOND + 33 * FRAME, abs=1e3)


async def test_a_missing_difference_begins_another_frame(seeing: Outside) -> None:
    camera = Camera(seeing)
    for _ in range(3):
        camera.look()
    camera.stamp += FRAME
    (text,) = texts(camera.look())
    assert text.endswith("a difference before it is missing: those after it are in another frame")
    camera.look()
    assert [seen["frame_id"] for seen in seeing.seen] == ["odom", "odom", "odom_1"]
    assert math.hypot(*seeing.seen[-1]["position"]) == pytest.approx(0.2)


async def test_differences_beside_poses_and_broken_ones_are_not_added_up(seeing: Outside) -> None:
    camera = Camera(seeing)
    camera.look()
    (text,) = texts(camera.look(wrong=NAN))
    assert text.endswith("its numbers are none; others are judged")
    seeing.say(pose(seeing.now))
    (text,) = texts(camera.look())
    assert text.endswith("poses of its sender are judged instead")
    message = ardupilotmega.MAVLink_vision_position_delta_message(1, 1, [0.0] * 3, [0.0] * 3, 0)
    broken = bytearray(message.pack(ardupilotmega.MAVLink(None, 245, 190)))
    broken[-1] ^= 1
    assert seeing.say(bytes(broken)) == []
    assert seeing.endpoint._links.counts["pieces of garbage"] == 1
    assert len(seeing.seen) == 1


async def test_differences_have_to_be_signed_as_all_else() -> None:
    outside = Outside(vision=True, signing_key="5a" * 32)
    camera, other = Camera(outside), Camera(outside, stranger := Program())
    for _ in range(3):
        other.look()
    assert outside.seen == []
    for _ in range(3):
        camera.look()
    assert len(outside.seen) == 2
    stranger.close()
    outside.close()


def refused(now: int) -> Iterator[Any]:
    """Yield messages that are not taken."""
    yield from [odometry(now, quality=-1)] * 3
    yield from [odometry(now, (NAN, 0.0, 0.0))] * 2
    yield odometry(now, frames=(mav.MAV_FRAME_GLOBAL, mav.MAV_FRAME_BODY_FRD))


async def test_the_end_is_told_how_many_poses_were_taken(caplog: pytest.LogCaptureFixture) -> None:
    outside = Outside(vision=True, delay=0.06)
    outside.now = 100 * SECOND
    outside.say(odometry(outside.now - 8 * SECOND, velocity=(1.0, 0.0, 0.0)))
    outside.now += FRAME
    outside.say(odometry(outside.now - 8 * SECOND), *refused(outside.now))
    outside.parser = mav.MAVLink(None, 2, 1)
    outside.say(pose(outside.now))
    with caplog.at_level("INFO"):
        sentence = outside.endpoint.finish()
    assert sentence == (
        "2 poses taken (2 restamped, each 60 ms earlier by delay, 1 with a velocity), "
        "7 refused: 3 quality, 2 not a number, 1 frame_id, 1 another vehicle"
    )
    assert texts(outside.hear()) == [sentence]
    assert caplog.messages[-1] == sentence
    assert caplog.records[-1].levelname == "WARNING"
    outside.close()


async def test_a_pose_that_waits_at_the_end_is_published(seeing: Outside) -> None:
    seeing.say(pose(seeing.now), speed(seeing.now, 1.0, 0.0, 0.0), pose(seeing.now - 1000))
    assert len(seeing.seen) == 1
    assert seeing.endpoint.finish() == "2 poses taken"
    assert len(seeing.seen) == 2


async def test_nothing_is_counted_where_no_poses_are_wanted() -> None:
    outside = Outside()
    (text,) = texts(Camera(outside).look())
    assert text == "VISION_POSITION_DELTA of 245/190 has no effect: vision is false"
    assert outside.endpoint.finish() == ""
    assert outside.hear() == []
    outside.close()
