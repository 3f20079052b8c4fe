"""Verdict on an evaluation: figures held against thresholds; and its files in a run's folder.

trajectories/truth.tum              the true poses; it grows with the run
trajectories/<estimator>.tum        the estimates as they were sent; likewise (of ``a/b``: a+b.tum)
trajectories/plan.tum               where the pilot meant to be
trajectories/truth.<vehicle>.tum    both of the second vehicle, the third, …
trajectories/collisions.csv         what the vehicles hit, when and where
evaluation/<estimator>.csv          errors of each estimate at the time of its image
evaluation/<estimator>.lost.csv     when it had no pose
evaluation/<estimator>.ticks.csv    errors of the newest pose there was at each control tick (of a
                                    long run every second one, fourth, …)
evaluation/<estimator>.aligned.tum  the estimates in the truth's frame
evaluation/<estimator>.final.tum    the same of its trajectory after loop closures, if it sent one
evaluation/verdict.json             all figures

Sample images, with the features of estimators in them, spread evenly over a run.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import cv2
import msgspec
import numpy as np

from events import Image, TrackedFeatures
from nodes.judging.evaluation.judging import Errors, Judgement
from nodes.judging.evaluation.orientations import WRONG
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.figures import FIGURES, Figure, is_off
from runtime.host import RunEnd
from runtime.paths import source_file
from runtime.summary import overall
from runtime.time.clock import SECOND


class _Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    def given(self, *, of_flight: bool = False) -> bool:
        """Return whether any threshold of an estimator, or else of a flight, is not its default.

        One that switches a default off asks for nothing.
        """
        limits = ((figure.default, getattr(self, figure.name)) for figure in _asked(of_flight))
        return any(limit != usual and not is_off(limit) for usual, limit in limits)

    def missed(self, figures: Mapping[str, Any], *, of_flight: bool = False) -> list[str]:
        """Return a sentence for each missed threshold of an estimator, or else of the flight."""
        asked = _asked(of_flight)
        sentences = (f.missed(getattr(self, f.name), figures.get(f.name)) for f in asked)
        return [*filter(None, sentences)]


def _asked(of_flight: bool) -> list[Figure]:
    return [figure for figure in _ASKED if figure.of_flight == of_flight]


_ASKED = [figure for figure in FIGURES.values() if figure.limit]

if TYPE_CHECKING:

    class Thresholds(_Limits, frozen=True):
        """Settings: thresholds of the figures; `None` for no threshold."""

        def __init__(self, **limits: float | None) -> None: ...

else:
    Thresholds = msgspec.defstruct(
        "Thresholds",
        [
            (figure.name, kind, figure.default)
            if figure.default is not None
            else (figure.name, kind | None, None)
            for figure in _ASKED
            for kind in [int | float if figure.counts else float]  # ``inf`` for none
        ],
        bases=(_Limits,),
        module=__name__,
        namespace={
            "__doc__": "What an estimator's figures may be; what is not given, and has no default, "
            "is not asked for.\n\nAttributes:\n"
            + "".join(f"    {figure.name}: {figure.setting}\n" for figure in _ASKED)
        },
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )

UNDECLARED = "reads_truth: expected it to announce that it reads the truth, found that it listens"


def conclude(
    judged: Mapping[str, dict[str, Any]],  # see `judge`
    thresholds: Thresholds,
    faults: Sequence[str] = (),  # further reasons why all have failed
    end: RunEnd | None = None,
    declared: Collection[str] = (),  # estimators that announced that they read the truth
    flights: Mapping[str, dict[str, Any]] = MappingProxyType({}),
    own: Mapping[str, Thresholds] = MappingProxyType({}),  # thresholds of single estimators
    ended_flights: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the verdict on figures by estimator, for ``evaluation/verdict.json``.

    Args:
        ended_flights: Commands by which estimators ended the flight of their vehicle.
        flights: Figures of the flights themselves, by vehicle.

    Returns:
        ``passed``, ``estimators``, ``flights``, ``thresholds``; ``failed`` has the reason if there
        are thresholds and no estimator.
    """
    stopped = ""  # by the user, before the plan was flown
    if end is not None and end.by == "user" and not end.planned:
        stopped = f"the user ended the run before its plan was flown: {end.reason}"
    absent = {name: {"why": "expected estimates, found none"} for name in own if name not in judged}
    judged = {**judged, **absent}  # who is asked for something and is not there has failed
    estimators = {}
    for name, figures in judged.items():
        of_run = {} if end is None else _of_run(name, figures, end, name in declared)
        failed = []
        if figures.get("ate_rmse_m") is None:
            failed.append(figures.get("why", "expected estimates, found none"))
        known = {**figures, **of_run}
        asked = own.get(name, thresholds)
        missed = asked.missed(known) if "coverage_percent" in figures else []
        missed += _no_rotations(figures, asked, missed, in_run=end is not None)
        if end is not None:
            by = end.by or "the clock"
            who = f" ({by} ended the run: {end.reason})"
            missed = [text + who * text.startswith("early_end_seconds") for text in missed]
            if of_run["early_end_seconds"] is None:
                unknown = f"ended early (by {by}: {end.reason}); the planned end is not known"
                failed.append(f"early_end_seconds: {unknown}")
            if end.error and node_of(owner_of(name, end), [end.by]):
                failed.append(f"ended_by: expected no error of its own, found: {end.error}")
        failed += missed
        if name in ended_flights:
            failed.append(
                f"commands: expected it not to end the flight, found {ended_flights[name]}"
            )
        if of_run.get("reads_truth") == "undeclared":
            failed.append(UNDECLARED)
        failed += faults
        passed = not failed if failed or asked.given() else None
        if stopped:
            passed, failed = None, []
            of_run["why"] = stopped
        estimators[name] = {"passed": passed, **figures, **of_run, "failed": failed}
    flown = {}
    for vehicle, figures in flights.items():
        failed = [] if stopped else thresholds.missed(figures, of_flight=True)
        passed = (
            not failed if failed or (thresholds.given(of_flight=True) and not stopped) else None
        )
        flown[vehicle] = {"passed": passed, **figures, "failed": failed}
    verdict = {
        "passed": overall(estimators.values(), flown.values()),
        "estimators": estimators,
        "flights": flown,
        "thresholds": msgspec.to_builtins(thresholds),
    }
    if own:
        verdict["own_thresholds"] = msgspec.to_builtins(own)
    if not judged and thresholds.given():
        why = "expected an estimator to judge, found none that announced itself or sent a pose"
        verdict |= {"passed": None if stopped else False, "failed": [stopped or why, *faults]}
    return verdict


