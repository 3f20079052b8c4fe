"""What every estimator must pass: `refusals` without a flight, and `faults` of one.

A `Case` says how an estimator is run; `fly` lets it fly `tests.nodes.estimators.flight`, and
`faults` returns in a sentence each what it did that no estimator may do.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest

from events import (
    EstimatorAnnouncement,
    Event,
    PoseEstimate,
    TrackingEvent,
    TrackingLost,
    TrackingRegained,
    TrajectoryEstimate,
)
from events.camera_info import COEFFICIENTS
from events.geometry import pose_matrix
from nodes.estimators import Estimator, EstimatorConfig
from nodes.judging.evaluation.alignment import umeyama
from runtime import Node, on
from runtime.errors import VisnavError
from runtime.node import make_node
from runtime.testing import run_nodes, spec
from tests.nodes.estimators.flight import GOOD, SCRIPT, Flight, announcements, fly
from tests.runtime.small_events import NoHost


class Case(NamedTuple):
    """An estimator that is to be tested.

    Attributes:
        node: Its class.
        settings: Its settings, as they would stand in the file.
        begins: Good images, standing ones included, after which it must have said a pose.
        tolerance: Metres by which a pose may be off in the 1.5 m up to the white image, after the
            alignment that its frame asks for.
        maps: Whether it begins another map after a loss, in a frame of its own.
        width: Of the images, pixels.
        script: What becomes of the images; see `tests.nodes.estimators.flight.SCRIPT`.
        worker: Whether its tracker needs a process of its own in every test; those that do not
            run in the tests' process, which saves the seconds in which Python starts.
        built: Returns more settings, with what is built for the test.
        needs: Module without which it is not tested.
        slow: Whether its flight is for the slow suite.
    """

    node: type[Estimator[Any]]
    settings: Mapping[str, Any] = MappingProxyType({})
    begins: int = 2
    tolerance: float = 0.05
    maps: bool = False
    width: int = 240
    script: str = SCRIPT
    worker: bool = False
    built: Callable[[], Mapping[str, Any]] = dict
    needs: str = ""
    slow: bool = False

    def announced(self) -> EstimatorAnnouncement:
        """Return what it announces, without starting anything."""
        made = make_node(self.node, "est", spec(self.node, "est", self.settings).config, NoHost())
        said = list(made.announce())
        assert len(said) == 1, f"expected one announcement, found {said}"
        assert isinstance(said[0], EstimatorAnnouncement)
        return said[0]

    def flight(self) -> Flight:
        """Return the flight of the rig that it announces to read."""
        said = self.announced()
        return fly(said.reads, said.eyes, self.width, self.script)


class Record(NamedTuple):
    """A flight, and what came of it.

    Attributes:
        flight: The flight.
        said: The estimator's announcement.
        sent: All that it sent, in order.
        heard_at: When on the clock each of the poses in `sent` came (ns).
        latency: That it declares (ns).
        reason: What ended the run.
    """

    flight: Flight
    said: EstimatorAnnouncement
    sent: list[Event]
    heard_at: list[int]
    latency: int
    reason: str

    def of(self, *kinds: type[Event]) -> list[Any]:
        """Return what is of one of these types, in order."""
        return [event for event in self.sent if isinstance(event, kinds)]

    def outcome(self) -> bytes:
        """Return what must be the same for the same input."""
        told = (PoseEstimate, TrackingEvent, TrajectoryEstimate)
        return b"\n".join(repr(event).encode() for event in self.of(*told))


class InProcess:
    """Takes a worker's place: its object in the tests' process, its results as late."""

    def __init__(self, clock: Any, made: Any, latency: float) -> None:
        self._clock, self._made, self._latency = clock, made, round(latency * 1e9)

    async def call(self, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a method of the object, and return its result once its latency has passed."""
        work: concurrent.futures.Future[Any] = concurrent.futures.Future()
        try:
            work.set_result(getattr(self._made, method.__name__)(*args, **kwargs))
        except Exception as error:  # as a worker hands it on
            work.set_exception(error)
        return await self._clock.beside(work, self._latency)


