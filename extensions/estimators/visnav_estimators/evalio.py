"""Lidar and lidar-inertial pipelines of the package evalio, in a worker's process, and their node.

They can crash their process. The library is imported when an object is made, so that others may
import this module for its names. Its pipelines take points and samples in frames whose z is up;
poses are those of the IMU.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Event, Imu, ImuAnnouncement, LidarAnnouncement, LidarScan
from events.geometry import pose_matrix
from nodes.estimators import Estimator, EstimatorConfig, TrackingResult, sample_rows
from runtime import Input, on
from runtime.errors import MissingDependencyError, suggest

Name = Literal["ct", "dlio", "form", "genz", "kiss", "liosam", "loam", "mad"]
Floats = npt.NDArray[np.float64]

INSTALL = "pip install './extensions/estimators[evalio]'"

_INERTIAL = ("dlio", "liosam")  # pipelines that cannot do without an IMU
_FIXED = {
    "ls_num_threads": 1,
    "max_num_threads": 1,
    "num_threads": 1,
    "numberOfCores": 1,
    "realtime": False,
}
"""Parameters that are no user's, so that equal scans give equal poses.

The sums of several threads have no fixed order, and ``realtime`` gives up by the processor's time.
"""

_USUAL = {"deskew": True, "mappingProcessInterval": 0.0}
"""Defaults that are not the library's: LIO-SAM's, 0.15 s, repeats the pose before at 10 Hz."""

_SCANS_LATE = {"liosam": 2}  # scans that a pipeline holds back: a pose is that of an earlier scan
_TIME_OF_POSE = {"ct": 0.0, "dlio": 0.5, "form": 0.5, "liosam": 0.5, "loam": 0.5}
"""Time of a pose within its scan, from the first ray (0) to the last (1); found on ideal data.

