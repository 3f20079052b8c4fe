"""Holds estimates against the truth, live and at the end."""

from __future__ import annotations

from array import array
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    Collision,
    EstimatorAnnouncement,
    Image,
    Odometry,
    PlannedPose,
    PoseEstimate,
    PositionSetpoint,
    Score,
    TrackedFeatures,
    TrackingEvent,
    VehicleAnnouncement,
)
from events.rotations import from_yaw
from nodes.evaluation.album import Album
from nodes.evaluation.judging import Judgement, Thresholds, beside_the_plan, judge
from nodes.evaluation.live import LiveErrors
from nodes.evaluation.record import EstimatorRecord
from nodes.evaluation.results import FRAMES, file_name, write_results
from nodes.trajectory import PoseRows, RecentPoses, Trajectory
from nodes.trajectory.formats import tum_row
from nodes.trajectory.growing import GrowingFile
from runtime import Duration, Node, NodeConfig, Output, on
from runtime.summary import overall

Positive = Annotated[float, msgspec.Meta(gt=0)]


class EvaluationConfig(NodeConfig):
    """Settings of an evaluation.

    Attributes:
        alignment: How an estimate is laid on the truth: ``none``, ``origin`` (first pose on first
            pose), ``se3``, ``sim3``; ``auto`` is ``sim3`` for scale-free estimators, ``none`` for
            estimates in ``map``, and ``origin`` for all others.
        control_rate: Hertz of the controller for which the newest pose is judged.
        delta: Metres of path over which relative errors are taken.
        gap: Silence of an estimator that counts as lost.
        thresholds: What the figures may be; if one is missed, the run's exit code is 1. Without
            any, an estimator is not judged, unless it misses what is asked of everybody (it was
            there for nine tenths of the flight, in one frame, with stamps that rise; its vehicle
            hit nothing).
        image_count: Sample images with features to keep of each estimator; 0 for none.
    """

    alignment: Literal["auto", "none", "origin", "se3", "sim3"] = "auto"
    control_rate: Positive = 400
    delta: Positive = 1.0
    gap: Duration = Duration(0.5)  # immutable
    thresholds: Thresholds = Thresholds()
    image_count: Annotated[int, msgspec.Meta(ge=0, le=100)] = 12