def _no_rotations(
    figures: Mapping[str, Any], thresholds: Thresholds, missed: Sequence[str], *, in_run: bool
) -> list[str]:
    """Return a sentence if an estimator's orientations are none of its vehicle's.

    Their figures are left out then. Many files have positions only, and may.
    """
    why, limit = figures.get("why_no_rotations", ""), getattr(thresholds, "rot_rmse_deg", None)
    known = any(text.startswith("rot_rmse_deg") for text in missed)
    kind = figures.get("orientations")
    blamed = kind in WRONG or (in_run and kind == "estimate without")
    if not blamed or known or limit is None or is_off(limit):
        return []
    return [f"rot_rmse_deg: expected at most {limit:g}, found none: {why}"]


def planned_end(end: RunEnd | None) -> int | None:
    """Return the planned end (ns) of a run cut short by anyone but the user, if known."""
    if end is None or end.planned or end.by == "user" or end.duration is None:
        return None
    return round(end.duration * SECOND)


def _of_run(name: str, figures: Mapping[str, Any], end: RunEnd, declared: bool) -> dict[str, Any]:
    """Return an estimator's figures from the run's end: early end, restarts, use of the truth."""
    missing: float | None = 0.0
    if not end.planned:  # of a run that has no planned duration nobody knows how much is missing
        planned = end.duration
        missing = None if planned is None else max(planned - end.stamp / SECOND, 0.0)
    facts: dict[str, Any] = {"early_end_seconds": missing, "ended_by": end.by or "duration"}
    owner = owner_of(name, end)
    again = end.restarts.get(node_of(owner, end.restarts), 0)
    if again or "restarts" in figures:  # who restarts in a new frame has it in both
        facts["restarts"] = max(figures.get("restarts", 0), again)
    if declared or node_of(owner, end.truth_readers):
        facts["reads_truth"] = "declared" if declared else "undeclared"
    elif node_of(owner, end.truth_relays):
        facts["reads_truth"] = "offered"
    return facts


def owner_of(source: str, end: RunEnd) -> str:
    """Return the node that sends in the name of a source; the source itself if that is unknown."""
    owners = {**{node: node for node in end.restarts}, **end.owners}
    return owners.get(node_of(source, owners), source)


def node_of(source: str, nodes: Iterable[str]) -> str:
    """Return the node of a source: the longest name equal to or above the source; or ""."""
    own = (n for n in nodes if n and (source == n or source.startswith(f"{n}/")))
    return max(own, key=len, default="")


FRAMES = "base_link (FRD) in {}: timestamp[s] tx ty tz[m] qx qy qz qw"


