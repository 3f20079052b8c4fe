"""Estimators that are bad, each in its own way, and good ones in all styles there are.

Each says something of one flight (`tests.nodes.judging.evaluation.flights`): what arrived, and
when.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, NamedTuple, ParamSpec

import numpy as np
from scipy.spatial.transform import Rotation

from events import Event, PoseEstimate, TrackingLost, TrackingRegained, TrajectoryEstimate
from runtime.host import RunEnd
from tests.nodes.judging.evaluation.flights import MS, SECOND, heading, place

SECONDS = 12
RATE = 30
FRAMES = [round(k * SECOND / RATE) for k in range(RATE * SECONDS)]
LATE = 55 * MS
"""From an image to its pose."""

Sent = list[tuple[int, Event]]
"""When it came (ns), and what."""
Later = Callable[[], Sent]
"""What makes it once it is asked for."""
Fields = dict[str, Any]
Change = Callable[[int, Fields], Fields | None]
"""From a stamp (ns) and a true pose to what is said of it; ``late`` is its latency (ns)."""


Given = ParamSpec("Given")


def later(make: Callable[Given, Sent]) -> Callable[Given, Later]:
    """Put off what takes time until its test runs: every process of the tests has all animals."""

    @wraps(make)
    def put_off(*args: Given.args, **kwargs: Given.kwargs) -> Later:
        return cache(partial(make, *args, **kwargs))

    return put_off


@later
def says(change: Change = lambda _, pose: pose, stamps: list[int] = FRAMES) -> Sent:
    """Return what an estimator sends that says this of each image."""
    sent: Sent = []
    for stamp in stamps:
        true = {"stamp": stamp, "frame_id": "map", "position": place(stamp)}
        said = change(stamp, true | {"orientation": heading(stamp), "late": LATE})
        if said is not None:
            late = said.pop("late")
            sent.append((stamp + late, PoseEstimate(source="est", **said)))
    return sorted(sent, key=lambda event: event[0])


def given(start: float, end: float = 99.0, **fields: Any) -> Change:
    """Say this instead in an interval (s)."""
    return lambda t, pose: pose | fields if start * SECOND <= t < end * SECOND else pose


def between(*times: tuple[float, float]) -> Change:
    """Speak only in intervals (s)."""
    return lambda t, p: p if any(a * SECOND <= t < b * SECOND for a, b in times) else None


def moved(by: Callable[[float], tuple[float, float, float]]) -> Change:
    """Be off by a vector (m) that depends on the time (s)."""
    return lambda t, p: p | {"position": tuple(np.add(p["position"], by(t / SECOND)).tolist())}


def mapped(matrix: Any) -> Change:
    """Say other places by a matrix."""
    return lambda _, p: p | {"position": tuple((np.array(matrix) @ p["position"]).tolist())}


def shown_at(when: Callable[[int], int]) -> Change:
    """Say the pose of another time (ns) than that of the stamp."""
    return lambda t, p: p | {"position": place(when(t)), "orientation": heading(when(t))}


def turned(by: Callable[[Rotation, float], Rotation]) -> Change:
    """Say other orientations."""

    def say(stamp: int, pose: Fields) -> Fields:
        true = Rotation.from_quat(pose["orientation"], scalar_first=True)
        said = by(true, stamp / SECOND).as_quat(scalar_first=True)
        return pose | {"orientation": tuple(said.tolist())}

    return say


def delayed(late: Callable[[int], int]) -> Change:
    """Come later than the image by a time (ns) that depends on it."""
    return lambda t, p: p | {"late": late(t)}


def elsewhere(scale: float = 1.0) -> Change:
    """Be right in a frame of its own."""
    turn = Rotation.from_euler("zyx", [40, 10, -5], degrees=True)

    def say(_: int, pose: Fields) -> Fields:
        there = scale * turn.apply(pose["position"]) + [7.0, -3.0, 1.0]
        true = Rotation.from_quat(pose["orientation"], scalar_first=True)
        looks = tuple((turn * true).as_quat(scalar_first=True).tolist())
        return pose | {"frame_id": "odom", "position": tuple(there.tolist()), "orientation": looks}

    return say


def noisy(sigma: float, seed: int = 1, **fields: Any) -> Change:
    """Be off at random (m)."""
    random = np.random.default_rng(seed)
    change = moved(lambda _: tuple(random.normal(0.0, sigma, 3).tolist()))
    return lambda t, p: change(t, p | fields) or {}


def covariance(position: float, orientation: float = 1e-6) -> tuple[float, ...]:
    """Return a covariance with these variances."""
    return tuple(np.diag([position] * 3 + [orientation] * 3).ravel().tolist())


def velocity(stamp: int) -> tuple[float, float, float]:
    ahead, behind = place(stamp + MS), place(stamp - MS)
    x, y, z = (np.subtract(ahead, behind) / 0.002).tolist()
    return x, y, z


def first(count: int, **fields: Any) -> Change:
    """Say something with the first poses only."""
    return lambda t, p: p | fields if t < FRAMES[count] else p


@later
def said_lost(stamp: int, at: int, regained: int = 0) -> Sent:
    """Return the word of having lost track, and of having it again (ns)."""
    sent: Sent = [(at, TrackingLost(stamp=stamp, source="est"))]
    return sent + [(regained, TrackingRegained(stamp=regained, source="est"))] * bool(regained)


@later
def merged(*parts: Later) -> Sent:
    return sorted((event for part in parts for event in part()), key=lambda event: event[0])


@later
def corrected(change: Change) -> Sent:
    """Return exact poses, and at the end a trajectory that says something else of all images."""
    poses = [event for _, event in says(change)() if isinstance(event, PoseEstimate)]
    whole = TrajectoryEstimate(
        stamp=FRAMES[-1],
        source="est",
        frame_id="map",
        stamps=np.array([pose.stamp for pose in poses]),
        positions=np.array([pose.position for pose in poses]),
        orientations=np.array([pose.orientation for pose in poses]),
    )
    return [*says()(), (SECONDS * SECOND, whole)]


@later
def by_pairs(stamps: list[int]) -> Sent:
    """The second of each pair of images first."""
    return [(stamps[k | 1] + LATE + k, says(stamps=[stamps[k ^ 1]])()[0][1]) for k in range(RATE)]


def ended(**how: Any) -> RunEnd:
    """Return how a run ended; if nothing else is said, at its planned end."""
    stamp, duration = (SECONDS * SECOND + 100 * MS, SECONDS + 0.1)
    usual: Fields = {
        "stamp": stamp,
        "reason": "duration",
        "by": "",
        "planned": True,
        "restarts": {},
    }
    return RunEnd(**(usual | {"duration": duration} | how))


EARLY = {"stamp": 3_100 * MS, "planned": False}


class Animal(NamedTuple):
    """One of the zoo.

    Attributes:
        sent: What it sends.
        default: What fails it where nothing is asked for, or one of several; "" for nothing.
        standard: What fails it by the thresholds of `config.toml`.
        strict: What fails it by `STRICT`.
        end: How the run ended.
        scale_free: Whether it has announced that its unit is its own.
        reads: What it has announced to read.
        rate: Images a second.
        asked: What it is asked for besides `STRICT`.
    """

    sent: Later
    default: str | tuple[str, ...] = ""
    standard: str = ""
    strict: str = ""
    end: RunEnd = ended()
    scale_free: bool = False
    reads: tuple[str, ...] = ()
    rate: int = RATE
    asked: Fields | None = None

    def telling(self) -> list[str]:
        """Return the beginnings of all reasons for which it fails."""
        default = [self.default] if isinstance(self.default, str) else self.default
        return [reason for reason in (*default, self.standard, self.strict) if reason]


def bad(sent: Later, default: str, standard: str = "", strict: str = "", **more: Any) -> Animal:
    """Return one that is failed at least by the same where more is asked for."""
    standard = standard or default
    return Animal(sent, default, standard, strict or standard, **more)


def inexact(
    sent: Later,
    standard: str,
    strict: str = "",
    default: str | tuple[str, ...] = "",
    **more: Any,
) -> Animal:
    """Return one that is failed by another figure, if by any, where nothing is asked for."""
    return Animal(sent, default, standard, strict or standard, **more)


STRICT = {
    "ate_percent": 0.2,
    "flight_ate_percent": 0.3,
    "ate_max_m": 0.06,
    "rot_rmse_deg": 0.5,
    "rpe_1m_trans_percent": 5.0,
    "lost_seconds": 0.0,
    "initialization_seconds": 0.45,
    "coverage_percent": 99.0,
    "frame_coverage_percent": 95.0,
    "latency_p99_ms": 130.0,
    "newest_pose_rmse_m": 0.2,
    "newest_pose_age_ms": 150.0,
    "not_causal": 0,
    "velocity_rmse_m_per_s": 0.05,
    "nees_position": 6.0,
    "within_3_sigma_percent": 98.0,
}

MOTION = "rpe_1m_trans_percent", "rot_rmse_deg"
"""Figures of motions seen from the body, which need orientations that are the body's."""