The others correct a scan to its last ray, or, told not to, give a mean over all.
"""

_UP = np.diag([1.0, -1.0, -1.0, 1.0])  # from y right and z down to y left and z up, and back


class EvalioConfig(EstimatorConfig):
    """Settings of a pipeline.

    Attributes:
        pipeline: ``ct`` (CT-ICP), ``dlio`` (DLIO), ``form`` (FORM), ``genz`` (GenZ-ICP), ``kiss``
            (KISS-ICP), ``liosam`` (LIO-SAM), ``loam`` (LOAM), ``mad`` (MAD-ICP). DLIO and LIO-SAM
            read the IMU, too.
        parameters: The pipeline's own, by name; all others are its defaults, but for ``deskew``,
            the correction for the motion during a scan, which is on, ``mappingProcessInterval``,
            which is 0, and those of threads and real time, which are not settable.
        max_range: Points farther away are left out, metres; 0 for the lidar's own range.
        min_points: Points of a scan below which the lidar is lost.
    """

    pipeline: Name = "kiss"
    parameters: dict[str, bool | int | float | str] = msgspec.field(default_factory=dict)
    max_range: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    min_points: Annotated[int, msgspec.Meta(ge=10)] = 100

    def time_of_pose(self) -> float:
        """Return when within a scan a pose is true: 0 at the first ray, 1 at the last."""
        corrected = 1.0 if self.parameters.get("deskew", True) else 0.5
        return _TIME_OF_POSE.get(self.pipeline, corrected)


class EvalioProcess:
    """A pipeline of evalio.

    Raises:
        MissingDependencyError: `evalio` cannot be imported.
        ValueError: The pipeline has no such parameter, or one of another type.
    """

    def __init__(
        self,
        config: EvalioConfig,
        lidar: LidarAnnouncement,  # whose ranges are the limits
        imu: ImuAnnouncement | None,  # whose samples it gets; `None` for none
    ) -> None:
        try:
            from evalio import pipelines, types
        except ImportError as error:
            raise MissingDependencyError(
                f"{config.pipeline} needs evalio ({error}): {INSTALL}"
            ) from error
        self._types = types
        self._lidar = lidar
        self._limits = lidar.min_range, config.max_range or lidar.max_range
        self._min_points = config.min_points
        self._by_time = config.pipeline == "kiss"
        body_from_lidar = pose_matrix(lidar.position, lidar.orientation)
        body_from_imu = np.eye(4) if imu is None else pose_matrix(imu.position, imu.orientation)
        self._imu_from_lidar = _UP @ np.linalg.inv(body_from_imu) @ body_from_lidar @ _UP
        if config.pipeline in ("form", "genz"):
            # They leave the number of threads to TBB; KISS-ICP limits it for the whole process.
            self._start(pipelines, EvalioConfig(), None)
        self._pipeline = self._start(pipelines, config, imu)
        self._origin = np.eye(4)  # inverse of the lidar's first pose
        self._early = 1 + _SCANS_LATE.get(config.pipeline, 0)  # scans until that pose
        self._pose = np.eye(4)

    def _start(self, pipelines: Any, config: EvalioConfig, imu: ImuAnnouncement | None) -> Any:
        pipeline = pipelines.get_pipeline(config.pipeline)()
        lidar, types = self._lidar, self._types
        near, far = self._limits
        pipeline.set_lidar_params(
            types.LidarParams(
                num_rows=lidar.channels,
                num_columns=lidar.columns,
                min_range=near,
                max_range=far,
                rate=lidar.rate,
            )
        )
        if imu is not None:
            pipeline.set_imu_params(
                types.ImuParams(
                    gyro=max(imu.gyroscope_noise_density, 1e-6),
                    accel=max(imu.accelerometer_noise_density, 1e-6),
                    gyro_bias=max(imu.gyroscope_random_walk, 1e-7),
                    accel_bias=max(imu.accelerometer_random_walk, 1e-7),
                    gravity=np.array([0.0, 0.0, -9.81]),
                    rate=imu.rate,
                )
            )
        mounting = self._imu_from_lidar
        turn = types.SO3.from_mat(mounting[:3, :3])
        pipeline.set_imu_T_lidar(types.SE3(turn, mounting[:3, 3].copy()))
        defaults = pipeline.default_params()
        fixed = {name: value for name, value in _FIXED.items() if name in defaults}
        usual = {name: value for name, value in _USUAL.items() if name in defaults}
        parameters = _checked(config, defaults)
        pipeline.set_params(defaults | usual | parameters | fixed)
        pipeline.initialize()
        return pipeline

    def track(
        self,
        stamp: int,  # of the scan's first ray, ns
        points: npt.NDArray[np.float32],
        times: npt.NDArray[np.float32],  # of the rays after `stamp`, seconds, shape (n,)
        rings: npt.NDArray[np.uint16],  # channels of the rays, shape (n,)
        samples: Floats,
    ) -> TrackingResult:
        """Process samples and the next scan; return the pose of the lidar.

        It is that of this scan, or of one `_SCANS_LATE` before, in the lidar's frame at the first.

        Args:
            points: Each in the lidar's frame at the time of its ray, metres, shape (n, 3).
            samples: Of the IMU up to the last ray, since the last call: stamp (ns), angular
                velocity, specific force; shape (m, 7).
        """
        types, pipeline = self._types, self._pipeline
        for time, *sample in samples.tolist():
            gyro, force = (np.array(vector) * (1, -1, -1) for vector in (sample[:3], sample[3:]))
            pipeline.add_imu(types.ImuMeasurement(types.Stamp.from_nsec(int(time)), gyro, force))
        near, far = self._limits
        distances = np.linalg.norm(points, axis=1)
        usable = (distances > near) & (distances < far)  # and so no NaN
        if (count := int(usable.sum())) < self._min_points:
            return self._lost(f"{count} points, expected {self._min_points}")
        cloud = self._cloud(points, times, rings, usable)
        pipeline.add_lidar(types.LidarMeasurement(types.Stamp.from_nsec(stamp), cloud))
        poses = [pose for at, pose in pipeline.saved_estimates() if at.to_nsec() == stamp]
        pose = poses[-1].to_mat() if poses else np.full((4, 4), np.nan)
        if not np.isfinite(pose).all():
            return self._lost("no finite pose was found")
        lidar = pose @ self._imu_from_lidar
        if self._early:
            self._early -= 1
            self._origin = np.linalg.inv(lidar)
        self._pose = _UP @ self._origin @ lidar @ _UP
        return TrackingResult(pose=self._pose)

    def _lost(self, reason: str) -> TrackingResult:
        return TrackingResult(pose=self._pose, lost=True, reason=reason)

    def _cloud(
        self,
        points: npt.NDArray[np.float32],
        times: npt.NDArray[np.float32],
        rings: npt.NDArray[np.uint16],
        usable: npt.NDArray[np.bool_],
    ) -> list[Any]:
        """Return the scan in evalio's order, row by row; a ray without a point is the origin.

        KISS-ICP gets the rays in the order of time, as from a lidar: a voxel keeps its first
        points, which would all be of the upper rings.
        """
        rows, columns = self._lidar.channels, self._lidar.columns
        step = 1.0 / (self._lidar.rate * columns)
        make, duration = self._types.Point, self._types.Duration
        column = np.clip(np.rint(times / step).astype(int), 0, columns - 1)
        grid = np.zeros((rows, columns, 3))
        grid[rings[usable], column[usable]] = points[usable] * (1, -1, -1)
        ranges = (1000.0 * np.linalg.norm(grid, axis=2)).astype(int).tolist()
        offsets = [duration.from_sec(k * step) for k in range(columns)]
        cloud = [
            make(x=x, y=y, z=z, t=offsets[col], range=ranges[row][col], row=row, col=col)
            for row, line in enumerate(grid.tolist())
            for col, (x, y, z) in enumerate(line)
        ]
        if self._by_time:
            return [point for col in range(columns) for point in cloud[col::columns]]
        return cloud


def _checked(config: EvalioConfig, defaults: dict[str, Any]) -> dict[str, Any]:
    """Return the given parameters in the types of the defaults.

    Raises:
        ValueError: The pipeline has no such parameter, or one of another type.
    """
    allowed = {name: value for name, value in defaults.items() if name not in _FIXED}
    checked = {}
    for name, value in config.parameters.items():
        if name not in allowed:
            raise ValueError(
                f"parameters.{name}: expected one of {config.pipeline}'s: {', '.join(allowed)}"
                + suggest(name, allowed)
            )
        kind = type(allowed[name])
        if type(value) is not kind and (kind, type(value)) != (float, int):
            raise ValueError(f"parameters.{name}: expected {kind.__name__}, found {value!r}")
        checked[name] = kind(value)
    return checked


class Evalio(Estimator[EvalioConfig]):
    """Estimates the pose of a lidar by a pipeline of evalio, in a process of its own.

    E. Potokar, M. Kaess, "A Comprehensive Evaluation of LiDAR Odometry Techniques", 2025.
    """

    needs = frozenset({"lidar"})
    lenses = frozenset()
    library = "evalio", INSTALL

    frames = Input(LidarScan, keep="latest")

    def __init__(self) -> None:
        self.method = f"{self.config.pipeline} (evalio)"
        self.inertial = self.config.pipeline in _INERTIAL
        self._samples: deque[Imu] = deque()

    def exposed_at(self, image: Event) -> int:
        """Return the time of the pipeline's pose within a scan (ns)."""
        start = image.stamp
        return start + round(self.config.time_of_pose() * (super().exposed_at(image) - start))

    @on(Imu)
    def imu(self, event: Imu) -> None:
        """Store samples until the next scan."""
        if self.inertial:
            self._samples.append(event)

    def check(self) -> Iterable[str]:
        """Yield an error for a missing sensor or library; in a mere check, for wrong parameters."""
        yield from super().check()
        if not self.checking or not self.config.parameters:
            return
        try:
            from evalio import pipelines

            library: Any = pipelines
            _checked(self.config, library.get_pipeline(self.config.pipeline).default_params())
        except ImportError:
            return  # which is said already
        except ValueError as error:
            yield str(error)

    async def on_ready(self) -> None:
        """Start the pipeline, in a process of its own."""
        arguments = self.config, self.the_lidar(), self.imu_announcement
        self._pipeline = await self.start_tracker(EvalioProcess, *arguments)

    async def run(self) -> None:
        """Track each scan; estimates start with the first scan of enough points."""
        samples = self._samples
        tracked = deque[LidarScan](maxlen=1 + _SCANS_LATE.get(self.config.pipeline, 0))
        async for scan in self.frames:
            past = []
            while samples and samples[0].stamp <= scan.end:
                past.append(samples.popleft())
            args = scan.stamp, scan.points, scan.times, scan.rings, sample_rows(past)
            result = await self._pipeline.call(EvalioProcess.track, *args)
            if not result.lost:
                tracked.append(scan)
            if len(tracked) == tracked.maxlen:
                self.publish(scan if result.lost else tracked[0], result)