def write_results(
    out: Path,
    plans: Mapping[str, Trajectory | None],
    judgements: dict[str, Judgement],
    verdict: dict[str, Any],
) -> None:
    """Write the files above into a run's folder, except those written during the run."""
    trajectories, evaluation = out / "trajectories", out / "evaluation"
    trajectories.mkdir(exist_ok=True)
    evaluation.mkdir(exist_ok=True)
    for file, plan in plans.items():
        if plan is not None:
            write_tum(trajectories / f"{file}.tum", plan, FRAMES.format("map (NED)"))
    for source, judgement in judgements.items():
        name = source_file(source)
        if judgement.aligned is not None:
            comment = FRAMES.format("map (NED), aligned")
            write_tum(evaluation / f"{name}.aligned.tum", judgement.aligned, comment)
        if judgement.final is not None:
            comment = FRAMES.format("map (NED), after loop closures, aligned")
            write_tum(evaluation / f"{name}.final.tum", judgement.final, comment)
        rows = [f"{start},{end}\n" for start, end in judgement.lost]
        lost = "".join(["start_ns,end_ns\n", *rows])
        (evaluation / f"{name}.lost.csv").write_text(lost, encoding="ascii")
        if judgement.image_errors is not None:
            _write_errors(evaluation / f"{name}.csv", "arrival_ns", judgement.image_errors)
        if judgement.tick_errors is not None:
            _write_errors(evaluation / f"{name}.ticks.csv", "pose_ns", judgement.tick_errors)
    text = msgspec.json.format(msgspec.json.encode(verdict), indent=2)
    (evaluation / "verdict.json").write_bytes(text + b"\n")


def read_errors(path: Path) -> Errors:
    """Read a file of errors; may raise `OSError` or `ValueError`."""
    with path.open(encoding="ascii") as file:
        known = file.readline().count(",") == 3  # or else not when each came
    times, columns = ((0, 1), (2, 3)) if known else ((0,), (1, 2))
    stamps = np.loadtxt(path, np.int64, delimiter=",", skiprows=1, usecols=times, ndmin=2)
    errors = np.loadtxt(path, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
    return Errors(stamps[:, 0], stamps[:, 1:].ravel(), errors[:, 0], errors[:, 1])


def _write_errors(path: Path, since: str, errors: Errors) -> None:
    known = len(errors.since) > 0
    times = (f"{stamp}," for stamp in errors.stamps.tolist())
    if known:
        times = (f"{time}{came}," for time, came in zip(times, errors.since.tolist(), strict=True))
    rows = zip(times, errors.position.tolist(), errors.rotation.tolist(), strict=True)
    lines = [f"stamp_ns,{f'{since},' if known else ''}position_error_m,rotation_error_rad\n"]
    lines += [f"{time}{p:.9f},{r:.9f}\n" for time, p, r in rows]
    path.write_text("".join(lines), encoding="ascii")


_WAITING = 30  # images whose features may still come
_RECENT_GREEN, _OUTLIER_RED = (90, 255, 60), (60, 70, 255)  # blue, green, red


class Album:
    """Collection of about `size` images of each estimator, or untracked camera, of a run."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._images: dict[tuple[str, int], Image] = {}  # by optical frame and stamp
        self._tracked: set[str] = set()  # optical frames
        self._kept: dict[str, list[tuple[Image, TrackedFeatures | None]]] = {}
        self._interval: dict[str, int] = {}
        self._next: dict[str, int] = {}

    def add_image(self, image: Image) -> None:
        """Hold an image for its features; keep some images of untracked cameras."""
        if not self._size:
            return
        self._images[image.frame_id, image.stamp] = image
        if len(self._images) > _WAITING:
            del self._images[next(iter(self._images))]
        if image.frame_id not in self._tracked:
            self._keep(image.source, image, None)

    def add_features(self, features: TrackedFeatures) -> None:
        """Keep the image of these features, if the interval since the last has passed."""
        self._tracked.add(features.frame_id)
        image = self._images.get((features.frame_id, features.stamp))
        if image is not None:
            self._keep(features.source, image, features)

    def _keep(self, name: str, image: Image, features: TrackedFeatures | None) -> None:
        if image.stamp < self._next.get(name, 0):
            return
        kept = self._kept.setdefault(name, [])
        interval = self._interval.setdefault(name, SECOND)
        kept.append((image, features))
        if len(kept) > self._size:
            self._kept[name] = kept[::2]
            self._interval[name] = interval = 2 * interval
        self._next[name] = image.stamp + interval

    def write(self, folder: Path) -> None:
        """Draw the kept images into JPEG files: ``<estimator or camera>_<stamp>.jpg``."""
        for name, kept in self._kept.items():
            for image, features in kept:
                if features is None and image.frame_id in self._tracked:
                    continue  # kept before its estimator began
                folder.mkdir(exist_ok=True)
                drawn = draw_features(image, features)
                path = folder / f"{source_file(name)}_{image.stamp:015d}.jpg"
                jpeg = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
                path.write_bytes(jpeg.tobytes())


def draw_features(image: Image, features: TrackedFeatures | None) -> np.ndarray:
    """Return the image (blue, green, red) with a ring on each feature: green, or red if odd."""
    code = cv2.COLOR_GRAY2BGR if image.data.ndim == 2 else cv2.COLOR_RGB2BGR
    canvas = cv2.cvtColor(image.data, code)
    radius = max(round(image.data.shape[1] / 170), 2)
    if features is None:
        return np.asarray(canvas)
    for (x, y), agrees in zip(features.points.tolist(), features.inliers.tolist(), strict=True):
        color = _RECENT_GREEN if agrees else _OUTLIER_RED
        cv2.circle(canvas, (round(x), round(y)), radius, color, 1, cv2.LINE_AA)
    return np.asarray(canvas)