_random = np.random.default_rng(7)
_UP = (0.0, 0.0, 1.0)
_TEN = FRAMES[::3]

GOOD: dict[str, Animal] = {
    "exact": Animal(says()),
    "noisy by 5 mm": Animal(says(noisy(0.005))),
    "in odom": Animal(says(elsewhere())),
    "monocular": Animal(says(elsewhere(0.25)), scale_free=True),
    "starts after 0.4 s": Animal(says(between((0.4, 99)))),
    "camera of 10 Hz": Animal(says(stamps=_TEN), rate=10),
    "80 ms late, in a pipeline": Animal(says(delayed(lambda _: 120 * MS))),
    "unsteady": Animal(says(delayed(lambda _: int(_random.integers(45, 78)) * MS))),
    "consistent": Animal(says(noisy(0.01, covariance=covariance(1e-4)))),
    "with velocities": Animal(says(lambda t, p: p | {"velocity": velocity(t)})),
    "stamps through a double": Animal(says(lambda t, p: p | {"stamp": round(t, -3)})),
    "leaves out one image in 30": Animal(says(lambda t, p: p if FRAMES.index(t) % 30 else None)),
    "silent for 0.4 s": Animal(says(between((0, 5), (5.4, 99)))),
    "at the rate of an IMU": Animal(
        says(delayed(lambda _: 5 * MS), [*range(0, 12 * SECOND, 5 * MS)])
    ),
    "body of a name with a prefix": Animal(says(given(0, child_frame_id="drone/base_link"))),
    "corrects itself": Animal(corrected(lambda _, p: p)),
    "says that it reads the truth": Animal(
        says(), reads=("truth",), end=ended(truth_readers=frozenset({"est"}))
    ),
    "another reads the truth": Animal(says(), end=ended(truth_readers=frozenset({"map"}))),
    "the pilot has landed before": Animal(
        says(), end=ended(by="pilot", reason="landed", stamp=11 * SECOND)
    ),
    "another node was restarted": Animal(says(), end=ended(restarts={"map": 2})),
}
"""Failed by nothing."""