async def in_process(node: Node[Any], factory: Any, *args: Any, **options: Any) -> Any:
    """Take the place of `Node.worker`."""
    made = factory(*args)
    if hasattr(made, "close"):
        MADE.callback(made.close)
    return InProcess(node.clock, made, options.get("latency", 0.0))


MADE = contextlib.ExitStack()
"""Closes the objects of a run, as their processes would."""


class Ears(Node):
    """Notes when poses come (ns)."""

    heard: ClassVar[list[int]] = []

    @on(PoseEstimate)
    def hear(self, event: PoseEstimate) -> None:
        self.heard.append(self.clock.now())


def run(case: Case, flight: Flight | None = None) -> Record:
    """Have an estimator fly."""
    if case.needs:
        pytest.importorskip(case.needs)
    flight = flight or case.flight()
    Ears.heard.clear()
    with pytest.MonkeyPatch.context() as patch, MADE:
        if not case.worker:
            patch.setattr(Node, "worker", in_process)
        node = spec(case.node, "est", {**case.settings, **case.built()})
        result = run_nodes(
            [node, spec(Ears, "ears")], inputs=flight.events, duration=flight.seconds
        )
    assert isinstance(node.config, EstimatorConfig)
    latency = round(node.config.latency * 1e9)
    (said,) = result.of(EstimatorAnnouncement)
    return Record(flight, said, result.sent, [*Ears.heard], latency, result.reason)


# Refusals.


class Lack(NamedTuple):
    """A rig in which something is missing: what is announced, and what for."""

    name: str
    events: list[Event]


def lacks(case: Case) -> list[Lack]:
    """Return the rigs that an estimator must refuse."""
    said = case.announced()
    kinds = [kind for kind in said.reads if kind != "imu"]
    lacking = [Lack("any camera", announcements(said.reads, 0))]
    for kind in kinds:
        others = tuple(other for other in said.reads if other != kind)
        if {*others} - {"imu"}:
            lacking.append(Lack(kind, announcements(others, said.eyes)))
        else:
            lacking.append(Lack(kind, announcements(("segmentation", *others), said.eyes)))
    if said.eyes == 2:
        lacking.append(Lack("the right eye", announcements(said.reads, 1)))
    if "imu" in said.reads:
        lacking.append(Lack("the IMU", announcements(tuple(kinds), said.eyes)))
    for model, count in COEFFICIENTS.items():
        if model not in said.lenses:
            lens = model, (-0.1, 0.01, *(0.0,) * (count - 2))
            lacking.append(
                Lack(f"a lens without {model}", announcements(said.reads, said.eyes, lens=lens))
            )
    return lacking


def refusal_faults(case: Case, lack: Lack) -> Iterator[str]:
    """Return what is wrong with how an estimator refuses a rig."""
    try:
        settings = {**case.settings, **case.built(), "rectify": False}
        run_nodes([spec(case.node, "est", settings)], inputs=lack.events, duration=0.2)
    except VisnavError as error:
        message = str(error)
        if "expected" not in message or "found" not in message:
            yield f"its error has neither what was expected nor what was found: {message}"
        if "\n" in message or "Traceback" in message:
            yield f"its error is no sentence: {message}"
        if "est" not in message:
            yield f"its error does not name the node: {message}"
    else:
        yield "it is not refused"


# What is wrong with a flight.


def faults(record: Record, case: Case) -> list[str]:
    """Return all that an estimator did and may not do."""
    return [f"{check.__name__}: {fault}" for check in CHECKS for fault in check(record, case)]


def announces_what_it_reads(record: Record, case: Case) -> Iterator[str]:
    said = record.said
    if not said.method:
        yield "no method"
    if not {*said.reads} & {"grey", "rgb"} or {*said.reads} - {"grey", "rgb", "depth", "imu"}:
        yield f"reads {said.reads}"
    if said.eyes not in {1, 2}:
        yield f"{said.eyes} eyes"
    if unknown := {*said.lenses} - {*COEFFICIENTS}:
        yield f"unknown lenses {unknown}"


def ends_in_time(record: Record, case: Case) -> Iterator[str]:
    if record.reason != "duration":
        yield f"the run ended by {record.reason}"