class Evaluation(Node[EvaluationConfig]):
    """Judges every estimator that it receives against the odometry of one vehicle.

    Errors are sent as `Score` as the estimates come; the rest is written at the end, and the
    verdict put into the run's summary.
    """

    files = ("trajectories", "evaluation", "frames")
    scores = Output(Score)

    async def on_startup(self) -> None:
        """Open the files of trajectories: they grow as the run goes on."""
        self._truth = PoseRows()
        self._recent = RecentPoses()
        self._plan = PoseRows()
        self._setpoints = PoseRows()
        self._records: dict[str, EstimatorRecord] = {}
        self._live: dict[str, LiveErrors] = {}
        self._frames: dict[str, array[int]] = {}  # stamps by camera
        self._collisions = 0
        self._album = Album(self.config.image_count)
        self._files: dict[str, GrowingFile] = {}
        self._closed = False

    def on_announcement(self, announcement: Announcement) -> None:
        """Take the first vehicle's truth, unless the file names another; expect estimators."""
        if isinstance(announcement, VehicleAnnouncement):
            self.narrow("odometry", announcement.source)
            self.narrow("collisions", announcement.source)
        if isinstance(announcement, EstimatorAnnouncement):
            record = EstimatorRecord(announcement.scale_free, announcement.method)
            self._records[announcement.source] = record

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Note the truth."""
        if self._closed:
            return
        self._truth.add(event.stamp, event.position, event.orientation)
        self._recent.add(event.stamp, event.position, event.orientation)
        self._append("truth", event)

    @on(PlannedPose, PositionSetpoint)
    def plans(self, event: PlannedPose | PositionSetpoint) -> None:
        """Note where the pilot means to be."""
        rows = self._plan if isinstance(event, PlannedPose) else self._setpoints
        rows.add(event.stamp, event.position, from_yaw(event.yaw))

    @on(PoseEstimate)
    def estimates(self, event: PoseEstimate) -> None:
        """Note an estimate, and send its errors as scores."""
        if self._closed:
            return
        name, now = event.source, self.clock.now()
        record = self._records.setdefault(name, EstimatorRecord())
        if not record.add(event, now):
            return
        self._append(name, event)
        self._score(event, "latency", (now - event.stamp) / 1e9, "s")
        truth = self._recent.at(event.stamp)
        if truth is None or record.scale_free:
            return
        live = self._live.setdefault(name, LiveErrors())
        distance, angle = live.of(event, truth)
        self._score(event, "position_error", distance, "m")
        self._score(event, "rotation_error", angle, "rad")
        self._score(event, "mean_square_error", live.mean_square, "m^2")

    @on(TrackingEvent)
    def tracking_events(self, event: TrackingEvent) -> None:
        """Note that an estimator lost or regained its way."""
        self._records.setdefault(event.source, EstimatorRecord()).note(event)

    @on(Image)
    def images(self, event: Image) -> None:
        """Note that there was an image; hold it for a while: its features may follow."""
        stamps = self._frames.setdefault(event.source, array("q"))
        if not stamps or event.stamp > stamps[-1]:
            stamps.append(event.stamp)
        self._album.add_image(event)

    @on(Collision)
    def collisions(self, event: Collision) -> None:  # noqa: ARG002
        """Count the vehicle's collisions."""
        self._collisions += 1

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Keep an image and its features at intervals."""
        self._album.add_features(event)

    async def on_shutdown(self) -> None:
        """Judge, and write what came of it."""
        self._closed = True  # while it judges, beside the loop, nothing may change
        for file in self._files.values():
            file.close()
        if not self._records and self.clock.now() > 0:
            self.log.warning("no estimator has announced itself or sent an estimate")
        judgements, verdict = await self.offload(self._finish, self.clock.now())
        for name, judgement in judgements.items():
            figures = verdict["estimators"][name]
            rest = {k: v for k, v in figures.items() if k != "passed"}
            self.conclude(name, rest, passed=figures["passed"])
            if judgement.figures.get("why"):
                self.log.warning("%s: %s", name, judgement.figures["why"])

    def _finish(self, end: int) -> tuple[dict[str, Judgement], dict[str, Any]]:
        config = self.config
        truth = self._truth.trajectory() if len(self._truth) else None
        plan = self._plan.trajectory() if len(self._plan) else None
        flown: dict[str, float] = {"collisions": self._collisions}
        if truth is not None and plan is not None:
            flown |= beside_the_plan(truth, plan)
        cameras = {name: np.array(stamps, np.int64) for name, stamps in self._frames.items()}
        judgements, estimators = {}, {}
        for name, record in self._records.items():
            judgement = self._judge(record, truth, cameras, end)
            judgement.figures.update(flown)
            failed = []
            if judgement.figures.get("ate_rmse_m") is None:
                failed.append(judgement.figures.get("why", "expected estimates, found none"))
            if "coverage_percent" in judgement.figures:
                failed += config.thresholds.missed(judgement.figures)
            if self.restarts:
                failed.append(
                    f"{self.name}: expected it to judge the whole flight, found that it was "
                    "restarted: what was sent before is not in the figures"
                )
            passed = not failed if failed or config.thresholds.given else None
            estimators[name] = {"passed": passed, **judgement.figures, "failed": failed}
            judgements[name] = judgement
        verdict = {
            "passed": overall(figures["passed"] for figures in estimators.values()),
            "estimators": estimators,
            "thresholds": msgspec.to_builtins(config.thresholds),
        }
        if self.out is not None:
            setpoints = self._setpoints.trajectory() if len(self._setpoints) else None
            write_results(self.out, plan or setpoints, judgements, verdict)
            self._album.write(self.out / "frames")
        return judgements, verdict

    def _judge(
        self,
        record: EstimatorRecord,
        truth: Trajectory | None,
        cameras: dict[str, npt.NDArray[np.int64]],
        end: int,
    ) -> Judgement:
        """Judge one estimator; whatever it sent, the others are judged."""
        if truth is None:
            why = "expected a truth to hold it against, found no odometry"
            return Judgement(figures={"why": why}, estimate=None)
        config = self.config
        try:
            return judge(
                record,
                truth,
                cameras=cameras,
                end=end,
                alignment=config.alignment,
                rate=config.control_rate,
                delta=config.delta,
                gap=config.gap,
            )
        except Exception as error:
            self.log.exception("it cannot be judged")
            why = f"cannot be judged: {type(error).__name__}: {error}"
            return Judgement(figures={"why": why}, estimate=None)

    def _append(self, name: str, event: Odometry | PoseEstimate) -> None:
        """Add a pose to a file: should the run be killed, what was sent until then is there."""
        if self.out is None:
            return
        file = self._files.get(name)
        if file is None:
            folder = self.out / "trajectories"
            folder.mkdir(exist_ok=True)
            path = folder / f"{file_name(name)}.tum"
            frame = "map (NED)" if name == "truth" else f"{event.frame_id}, as it was sent"
            head = f"# {FRAMES.format(frame)}\n"
            file = self._files[name] = GrowingFile(self, path, head)
        file.add(tum_row(event.stamp, event.position, event.orientation))

    def _score(self, event: PoseEstimate, metric: str, value: float, unit: str) -> None:
        self.scores.send(
            Score(
                stamp=event.stamp,
                source=self.name,
                subject=event.source,
                metric=metric,
                value=value,
                unit=unit,
            )
        )