_HALF: Fields = {"position": (0.0, 0.0, -1.5), "orientation": (1.0, 0.0, 0.0, 0.0)}

BAD: dict[str, Animal] = {
    # Silence.
    "mute": bad(list, "expected estimates"),
    "silent for 4 s": bad(says(between((0, 4), (8, 99))), "coverage_percent"),
    "silent for 1 s": inexact(says(between((0, 4), (5, 99))), "lost_seconds"),
    "starts after 2 s": bad(says(between((2, 99))), "coverage_percent"),
    "starts after 0.6 s": inexact(
        says(between((0.6, 99))), "lost_seconds", "initialization_seconds"
    ),
    "ends after 10 s": bad(says(between((0, 10))), "coverage_percent"),
    "the last second only": bad(says(between((11, 99))), "coverage_percent"),
    "every tenth image": inexact(says(stamps=FRAMES[::10]), "frame_coverage_percent"),
    "speaks for a quarter of each second": bad(
        says(lambda t, p: p if t % SECOND < SECOND // 4 else None), "coverage_percent"
    ),
    "says that it is lost, and sends poses": bad(
        merged(says(), said_lost(4 * SECOND, 4 * SECOND, 8 * SECOND)), "coverage_percent"
    ),
    "is never found again": bad(
        merged(says(), said_lost(4 * SECOND, 4 * SECOND)), "coverage_percent"
    ),
    "lost in the year 2001": bad(
        merged(says(), said_lost(10**18, SECOND), said_lost(4 * SECOND, 4 * SECOND)),
        "future_stamps",
    ),
    # Stamps.
    "stamp zero": bad(says(given(0, stamp=0)), "repeated_stamps"),
    "repeats stamps": bad(says(lambda t, p: p | {"stamp": t - t % (200 * MS)}), "repeated_stamps"),
    "everything twice": bad(merged(says(), says()), "repeated_stamps"),
    "pairs in the wrong order": bad(by_pairs(FRAMES), "repeated_stamps"),
    "stamps of the future": bad(says(lambda t, p: p | {"stamp": t + SECOND}), "future_stamps"),
    "stamps of another clock": bad(
        says(lambda t, p: p | {"stamp": t - 1000 * SECOND}), "compared_percent"
    ),
    "stamped at its arrival": bad(
        says(lambda t, p: p | {"stamp": t + LATE}), "stamped_at_images_percent"
    ),
    "stamped at its arrival, and 2 ms on": bad(
        says(lambda t, p: p | {"stamp": t + LATE + 2 * MS}), "future_stamps"
    ),
    # Places.
    "frozen": inexact(
        says(shown_at(lambda t: min(t, 5 * SECOND))), "ate_percent", default="rot_rmse_deg"
    ),
    "always at the start": inexact(says(given(0, **_HALF)), "ate_percent", default=MOTION),
    "one jump": inexact(says(moved(lambda t: (1.0 * (5.0 < t < 5.04), 0, 0))), "ate_max_m"),
    "a jump that stays": inexact(says(moved(lambda t: (0, 0.5 * (t > 6), 0))), "ate_percent"),
    "another frame under the same name": inexact(
        says(mapped([[0, 1, 0], [1, 0, 0], [0, 0, -1]])),
        "ate_percent",
        default=MOTION,
    ),
    "mirrored": inexact(says(mapped(np.diag([1, -1, 1]))), "ate_percent", default=MOTION),
    "twice the scale": inexact(says(mapped(2 * np.eye(3))), "ate_percent", default=MOTION),
    "5 % of scale": inexact(says(mapped(1.05 * np.eye(3))), "ate_percent"),
    "drift": inexact(
        says(moved(lambda t: (0.02 * t, 0, 0))),
        "ate_percent",
        "end_error_percent",
        asked={"end_error_percent": 1.0},
    ),
    "sinks": inexact(
        says(moved(lambda t: (0, 0, 0.02 * t))),
        "ate_percent",
        "ate_rmse_m",
        asked={"ate_rmse_m": 0.1},
    ),
    "noisy by 0.2 m": inexact(says(noisy(0.2)), "ate_percent"),
    "jitters by 3 cm": inexact(says(noisy(0.03)), "ate_percent", "rpe_1m_trans_percent"),
    "steps of half a metre": inexact(
        says(lambda _, p: p | {"position": tuple(round(2 * x) / 2 for x in p["position"])}),
        "ate_percent",
    ),
    "diverges": inexact(
        says(moved(lambda t: (math.exp(t - 9), 0, 0))), "ate_max_m", default=MOTION
    ),
    "poses of 0.2 s ago under new stamps": inexact(
        says(shown_at(lambda t: t - 200 * MS)), "ate_percent"
    ),
    "poses of 0.2 s ahead": inexact(says(shown_at(lambda t: t + 200 * MS)), "ate_percent"),
    "a new map under the old name": inexact(
        says(shown_at(lambda t: t % (6 * SECOND))), "ate_percent", default=MOTION
    ),
    "garbage between images": inexact(
        says(
            lambda t, p: p if t % 5 else p | _HALF,
            sorted([*FRAMES, *(t + 15 * MS - t % 5 for t in FRAMES)]),
        ),
        "ate_percent",
        "flight_ate_percent",
        default="rot_rmse_deg",
    ),
    "garbage at images, the truth 1 ns later": inexact(
        says(
            lambda t, p: p | _HALF if t in FRAMES else p,
            sorted([*FRAMES, *(t + 1 for t in FRAMES)]),
        ),
        "ate_percent",
        "flight_ate_percent",
        default="rot_rmse_deg",
    ),
    "monocular, the scale drifts": inexact(
        says(lambda t, p: p | {"position": tuple((1 + t / 12e9) * x for x in p["position"])}),
        "ate_percent",
        scale_free=True,
    ),
    "a wrong loop closure at the end": inexact(
        corrected(moved(lambda t: (0.1 * t, 0, 0))),
        "",
        "final_ate_percent",
        asked={"final_ate_percent": 0.5},
    ),
    # Orientations.
    "never turns": inexact(
        says(given(0, orientation=(1.0, 0.0, 0.0, 0.0))), "rot_rmse_deg", default="rot_rmse_deg"
    ),
    "looks back": inexact(
        says(turned(lambda r, _: r * Rotation.from_rotvec([0, 0, math.pi]))),
        "rot_rmse_deg",
        default="rot_rmse_deg",
    ),
    "inverse orientations": inexact(
        says(turned(lambda r, _: r.inv())), "rot_rmse_deg", default="rot_rmse_deg"
    ),
    "scalar last": inexact(
        says(lambda _, p: p | {"orientation": (*p["orientation"][1:], p["orientation"][0])}),
        "rot_rmse_deg",
        default="rot_rmse_deg",
    ),
    "rolls": inexact(
        says(turned(lambda r, t: r * Rotation.from_rotvec([0.01 * t, 0, 0]))),
        "rot_rmse_deg",
        "rpe_1m_rot_deg_per_m",
        asked={"rpe_1m_rot_deg_per_m": 0.3},
    ),
    "the first pose of another origin": inexact(
        says(lambda t, p: elsewhere()(t, p) if t else p | {"frame_id": "odom"}),
        "ate_percent",
        default="rot_rmse_deg",
    ),
    # Frames.
    "begins anew": bad(says(given(6, frame_id="odom_1", **_HALF)), "restarts"),
    "between two frames": bad(
        says(lambda t, p: p | {"frame_id": "map" if t % (2 * SECOND) < SECOND else "odom"}),
        "restarts",
    ),
    "the camera's poses": bad(says(given(0, child_frame_id="camera")), "other_bodies"),
    # Causes.
    "0.4 s of later images": inexact(
        says(delayed(lambda _: 400 * MS)),
        "latency_p99_ms",
        "not_causal",
        default="not_causal_percent",
    ),
    "1 s of later images": inexact(
        says(delayed(lambda _: SECOND)),
        "newest_pose_rmse_m",
        "not_causal",
        default="not_causal_percent",
    ),
    "after the flight": inexact(
        says(delayed(lambda t: SECONDS * SECOND - t)),
        "latency_p99_ms",
        "not_causal",
        default="not_causal_percent",
    ),
    "later and later": inexact(
        says(delayed(lambda t: LATE + t // 20)),
        "latency_p99_ms",
        "not_causal",
        default="not_causal_percent",
    ),
    "in heaps of a second": inexact(
        says(delayed(lambda t: SECOND - t % SECOND + LATE)),
        "latency_p99_ms",
        "not_causal",
        default="not_causal_percent",
    ),
    "twice a second, all at once": inexact(
        says(delayed(lambda t: SECOND // 2 - t % (SECOND // 2) + LATE)),
        "latency_p99_ms",
        "newest_pose_age_ms",
        default="not_causal_percent",
    ),
    # Covariances and velocities.
    "covariances of zero": bad(says(given(0, covariance=(0.0,) * 36)), "covariance_invalid"),
    "negative covariances": bad(says(given(0, covariance=covariance(-1e-4))), "covariance_invalid"),
    "covariances that are not symmetric": bad(
        says(given(0, covariance=(1.0, 0.5, *covariance(1.0)[2:]))), "covariance_invalid"
    ),
    "covariances of another order": bad(
        says(given(0, covariance=(1e-4,) * 36)), "covariance_invalid"
    ),
    "covariances of the first 19": bad(
        says(first(19, covariance=covariance(1e-4))), "covariances_percent"
    ),
    "covariances of a kilometre": bad(
        says(given(0, covariance=covariance(1e6))), "covariance_too_large_percent"
    ),
    "covariances where it is good": bad(
        says(
            lambda t, p: (
                noisy(0.1) if t % SECOND < SECOND // 3 else noisy(0.01, covariance=covariance(1e-4))
            )(t, p)
        ),
        "covariances_percent",
    ),
    "overconfident": inexact(
        says(noisy(0.01, covariance=covariance(1e-7))),
        "nees_position",
        "within_3_sigma_percent",
        default="nees_position",
    ),
    "velocity of 99 m/s": inexact(
        says(given(0, velocity=(99.0, 0.0, 0.0))),
        "velocity_rmse_m_per_s",
        default="velocity_error_percent",
    ),
    "velocity of the body": inexact(
        says(given(0, velocity=(1.26, 0.0, 0.0))),
        "velocity_rmse_m_per_s",
        default="velocity_error_percent",
    ),
    "velocities of the first 19": bad(
        says(lambda t, p: first(19, velocity=velocity(t))(t, p)), "velocities_percent"
    ),
    # Ends.
    "stops the run": bad(
        says(between((0, 3))), "early_end_seconds", end=ended(by="est", reason="dark", **EARLY)
    ),
    "stops it from below": bad(
        says(between((0, 3))), "coverage_percent", end=ended(by="est/net", reason="dark", **EARLY)
    ),
    "asks for it where no end is planned": bad(
        says(),
        "early_end_seconds",
        end=ended(by="est", reason="dark", planned=False, duration=None),
    ),
    "crashes": bad(
        says(between((0, 3))),
        "ended_by",
        end=ended(by="est", error="SVD did not converge", **EARLY),
    ),
    "beside one that crashes": bad(
        says(between((0, 3))),
        "early_end_seconds",
        end=ended(by="other", error="SVD did not converge", **EARLY),
    ),
    "reads the truth in silence": bad(
        says(), "reads_truth", end=ended(truth_readers=frozenset({"est"}))
    ),
    "restarts as a node": bad(says(), "restarts", end=ended(restarts={"est": 1})),
}
"""Name to what fails it."""