def says_nothing_before_it_knows(record: Record, case: Case) -> Iterator[str]:
    kinds = record.flight.kinds
    first_good = min(stamp for stamp, kind in kinds.items() if kind in GOOD)
    for pose in record.of(PoseEstimate):
        if pose.stamp < first_good:
            yield f"a pose from an image of kind {kinds.get(pose.stamp)!r} at {pose.stamp / 1e9} s"


def begins(record: Record, case: Case) -> Iterator[str]:
    good = [stamp for stamp, kind in record.flight.kinds.items() if kind in GOOD]
    poses = record.of(PoseEstimate)
    if not poses:
        yield "no pose at all"
    elif poses[0].stamp > good[case.begins - 1]:
        late = good[case.begins - 1] / 1e9
        yield f"its first pose is of {poses[0].stamp / 1e9} s, not up to {late} s"


def gives_a_pose_for_each_good_image(record: Record, case: Case) -> Iterator[str]:
    """Until it is dark; what happens after a loss is for the next checks."""
    poses = {pose.stamp for pose in record.of(PoseEstimate)}
    for stamp in _undisturbed(record):
        if (
            poses
            and min(poses) < stamp
            and record.flight.kinds[stamp] in GOOD
            and stamp not in poses
        ):
            yield f"no pose for the image of {stamp / 1e9} s"


def is_as_late_as_declared(record: Record, case: Case) -> Iterator[str]:
    for pose, heard in zip(record.of(PoseEstimate), record.heard_at, strict=True):
        if not 0 <= heard - pose.stamp <= record.latency:
            yield f"the pose of {pose.stamp / 1e9} s came {(heard - pose.stamp) / 1e6} ms later"


def says_poses_in_order(record: Record, case: Case) -> Iterator[str]:
    stamps = [pose.stamp for pose in record.of(PoseEstimate)]
    for before, after in itertools.pairwise(stamps):
        if after <= before:
            yield f"a pose of {after / 1e9} s after one of {before / 1e9} s"
    for stamp in stamps:
        if stamp not in record.flight.kinds:
            yield f"a pose of {stamp} ns, when there was no image"


def says_sound_poses(record: Record, case: Case) -> Iterator[str]:
    for pose in record.of(PoseEstimate):
        if not np.isfinite([*pose.position, *pose.orientation]).all():
            yield f"{pose}"
        elif abs(np.linalg.norm(pose.orientation) - 1) > 1e-6:
            yield f"no unit quaternion: {pose.orientation}"
        if pose.covariance:
            covariance = np.reshape(pose.covariance, (6, 6))
            if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] < -1e-9:
                yield f"no covariance: {covariance}"


def stays_in_one_frame(record: Record, case: Case) -> Iterator[str]:
    """Unless it begins another map after a loss, which is told before its first pose."""
    before: PoseEstimate | None = None
    lost = False
    for event in record.of(PoseEstimate, TrackingEvent):
        if isinstance(event, TrackingEvent):
            lost = lost or isinstance(event, TrackingLost)
            continue
        if event.frame_id == "map" and record.said.scale_free:
            yield "in map, in a unit of length of its own"
        if before is not None and event.child_frame_id != before.child_frame_id:
            yield f"of {event.child_frame_id} after one of {before.child_frame_id}"
        if before is not None and event.frame_id != before.frame_id and not (case.maps and lost):
            yield f"in {event.frame_id} after one in {before.frame_id}"
        before, lost = event, False


def marks_loss(record: Record, case: Case) -> Iterator[str]:
    """In the dark it is lost, unless it has an IMU to go by; between loss and return no pose."""
    dark = [stamp for stamp, kind in record.flight.kinds.items() if kind == "b"][3:]
    lost = False
    lost_at = []
    for event in record.of(PoseEstimate, TrackingEvent):
        if isinstance(event, TrackingLost):
            if lost:
                yield f"lost twice, at {event.stamp / 1e9} s"
            lost = True
            lost_at.append(event.stamp)
            if not event.reason:
                yield f"lost at {event.stamp / 1e9} s without a reason"
        elif isinstance(event, TrackingRegained):
            if not lost:
                yield f"regained at {event.stamp / 1e9} s, and was not lost"
            lost = False
        elif lost:
            yield f"a pose of {event.stamp / 1e9} s while it was lost"
    if "imu" not in record.said.reads:
        poses = {pose.stamp for pose in record.of(PoseEstimate)}
        if not any(dark[0] <= stamp <= dark[-1] for stamp in lost_at):
            yield "it was not lost in the dark"
        if poses & {*dark}:
            yield f"poses in the dark: {sorted(poses & {*dark})}"


