"""Files of an evaluation in a run's folder: trajectories, errors and the verdict.

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

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from events import Image, TrackedFeatures
from nodes.judging.evaluation.judging import Errors, Judgement
from nodes.trajectory import Trajectory
from nodes.trajectory.formats import write_tum
from runtime.paths import source_file
from runtime.time.schedule import SECOND

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
        if judgement.of_images is not None:
            _write_errors(evaluation / f"{name}.csv", "arrival_ns", judgement.of_images)
        if judgement.of_ticks is not None:
            _write_errors(evaluation / f"{name}.ticks.csv", "pose_ns", judgement.of_ticks)
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
                cv2.imwrite(str(path), drawn, [cv2.IMWRITE_JPEG_QUALITY, 88])


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
