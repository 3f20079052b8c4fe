"""Node for evaluating estimates against the ground truth, live and at the end."""

from __future__ import annotations

import math
from array import array
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    Collision,
    Command,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    LidarScan,
    Odometry,
    PlannedPose,
    PoseEstimate,
    PositionSetpoint,
    Score,
    TrackedFeatures,
    TrackingEvent,
    TrajectoryEstimate,
    Vector3,
    VehicleEvent,
)
from events.announcements import Vehicles
from events.frames import angle_between
from events.geometry import Pose, pose_matrix, pose_tuples
from nodes.judging.evaluation.album import Album
from nodes.judging.evaluation.files import FRAMES, write_results
from nodes.judging.evaluation.flight import Flight, collision_rows
from nodes.judging.evaluation.judging import Judgement, judge
from nodes.judging.evaluation.plausibility import CommandLog, at_images
from nodes.judging.evaluation.record import EstimatorRecord, Stamps, choose_camera
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.evaluation.verdict import conclude, node_of, owner_of, planned_end
from nodes.trajectory import Trajectory
from nodes.trajectory_files import GrowingFile, tum_row, write_tum
from runtime import Duration, Node, NodeConfig, Output, on
from runtime.errors import suggest
from runtime.figures import FIGURES
from runtime.host import RunEnd
from runtime.source_files import source_file
from runtime.time.clock import SECOND


class LiveErrors:
    """Errors of an estimator so far in one frame; in others than ``map`` aligned at the first."""

    def __init__(self, frame_id: str) -> None:
        self.frame_id = frame_id
        self.count = 0
        self.sum_of_squares = 0.0
        self._origin: npt.NDArray[np.float64] | None = None

    def of(self, event: PoseEstimate, truth: Pose) -> tuple[float, float]:
        """Return the errors of an estimate: metres, radians."""
        position, orientation = event.position, event.orientation
        if self.frame_id != "map":
            matrix = pose_matrix(position, orientation)
            if self._origin is None:
                self._origin = pose_matrix(*truth) @ np.linalg.inv(matrix)
            position, orientation = pose_tuples(self._origin @ matrix)
        distance = math.dist(truth[0], position)
        self.count += 1
        self.sum_of_squares += distance * distance
        return distance, angle_between(truth[1], orientation)

    @property
    def rmse(self) -> float:
        """Root mean square of the position errors so far, metres."""
        return math.sqrt(self.sum_of_squares / self.count) if self.count else 0.0


Positive = Annotated[float, msgspec.Meta(gt=0)]


AlignmentSetting = Literal["auto", "none", "origin", "posyaw", "se3", "sim3"]


class OwnConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an evaluation for a single estimator; anything not given is as for all.

    Attributes:
        alignment: As `EvaluationConfig.alignment`.
        thresholds: Thresholds by figure; ``inf`` for none.
    """

    alignment: AlignmentSetting | None = None
    thresholds: dict[str, float] = {}


class EvaluationConfig(NodeConfig):
    """Settings of an evaluation.

    Attributes:
        alignment: How an estimate is aligned: ``none``, ``origin`` (first pose on first
            pose), ``posyaw`` (translation and heading), ``se3``, ``sim3``; ``auto`` is ``sim3`` for
            scale-free estimators, ``none`` for estimates in ``map``, and ``origin`` for all others.
            The verdict always has trajectory errors after ``se3`` and ``sim3``, too.
        align_first: Beginning that the alignment is computed from: a number of poses, or a
            duration (``"5s"``); the whole if not given.
        vehicle: Vehicle whose truth all estimates are held against; if empty, the one in an
            estimator's source, or of its camera, else the first.
        control_rate: Hertz of the controller for which newest poses are judged.
        gap: Silence of an estimator that counts as lost.
        max_difference: From a time to the nearest true pose in a hole of the truth; in longer holes
            poses are not compared.
        thresholds: Limits of figures; a missed one makes the run's exit code 1. Always asked, but
            for an ``inf``: poses for nine tenths of the flight, one frame, rising stamps, no
            collision, the run's planned end, and what anybody can mean: orientations, motions over
            a metre, velocities, covariances, stamps of images, no later images. With thresholds,
            there must be an estimator. ``collisions`` and ``plan_*`` are thresholds of the flight,
            and fail no estimator.
        estimators: Settings of single estimators, by source.
        image_count: Sample images with features of each estimator; 0 for none.
    """

    alignment: AlignmentSetting = "auto"
    align_first: Annotated[int, msgspec.Meta(ge=1)] | str | None = None
    vehicle: str = ""
    control_rate: Positive = 400
    gap: Duration = Duration(0.5)  # immutable
    max_difference: Duration = Duration(0.1)
    thresholds: Thresholds = Thresholds()
    estimators: dict[str, OwnConfig] = msgspec.field(default_factory=dict)
    image_count: Annotated[int, msgspec.Meta(ge=0, le=100)] = 12

    def __post_init__(self) -> None:
        try:
            self.alignment_span()
        except ValueError as error:
            raise ValueError(
                f"align_first: expected a number of poses or a duration: {error}"
            ) from None
        for name, settings in self.estimators.items():
            for figure in settings.thresholds:
                known = [k for k in self.thresholds.__struct_fields__ if not FIGURES[k].of_flight]
                if figure not in known:
                    raise ValueError(
                        f"estimators.{name}.thresholds: expected the name of a figure of an "
                        f"estimator, found {figure}{suggest(figure, known)}"
                    )

    @property
    def hole(self) -> int:
        """Nanoseconds between true poses over which none is made up."""
        return 2 * round(self.max_difference * SECOND)

    def alignment_span(self) -> int | float | None:
        """Return `align_first` as `align` takes it: poses (int), or seconds (float)."""
        if isinstance(self.align_first, str):
            return float(Duration.parse(self.align_first))
        return self.align_first

    def alignment_of(self, estimator: str) -> AlignmentSetting:
        """Return how an estimator's poses are aligned with the truth."""
        settings = self.estimators.get(estimator)
        return (settings and settings.alignment) or self.alignment

    def own_thresholds(self) -> dict[str, Thresholds]:
        """Return the thresholds of estimators with other ones, those of all included."""
        return {
            name: msgspec.structs.replace(self.thresholds, **settings.thresholds)
            for name, settings in self.estimators.items()
            if settings.thresholds
        }