def never_lies(record: Record, case: Case) -> Iterator[str]:
    """Until the image is frozen, which nobody can know: each pose is near the truth."""
    frozen = min(stamp for stamp, kind in record.flight.kinds.items() if kind == "z")
    known = record.flight.truth
    poses = [e for e in record.of(PoseEstimate) if e.stamp < frozen and e.stamp in known]
    if not poses:
        return
    truth = np.array([known[pose.stamp][:3, 3] for pose in poses])
    estimated = np.array([pose.position for pose in poses])
    if record.said.scale_free:
        rotation, translation, scale = umeyama(estimated, truth, with_scale=True)
        estimated = scale * estimated @ rotation.T + translation
    elif poses[0].frame_id != "map":
        first = pose_matrix(poses[0].position, poses[0].orientation)
        moved = known[poses[0].stamp] @ np.linalg.inv(first)
        estimated = estimated @ moved[:3, :3].T + moved[:3, 3]
    errors = np.linalg.norm(estimated - truth, axis=1)
    for pose, error in zip(poses, errors, strict=True):
        if error > case.tolerance:
            kind = record.flight.kinds[pose.stamp]
            yield f"off by {error:.3f} m at {pose.stamp / 1e9} s (image of kind {kind})"


def corrects_what_it_was_sent(record: Record, case: Case) -> Iterator[str]:
    for trajectory in record.of(TrajectoryEstimate):
        stamps = trajectory.stamps.tolist()
        if {*stamps} - {*record.flight.kinds} or sorted({*stamps}) != stamps:
            yield f"a trajectory with stamps of no image, or out of order: {stamps}"
        rows = np.hstack([trajectory.positions, trajectory.orientations])
        norms = np.linalg.norm(trajectory.orientations, axis=1)
        if rows.shape != (len(stamps), 7) or not np.isfinite(rows).all():
            yield f"a trajectory with no finite pose for each stamp: {rows}"
        elif not np.allclose(norms, 1, atol=1e-6):
            yield "a trajectory without unit quaternions"
        if trajectory.frame_id not in {pose.frame_id for pose in record.of(PoseEstimate)}:
            yield f"a trajectory in {trajectory.frame_id}"


CHECKS: tuple[Callable[[Record, Case], Iterator[str]], ...] = (
    announces_what_it_reads,
    ends_in_time,
    says_nothing_before_it_knows,
    begins,
    gives_a_pose_for_each_good_image,
    is_as_late_as_declared,
    says_poses_in_order,
    says_sound_poses,
    stays_in_one_frame,
    marks_loss,
    never_lies,
    corrects_what_it_was_sent,
)


def _undisturbed(record: Record) -> list[int]:
    """Return the stamps up to the second darkness."""
    dark = [stamp for stamp, kind in record.flight.kinds.items() if kind == "b"]
    return [stamp for stamp in record.flight.kinds if stamp < dark[3]]


def flights(cases: Mapping[str, Case]) -> list[Any]:
    """Return the cases as parameters of a test that flies; those that need a library are slow."""
    return [
        pytest.param(case, id=name, marks=[pytest.mark.slow] if case.slow else [])
        for name, case in cases.items()
    ]


def refusals(cases: Mapping[str, Case]) -> list[Any]:
    """Return cases and what each may lack, as parameters of a test."""
    return [
        pytest.param(case, lack, id=f"{name}, {lack.name} missing")
        for name, case in cases.items()
        for lack in lacks(case)
    ]


def lenses_of(node: type[Estimator[Any]], settings: dict[str, Any]) -> set[str]:
    """Return the models of lenses that an estimator announces to know."""
    made = make_node(node, "est", spec(node, "est", settings).config, NoHost())
    (announced,) = made.announce()
    assert isinstance(announced, EstimatorAnnouncement)
    return set(announced.lenses)
