"""Estimators that are bad, each in its own way, and a good one. They hear the truth."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable

from events import (
    Announcement,
    EstimatorAnnouncement,
    Image,
    PoseEstimate,
    Quaternion,
    Vector3,
)
from runtime import Input, Node, NodeConfig, Output
from tests.nodes.evaluation.flights import MS, SECOND, heading, place

Said = tuple[int, Vector3, Quaternion, str]
"""Stamp, position, orientation, frame."""


def good(stamp: int) -> list[Said]:
    x, y, z = place(stamp)
    wobble = 0.002 * math.sin(stamp / 1e8)
    return [(stamp, (x + wobble, y, z - wobble), heading(stamp), "map")]


def between(start: float, end: float) -> Callable[[int], list[Said]]:
    """Speak only in an interval (s)."""
    return lambda stamp: good(stamp) if start * SECOND <= stamp < end * SECOND else []


def moved(offset: Vector3, start: float, end: float) -> Callable[[int], list[Said]]:
    """Be off by a vector (m) in an interval (s)."""

    def say(stamp: int) -> list[Said]:
        ((_, p, q, frame),) = good(stamp)
        away = start * SECOND <= stamp < end * SECOND
        x, y, z = (a + b * away for a, b in zip(p, offset, strict=True))
        return [(stamp, (x, y, z), q, frame)]

    return say


def silent_for_four_seconds(stamp: int) -> list[Said]:
    return good(stamp) if not 4 * SECOND <= stamp < 8 * SECOND else []


def stamp_zero(stamp: int) -> list[Said]:
    return [(0, *good(0)[0][1:])]


def repeated_stamps(stamp: int) -> list[Said]:
    return good(stamp - stamp % (200 * MS))


def backwards(stamp: int) -> list[Said]:
    """The second of each pair first."""
    odd = round(stamp * 30 / SECOND) % 2
    return [*good(stamp), *good(stamp - SECOND // 30)] if odd else []


def future(stamp: int) -> list[Said]:
    return good(stamp + SECOND)


def twice(stamp: int) -> list[Said]:
    return [*good(stamp), *good(stamp)]


def not_a_number(stamp: int) -> list[Said]:
    ((_, _, q, frame),) = good(stamp)
    return [(stamp, (math.nan, 0.0, 0.0), q, frame)] if stamp > 5 * SECOND else good(stamp)


def no_rotation(stamp: int) -> list[Said]:
    ((_, p, _, frame),) = good(stamp)
    return [(stamp, p, (0.0, 0.0, 0.0, 0.0), frame)] if stamp > 5 * SECOND else good(stamp)


def frozen(stamp: int) -> list[Said]:
    return [(stamp, *good(min(stamp, 5 * SECOND))[0][1:])]


def wrong_frame(stamp: int) -> list[Said]:
    """East, north, up, and still called `map`."""
    ((_, (x, y, z), q, frame),) = good(stamp)
    return [(stamp, (y, x, -z), q, frame)]


def looks_north(stamp: int) -> list[Said]:
    """The right places, and never a turn."""
    return [(stamp, good(stamp)[0][1], (1.0, 0.0, 0.0, 0.0), "map")]


def scale_two(stamp: int) -> list[Said]:
    ((_, (x, y, z), q, frame),) = good(stamp)
    return [(stamp, (2 * x, 2 * y, 2 * z), q, frame)]


def restart(stamp: int) -> list[Said]:
    """From 6 s on in a frame of its own, which begins where it is then."""
    if stamp < 6 * SECOND:
        return good(stamp)
    return [(stamp, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), "odom_1")]


def unannounced_restart(stamp: int) -> list[Said]:
    """From 6 s on as if it were at the start again, and still called `map`."""
    return good(stamp) if stamp < 6 * SECOND else [(stamp, *good(stamp - 6 * SECOND)[0][1:])]


ZOO: dict[str, tuple[Callable[[int], list[Said]], str]] = {
    "silent_for_four_seconds": (silent_for_four_seconds, "lost_seconds"),
    "late_start": (between(2, 99), "lost_seconds"),
    "early_end": (between(0, 10), "lost_seconds"),
    "last_second_only": (between(11, 99), "coverage_percent"),
    "mute": (between(99, 99), "expected estimates, found none"),
    "stamp_zero": (stamp_zero, "repeated_stamps"),
    "repeated_stamps": (repeated_stamps, "repeated_stamps"),
    "backwards": (backwards, "repeated_stamps"),
    "future": (future, "future_stamps"),
    "twice": (twice, "repeated_stamps"),
    "not_a_number": (not_a_number, "lost_seconds"),
    "no_rotation": (no_rotation, "lost_seconds"),
    "frozen": (frozen, "ate_percent"),
    "jump": (moved((1.0, 0.0, 0.0), 5.0, 5.05), "ate_max_m"),
    "jump_that_stays": (moved((0.0, 0.5, 0.0), 6.0, 99.0), "ate_percent"),
    "wrong_frame": (wrong_frame, "ate_percent"),
    "looks_north": (looks_north, "rot_rmse_deg"),
    "scale_two": (scale_two, "ate_percent"),
    "restart": (restart, "restarts"),
    "unannounced_restart": (unannounced_restart, "ate_percent"),
    "ten_times_too_slow": (good, "frame_coverage_percent"),
}
"""Name to what it says of an image, and the threshold that must name it."""


class AnimalConfig(NodeConfig):
    """Which one."""

    kind: str


class Animal(Node[AnimalConfig]):
    """Says of each image what its kind says."""

    images = Input(Image, keep="latest")
    estimates = Output(PoseEstimate)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method=self.config.kind)

    async def run(self) -> None:
        kind = self.config.kind
        say = good if kind == "good" else ZOO[kind][0]
        async for image in self.images:
            await asyncio.sleep(0.2 if kind == "ten_times_too_slow" else 0.015)
            for stamp, position, orientation, frame in say(image.stamp):
                self.estimates.send(
                    PoseEstimate(
                        stamp=stamp,
                        source=self.name,
                        frame_id=frame,
                        position=position,
                        orientation=orientation,
                    )
                )