class Evaluation(Node[EvaluationConfig]):
    """Evaluation of every received estimator against the odometry of its vehicle.

    Errors are sent as `Score`; files are written at the end, and the verdict into the run's
    summary.
    """

    reads_truth = "judging"
    files = ("trajectories", "evaluation", "frames")
    scores = Output(Score)

    async def on_startup(self) -> None:
        """Open the files of trajectories: they grow as the run goes on."""
        self._vehicles = Vehicles()
        self._flights: dict[str, Flight] = {}  # by vehicle
        self._records: dict[str, EstimatorRecord] = {}
        self._live: dict[str, LiveErrors] = {}
        self._frames: dict[str, array[int]] = {}  # times of exposure by camera
        self._scans: dict[str, array[int]] = {}  # by lidar
        self._late: dict[str, int] = {}  # offsets of the cameras' clocks
        self._latencies: dict[str, int] = {}  # of their images (ns)
        self._places: dict[str, Vector3] = {}  # of the cameras on their bodies (m)
        self._read: dict[str, tuple[str, ...]] = {}  # cameras by estimator, as it announced
        self._commands = CommandLog()
        self._album = Album(self.config.image_count)
        self._files: dict[str, GrowingFile] = {}

    def on_announcement(self, announcement: Announcement) -> None:
        """Record vehicles, their cameras, and estimators."""
        self._vehicles.announced(announcement)
        if isinstance(announcement, CameraAnnouncement):
            self._late[announcement.source] = round(announcement.time_offset * 1e9)
            self._latencies[announcement.source] = round(announcement.latency * 1e9)
            self._places[announcement.source] = announcement.position
        if isinstance(announcement, EstimatorAnnouncement):
            record = EstimatorRecord(
                announcement.scale_free, announcement.method, announcement.reads
            )
            self._records[announcement.source] = record
            self._read[announcement.source] = announcement.cameras

    def check(self) -> Iterable[str]:
        """Report an unknown vehicle or estimator, and thresholds without an estimator."""
        config = self.config
        asked = any(t.any_set() for t in (config.thresholds, *config.own_thresholds().values()))
        if asked and not (self._records or self.senders_of(PoseEstimate, TrajectoryEstimate)):
            yield "thresholds: expected an estimator to judge, found none"
        senders = self.senders_of(PoseEstimate, TrajectoryEstimate)
        sources = [*self._records, *senders]
        # A sender without announcement, such as a replay, may send for any.
        complete = {node_of(source, senders) for source in self._records} >= set(senders)
        for name in config.estimators if complete else ():
            if name not in sources:
                yield (
                    f"estimators.{name}: expected one of those that send poses "
                    f"({', '.join(dict.fromkeys(sources)) or 'none'}){suggest(name, sources)}"
                )
        if (name := config.vehicle) and name not in (names := self._vehicles.names):
            yield (
                f"vehicle: expected one that is announced ({', '.join(names) or 'none'}), "
                f'found "{name}"{suggest(name, names)}'
            )

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        """Record the true pose."""
        known = self._vehicles.names
        if known and event.source not in known and "odometry" not in self.sources:
            return
        flight = self._flights.get(event.source)
        if flight is None:
            self._vehicles.add(event.source)
            flight = self._flights[event.source] = self._flights.pop("", Flight())
        flight.add(event)
        self._append(self._named("truth", event.source), event)

    @on(PlannedPose, PositionSetpoint)
    def plans(self, event: PlannedPose | PositionSetpoint) -> None:
        """Record a planned pose or a set-point."""
        vehicle = self._vehicles.of(event.vehicle or event.source)
        self._flights.setdefault(vehicle, Flight()).add_plan(event)

    @on(PoseEstimate)
    def estimates(self, event: PoseEstimate) -> None:
        """Record an estimate, and send its errors as scores."""
        name, now = event.source, self.clock.now()
        record = self._records.setdefault(name, EstimatorRecord())
        if not record.add(event, now):
            return
        if event.frame_id == next(iter(record.maps)):
            self._append(source_file(name), event)
        self._score(event, "latency", (now - event.stamp) / 1e9, "s")
        flight = self._flight_of(name)
        truth = flight.recent.at(event.stamp, self.config.hole)
        if truth is None or record.scale_free:
            return
        live = self._live.get(name)
        if live is None or live.frame_id != event.frame_id:
            live = self._live[name] = LiveErrors(event.frame_id)
        distance, angle = live.of(event, truth)
        self._score(event, "position_error", distance, "m")
        self._score(event, "rotation_error", angle, "rad")
        self._score(event, "ate_rmse", live.rmse, "m")
        if flight.path > 0:
            self._score(event, "ate_percent", 100.0 * live.rmse / flight.path, "%")

    @on(TrackingEvent)
    def tracking_events(self, event: TrackingEvent) -> None:
        """Record loss or recovery of an estimator's tracking."""
        record = self._records.setdefault(event.source, EstimatorRecord())
        record.add_tracking(event, self.clock.now())

    @on(TrajectoryEstimate)
    def trajectories(self, event: TrajectoryEstimate) -> None:
        """Record an estimator's trajectory after loop closures; the last counts."""
        self._records.setdefault(event.source, EstimatorRecord()).add_final(event)

    @on(LidarScan)
    def scans(self, event: LidarScan) -> None:
        """Record a scan's end time; a pose may be for any of its rays."""
        stamps = self._scans.setdefault(event.source, array("q"))
        if not stamps or event.end > stamps[-1]:
            stamps.append(event.end)

    @on(Image)
    def images(self, event: Image) -> None:
        """Record an image's stamp; keep the image for a while, for features to follow."""
        stamps = self._frames.setdefault(event.source, array("q"))
        exposed = event.stamp - self._late.get(event.source.removesuffix("/grey"), 0)
        if not stamps or exposed > stamps[-1]:
            stamps.append(exposed)
        self._album.add_image(event)

    @on(DepthImage)
    def depth_images(self, event: DepthImage) -> None:
        """Record the stamp of a depth image, which may be all that a camera gives."""
        stamps = self._frames.setdefault(event.source, array("q"))
        exposed = event.stamp - self._late.get(event.source, 0)
        if not stamps or exposed > stamps[-1]:
            stamps.append(exposed)

    @on(Command, VehicleEvent)
    def commands(self, event: Command | VehicleEvent) -> None:
        """Record commands to vehicles, and the vehicles' events."""
        self._commands.add(event)

    @on(Collision)
    def collisions(self, event: Collision) -> None:
        """Record a vehicle's collision."""
        self._flights.setdefault(event.source, Flight()).collisions.append(event)

    @on(TrackedFeatures)
    def features(self, event: TrackedFeatures) -> None:
        """Record an estimator's camera; keep an image with its features at intervals."""
        self._vehicles.tracked(event)
        self._album.add_features(event)

    async def on_shutdown(self) -> None:
        """Judge all estimators and write the results."""
        for file in self._files.values():
            file.close()
        if not self._records and self.clock.now() > 0:
            self.log.info("no estimator has announced itself or sent an estimate")
        judgements, verdict = await self.offload(self._finish, self.clock.now())
        for name, figures in verdict["estimators"].items():
            rest = {k: v for k, v in figures.items() if k != "passed"}
            self.conclude(name, rest, passed=figures["passed"])
            if figures.get("why"):
                self.log.warning("%s: %s", name, figures["why"])
            if judgements[name].note:
                self.log.warning("%s: %s", name, judgements[name].note)
        for name in self.config.estimators.keys() - judgements.keys():
            self.log.warning("estimators.%s: expected poses from it, found none", name)
        for vehicle, figures in verdict["flights"].items():
            rest = {k: v for k, v in figures.items() if k != "passed"}
            self.conclude(vehicle, rest, passed=figures["passed"], flight=True)
        if not judgements and "failed" in verdict:
            self.conclude(self.name, {"failed": verdict["failed"]}, passed=verdict["passed"])

    def _finish(self, end: int) -> tuple[dict[str, Judgement], dict[str, Any]]:
        config = self.config
        truths = {v: f.truth.trajectory() for v, f in self._flights.items() if len(f.truth)}
        flown = {v: flight.figures(truths.get(v)) for v, flight in self._flights.items()}
        judgements = {}
        ended: dict[str, str] = {}
        how = self.run_end
        for name, record in self._records.items():
            vehicle = self._vehicle_of(name)
            sensors = self._scans if "lidar" in record.reads else self._frames
            seen = self._seen(vehicle, sensors)
            poses = record.stamps()
            read = self._read_by(name, how)
            camera = choose_camera(seen, poses, read)
            body = self._flights.get(vehicle, Flight()).body
            at_camera = {}
            if record.scale_free and {"grey", "rgb"} & {*record.reads}:  # and knows its camera
                eye = self._camera_of_poses(name, read, how)
                record.lever = self._places.get(eye, record.lever)
                at_camera = {"compared_at": eye} if any(record.lever) else {}
            judgement = self._judge(
                name,
                record,
                truths.get(vehicle),
                cameras={} if camera is None else {camera: seen[camera]},
                end=end,
                planned=planned_end(how),
                body=body,
            )
            judgement.figures.update(flown.get(vehicle, {}) | at_camera)
            if camera is not None:
                judgement.figures["camera"] = camera
            eye = "" if camera is None else camera.removesuffix("/grey")
            if camera is not None and eye in self._late and {camera, eye} & {*read}:
                judgement.figures["stamped_at_images_percent"] = at_images(
                    seen[camera],
                    poses,
                    self._late[eye],
                    record.arrivals() - poses,
                    self._latencies[eye],
                )
            if how is not None:
                self._add_commands(name, vehicle, how, judgement.figures, ended)
            if "latency_p50_ms" in judgement.figures:
                declared_here = self.clock.kind == "lockstep"
                judgement.figures["latency"] = "declared" if declared_here else "measured"
            if len(self._vehicles.names) > 1:
                judgement.figures["vehicle"] = vehicle
            judgements[name] = judgement
        restarted = (
            f"{self.name}: expected it to judge the whole flight, found that it was restarted: "
            "what was sent before is not in the figures"
        )
        figures = {name: judgement.figures for name, judgement in judgements.items()}
        faults = [restarted] if self.restarts else []
        declared = [name for name, record in self._records.items() if "truth" in record.reads]
        verdict = conclude(
            figures,
            config.thresholds,
            faults,
            how,
            declared,
            flights={vehicle: flight for vehicle, flight in flown.items() if vehicle},
            by_estimator=config.own_thresholds(),
            ended_flights=ended,
        )
        if self.out is not None:
            plans = {self._named("plan", v): f.plan() for v, f in self._flights.items()}
            write_results(self.out, plans, judgements, verdict)
            for name, record in self._records.items():
                if record.longest is not next(iter(record.maps.values()), record.longest):
                    file_name = source_file(name)
                    path, head = self._trajectory_file(file_name, record.longest.frame_id)
                    path.replace(self.out / "evaluation" / f"{file_name}.first_map.tum")
                    write_tum(path, record.longest.rows.trajectory(), head)
            collisions = [c for flight in self._flights.values() for c in flight.collisions]
            file = self.out / "trajectories" / "collisions.csv"
            file.write_text(collision_rows(collisions), encoding="utf-8")
            self._album.write(self.out / "frames")
        return judgements, verdict

    def _read_by(self, estimator: str, end: RunEnd | None) -> Collection[str]:
        """Return the cameras and lidars that an estimator reads, as far as that is known."""
        read = None if end is None else end.read.get(owner_of(estimator, end))
        return read or self._read.get(estimator, ())

    def _camera_of_poses(self, estimator: str, read: Collection[str], end: RunEnd | None) -> str:
        """Return the camera whose poses an estimator gives; empty if that is unknown.

        Of several that are read, it is the one in whose images features are tracked.
        """
        eyes = {eye.removesuffix("/grey") for eye in read} & self._places.keys()
        if len(eyes) > 1:
            owner = estimator if end is None else owner_of(estimator, end)
            eyes &= {self._vehicles.camera_of(estimator) or self._vehicles.camera_of(owner)}
        return eyes.pop() if eyes else ""

    def _add_commands(
        self,
        estimator: str,
        vehicle: str,
        end: RunEnd,
        figures: dict[str, Any],
        ended: dict[str, str],  # by estimator, added to
    ) -> None:
        """Add the commands of an estimator's node, and whether one of them ended the flight."""
        owner = owner_of(estimator, end)

        def sent_by(source: str) -> bool:
            return owner_of(source, end) == owner

        if text := self._commands.text(sent_by):
            figures["commands"] = text
        if owner in end.estimators and (text := self._commands.ended(sent_by, vehicle)):
            ended[estimator] = text

    def _judge(
        self, name: str, record: EstimatorRecord, truth: Trajectory | None, **seen: Any
    ) -> Judgement:
        """Judge an estimator; invalid data do not affect the judgement of others."""
        if truth is None:
            why = "expected a truth to hold it against, found no odometry"
            return Judgement(figures={"why": why}, estimate=None)
        config = self.config
        try:
            return judge(
                record,
                truth,
                **seen,
                alignment=config.alignment_of(name),
                align_first=config.alignment_span(),
                rate=config.control_rate,
                gap=config.gap,
                hole=config.hole,
            )
        except Exception as error:
            self.log.exception("it cannot be judged")
            why = f"cannot be judged: {type(error).__name__}: {error}"
            return Judgement(figures={"why": why}, estimate=None)

    def _vehicle_of(self, estimator: str) -> str:
        chosen = self.config.vehicle or self._vehicles.of(estimator)
        flying = [vehicle for vehicle, flight in self._flights.items() if len(flight.truth)]
        return flying[0] if len(flying) == 1 else chosen  # the file may have chosen its odometry

    def _flight_of(self, estimator: str) -> Flight:
        return self._flights.get(self._vehicle_of(estimator)) or Flight()

    def _seen(self, vehicle: str, sensors: dict[str, array[int]]) -> dict[str, Stamps]:
        several = len(self._vehicles.names) > 1
        return {
            sensor: np.array(stamps, np.int64)
            for sensor, stamps in sensors.items()
            if not several or self._vehicles.carrier(sensor) in {"", vehicle}
        }

    def _named(self, what: str, vehicle: str) -> str:
        """Return the name of a file: ``truth`` of the first vehicle, ``truth.<name>`` of others."""
        first = next(iter(self._vehicles.names), vehicle)
        return what if vehicle == first else f"{what}.{source_file(vehicle)}"

    def _append(self, name: str, event: Odometry | PoseEstimate) -> None:
        """Append a pose to a file at once: a killed run keeps all poses sent."""
        if self.out is None:
            return
        file = self._files.get(name)
        if file is None:
            true = isinstance(event, Odometry)
            path, head = self._trajectory_file(name, None if true else event.frame_id)
            path.parent.mkdir(exist_ok=True)
            file = self._files[name] = GrowingFile(self, path, f"# {head}\n")
        file.add(tum_row(event.stamp, event.position, event.orientation))

    def _trajectory_file(self, name: str, frame_id: str | None) -> tuple[Path, str]:
        """Return the path and the first line of a trajectory's file; without a frame, a truth's."""
        assert self.out is not None
        frame = "map (NED)"
        if frame_id is not None:
            in_one_line = frame_id.encode("unicode_escape").decode("ascii")
            frame = f"{in_one_line}, as it was sent"
        return self.out / "trajectories" / f"{name}.tum", FRAMES.format(frame)

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
