"""Readings, estimates and recordings of scripts.

Scripts read the newest sample of a vehicle's node, publish estimated poses to be judged (a method
that AirSim lacks), and record images and true poses in the format of AirSim 1.8.1's
``RecordingFile`` and ``FileSystem``.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec.structs import astuple
from scipy.spatial.transform import Rotation, Slerp

import events as ev
from events import Quaternion, Vector3, announcements, sensors
from events.frames import inverse, multiply, normalize, rotate
from runtime.node import Node
from runtime.time.clock import SECOND
from runtime.units import Duration
from sims.cameras import GraphicsError
from sims.sensors.sensor import altitude_at
from sims.vehicle import TIMESTEP_NS
from sims.world import SharedWorld
from visnav_airsim import wire
from visnav_airsim.server.cameras import Cameras, Images
from visnav_airsim.server.methods import Caller, RpcError, rpc
from visnav_airsim.server.vehicles import FIRST, ServedMultirotor, ServedVehicle, Vehicles
from visnav_airsim.wire import GeoPoint, ImageRequest, ImageResponse, Pose, Quaternionr, Vector3r

SAMPLES = (
    *(sensors.Imu, sensors.FluidPressure, sensors.MagneticField),
    *(sensors.NavSatFix, sensors.Range, sensors.LidarScan),
)  # events that are samples of sensors

GAUSS = 1e-4  # tesla
MOST_UNCERTAIN_2D = 4.0  # metres up to which AirSim's receiver has a fix in the plane
NORMS = 0.99, 1.01  # of a client's quaternion: float32, and sums of small rotations
LEAST_INTERVAL = 1e-3  # seconds: the step of physics
STILL = 1e-3  # what position (m) and quaternion of a vehicle that stands may have changed by

HEADER = "VehicleName TimeStamp POS_X POS_Y POS_Z Q_W Q_X Q_Y Q_Z ImageFile".replace(" ", "\t")


class Sensors:
    """Sensors of all vehicles, by their announcements; all numbers are 0 before a first sample.

    Args:
        world: Keeps the poses of vehicles while a lidar turns.
        names: Names of vehicles' sensors by those by which scripts call them.
        lidar_frame: Frame of lidars' points, as AirSim's ``DataFrame``.
    """

    def __init__(
        self, vehicles: Vehicles, world: SharedWorld, names: Mapping[str, str], lidar_frame: str
    ) -> None:
        self._vehicles, self._world = vehicles, world
        self._names, self._lidar_frame = names, lidar_frame
        self._announced: dict[str, ev.Announcement] = {}
        self._newest: dict[str, Any] = {}
        self._orientations: dict[str, Quaternionr] = {}

    def announced(self, announcement: ev.Announcement) -> None:
        """Store the announcement of a vehicle's sensor."""
        vehicle = self._vehicles.get(announcement.source.partition("/")[0])
        if isinstance(vehicle, ServedMultirotor):
            self._announced[announcement.source] = announcement
            if isinstance(announcement, announcements.LidarAnnouncement):
                # A turn, and one until the next is there.
                self._world.remember(2.1 / announcement.rate + announcement.latency)

    def add_sample(self, sample: ev.Event) -> None:
        """Store a sample, and with an IMU's the true orientation at its stamp."""
        if sample.source in self._announced:
            self._newest[sample.source] = sample
            if isinstance(sample, sensors.Imu):
                vehicle = self._vehicles.find_multirotor(sample.source.partition("/")[0])
                turn = Quaternionr(*vehicle.physics.state().orientation)
                self._orientations[sample.source] = turn

    @rpc("getImuData")
    def imu(self, name: str, vehicle: ServedMultirotor = FIRST) -> wire.ImuData:
        """Return the newest sample of an IMU, with the true orientation at its stamp."""
        sensor, sample = self._read(announcements.ImuAnnouncement, "IMU", name, vehicle)
        if sample is None:
            return wire.ImuData(orientation=Quaternionr(*vehicle.state().orientation))
        return wire.ImuData(
            sample.stamp,
            self._orientations[sensor.source],
            Vector3r(*sample.angular_velocity),
            Vector3r(*sample.linear_acceleration),
        )

    @rpc("getBarometerData")
    def barometer(self, name: str, vehicle: ServedMultirotor = FIRST) -> wire.BarometerData:
        """Return the newest pressure of a barometer, and the altitude at QNH 1013.25 hPa."""
        _, sample = self._read(announcements.BarometerAnnouncement, "barometer", name, vehicle)
        if sample is None:
            return wire.BarometerData()
        pressure = sample.fluid_pressure
        return wire.BarometerData(sample.stamp, altitude_at(pressure), pressure)

    @rpc("getMagnetometerData")
    def magnetometer(self, name: str, vehicle: ServedMultirotor = FIRST) -> wire.MagnetometerData:
        """Return the newest field of a magnetometer, Gauss; the covariance is empty."""
        kind = announcements.MagnetometerAnnouncement
        _, sample = self._read(kind, "magnetometer", name, vehicle)
        if sample is None:
            return wire.MagnetometerData()
        field = Vector3r(*(component / GAUSS for component in sample.magnetic_field))
        return wire.MagnetometerData(sample.stamp, field)

    @rpc("getGpsData")
    def gps(self, name: str, vehicle: ServedMultirotor = FIRST) -> wire.GpsData:
        """Return the newest fix of ``gps``, alias ``gnss``; `eph` and `epv` are deviations."""
        name = "gnss" if name == "gps" else name
        _, fix = self._read(announcements.NavSatAnnouncement, "gps", name, vehicle)
        if fix is None:
            return wire.GpsData()
        covariance = fix.position_covariance or (0.0,) * 9
        eph, epv = math.sqrt(covariance[0]), math.sqrt(covariance[8])
        fix_type = 3 if fix.status >= 0 else 2 if eph <= MOST_UNCERTAIN_2D else 0
        place = GeoPoint(fix.latitude, fix.longitude, fix.altitude)
        velocity = Vector3r(*fix.velocity)
        report = wire.GnssReport(place, eph, epv, velocity, fix_type, fix.stamp // 1000)
        return wire.GpsData(fix.stamp, report, is_valid=True)

    @rpc("getDistanceSensorData")
    def distance(self, name: str, vehicle: ServedMultirotor = FIRST) -> wire.DistanceSensorData:
        """Return the newest range of a range finder; its limits if nothing or too much is near."""
        sensor, sample = self._read(
            announcements.RangeAnnouncement, "distance sensor", name, vehicle
        )
        low, high = sensor.min_range, sensor.max_range
        distance = 0.0 if sample is None else min(max(sample.range, low), high)
        return wire.DistanceSensorData(
            0 if sample is None else sample.stamp,
            distance,
            low,
            high,
            Pose(Vector3r(*sensor.position), Quaternionr(*sensor.orientation)),
        )

    @rpc("getLidarData")
    def lidar(
        self, caller: Caller, name: str, vehicle: ServedMultirotor = FIRST
    ) -> wire.LidarData | wire.CosysLidarData:
        """Return the newest whole turn of a lidar, channel by channel, freed of the motion's skew.

        Each ray is placed by its own time; stamp and pose are of the first. `segmentation` is -1,
        and Cosys' `groundtruth` is empty text, for all points.
        """
        sensor, scan = self._read(announcements.LidarAnnouncement, "lidar", name, vehicle)
        is_cosys = caller.flavour == "cosys"
        if scan is None:
            return wire.CosysLidarData() if is_cosys else wire.LidarData()
        places, turns = _poses(vehicle.physics, sensor, scan)
        places -= vehicle.origin
        steps = scan.times.astype(np.float64) / (TIMESTEP_NS * 1e-9)
        # As `sims.sensors.lidar` takes them: the place of the nearest millisecond.
        points = scan.points.astype(np.float64)
        if len(points):
            between = Slerp(np.arange(len(places)), turns)(np.minimum(steps, len(places) - 1))
            points = places[np.rint(steps).astype(np.intp)] + between.apply(points)
        if self._lidar_frame == "SensorLocalFrame":
            points = turns[0].inv().apply(points - places[0])
        cloud = wire.float_array(points[np.argsort(scan.rings, kind="stable")])
        turn = turns[0].as_quat(scalar_first=True).tolist()
        pose = Pose(Vector3r(*places[0].tolist()), Quaternionr(*turn))
        if is_cosys:
            return wire.CosysLidarData(scan.stamp, cloud, pose, ("",) * len(points))
        return wire.LidarData(scan.stamp, cloud, pose, (-1,) * len(points))

    def _read(
        self, kind: type, called: str, name: str, vehicle: ServedMultirotor
    ) -> tuple[Any, Any]:
        """Return a sensor (the first, if unnamed) and its newest sample, or raise `RpcError`."""
        name = self._names.get(name, name)
        for source, sensor in self._announced.items():
            carrier, _, sensor_name = source.partition("/")
            if (
                isinstance(sensor, kind)
                and sensor_name
                and (carrier, name or sensor_name) == (vehicle.name, sensor_name)
            ):
                return sensor, self._newest.get(source)
        raise RpcError(f"No {called} with name {name} exist on vehicle")


def _poses(physics: Any, sensor: Any, scan: Any) -> tuple[Any, Rotation]:
    """Return the sensor's pose at each millisecond of a scan: metres in ``map``, shape (n, 3)."""
    places, turns = [], []
    for stamp in range(scan.stamp, scan.end + 2 * TIMESTEP_NS, TIMESTEP_NS):
        state = physics.state_in(*physics.simulation.past(min(stamp, physics.time_ns)))
        places.append(np.add(state.position, rotate(state.orientation, sensor.position)))
        turns.append(multiply(state.orientation, sensor.orientation))
    return np.array(places), Rotation.from_quat(turns, scalar_first=True)


class ScriptEstimator(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Estimator in a client's script, publishing its poses by ``visnavPublishPose``.

    Attributes:
        name: Its name, by which the client publishes; source of its estimates.
        method: Its method, in a word or two, for the report.
        vehicle: The vehicle whose pose it estimates; empty for the first one by name.
        camera: The camera whose poses the client publishes, with AirSim's axes (x forward, y
            right, z down); they become those of the vehicle. Empty: the vehicle's poses.
        frame_id: ``odom``: poses are in a frame of the estimator's own, and aligned by the first
            one. ``map``: they are in the vehicle's local frame, and not aligned.
        scale_free: Whether its unit of length is its own, as that of a single camera is.
        reads: Kinds of data that it computes with: ``grey``, ``depth``, ``imu``, ``lidar``.
    """

    name: str
    method: str = "a script's"
    vehicle: str = ""
    camera: str = ""
    frame_id: Literal["odom", "map"] = "odom"
    scale_free: bool = False
    reads: tuple[str, ...] = ()


class Estimates:
    """Estimates of scripts, published as those of any estimator of the run."""

    def __init__(
        self,
        estimators: Iterable[ScriptEstimator],
        vehicles: Vehicles,
        cameras: Cameras,
        now: Callable[[], int],
        send: Callable[[ev.PoseEstimate], None],
    ) -> None:
        self._vehicles, self._cameras, self._now, self._send = vehicles, cameras, now, send
        self._estimators: dict[str, ScriptEstimator] = {}
        self._last: dict[str, int] = {}
        for estimator in estimators:
            if estimator.name in self._estimators:
                raise ValueError("estimators: expected names of their own, found one twice")
            self._estimators[estimator.name] = estimator
            try:
                self._mount(estimator)
            except RpcError as error:
                raise ValueError(f"estimators: {estimator.name}: {error}") from None

    def announce(self) -> Iterable[ev.EstimatorAnnouncement]:
        """Announce the clients' estimators."""
        for estimator in self._estimators.values():
            yield ev.EstimatorAnnouncement(
                stamp=0,
                source=estimator.name,
                method=estimator.method,
                scale_free=estimator.scale_free,
                reads=estimator.reads,
                vehicle=estimator.vehicle,
            )

    @rpc("visnavPublishPose")
    def publish_pose(self, estimator: str, stamp: int, pose: Pose) -> None:
        """Publish the script's estimated pose at an image's stamp (ns), to be judged.

        Raises:
            RpcError: There is no such estimator; the stamp is later than now, or not later than
                that of the pose before; or the pose is none.
        """
        entry = self._estimators.get(estimator)
        if entry is None:
            names = ", ".join(sorted(self._estimators)) or "none: the setting `estimators` is empty"
            raise RpcError(f"expected an estimator of the settings ({names}), found '{estimator}'")
        last, now = self._last.get(estimator, -1), self._now()
        if not last < stamp <= now:
            raise RpcError(f"expected a stamp after {last} and up to {now} ns, found {stamp}")
        position, orientation = _checked(pose)
        if (mount := self._mount(entry)) is not None:
            offset, turn = mount
            orientation = normalize(multiply(orientation, inverse(turn)))
            position = _sum(position, rotate(orientation, offset), -1.0)
        if entry.frame_id == "map":
            position = _sum(position, self._vehicles.find(entry.vehicle).origin)
        self._last[estimator] = stamp
        self._send(
            ev.PoseEstimate(
                stamp=stamp,
                source=entry.name,
                frame_id=entry.frame_id,
                position=position,
                orientation=orientation,
            )
        )

    def _mount(self, estimator: ScriptEstimator) -> tuple[Vector3, Quaternion] | None:
        """Return the announced mount of its camera; `None` for poses of the vehicle."""
        vehicle = self._vehicles.find(estimator.vehicle)
        if not estimator.camera:
            return None
        return self._cameras.find(vehicle, estimator.camera).announced_eye(0).mount


def _checked(pose: Pose) -> tuple[Vector3, Quaternion]:
    position: Vector3 = astuple(pose.position)
    orientation: Quaternion = astuple(pose.orientation)
    norm = math.hypot(*orientation)
    if not (all(map(math.isfinite, position)) and NORMS[0] <= norm <= NORMS[1]):
        raise RpcError(
            "expected a pose of finite numbers whose orientation is a unit quaternion, "
            f"found {position}, {orientation}"
        )
    return position, normalize(orientation)


def _sum(a: Vector3, b: Vector3, factor: float = 1.0) -> Vector3:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


class RecordedImage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Image to take at each instant of a recording.

    Attributes:
        camera: Name of the camera.
        image_type: AirSim's number of the type.
        pixels_as_float: Whether to write a PFM of one number a pixel.
        compress: Whether to write a PNG, else a PPM.
        vehicle: The vehicle that carries the camera; empty for every vehicle.
    """

    camera: str = "0"
    image_type: int = 0
    pixels_as_float: bool = False
    compress: bool = True
    vehicle: str = ""


class RecordingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of recordings.

    Attributes:
        enabled: Whether one begins with the run, without being asked for.
        on_move: Whether a vehicle is left out while it stands.
        interval: Simulated time between two instants.
        folder: Folder in the run's folder; each recording is a folder in it, named by the date.
        images: What is taken of each vehicle.
    """

    enabled: bool = False
    on_move: bool = False
    interval: Duration = Duration(0.05)  # immutable
    folder: Annotated[str, msgspec.Meta(pattern=r"^[\w-]+\Z")] = "recording"
    images: tuple[RecordedImage, ...] = (RecordedImage(),)

    def __post_init__(self) -> None:
        if self.interval < LEAST_INTERVAL:
            raise ValueError(f"interval: expected at least 1 ms, found {self.interval:g} s")


class Recording:
    """Recordings; a row's pose is that of its images' instant (within 1 ms in real time)."""

    def __init__(
        self, config: RecordingConfig, node: Node[Any], vehicles: Vehicles, images: Images
    ) -> None:
        self._config, self._node, self._vehicles, self._images = config, node, vehicles, images
        self._folder: Path | None = None
        self._failed = ""
        self._last: dict[str, Pose] = {}

    async def begin(self) -> None:
        """Start recording with the run, if the settings say so."""
        try:
            if self._config.enabled and (started := self.start()):
                await started
        except RpcError as error:
            self._node.log.error("%s", error)

    @rpc("startRecording")
    def start(self) -> Awaitable[None] | None:
        """Record the settings' images and true poses into a folder in the run's folder."""
        out = self._node.out
        if out is None:
            raise RpcError("expected a run with a folder of results, found one without")
        if self._folder is not None:
            return None
        self._folder, self._failed = out / self._config.folder, ""
        return self._started(self._folder)

    async def _started(self, base: Path) -> None:
        try:
            await self._images.start()
            folder = await self._node.offload(_make_folder, base)
        except (OSError, GraphicsError) as error:
            self._folder = None
            raise RpcError(f"the recording could not begin: {error}") from None
        if self._folder is base:  # it has not been stopped meanwhile
            self._folder, self._last = folder, {}
            self._node.log.info("recording into %s", folder)
            self._node.start(self._record(folder))

    @rpc("stopRecording")
    def stop(self) -> None:
        """End the recording; raise its error if the recording has failed before."""
        self._folder, failed, self._failed = None, self._failed, ""
        if failed:
            raise RpcError(failed)

    @rpc("isRecording")
    def is_recording(self) -> bool:
        """Return whether images are recorded."""
        return self._folder is not None

    async def _record(self, folder: Path) -> None:
        clock, interval = self._node.clock, round(self._config.interval * SECOND)
        stamp = clock.now()
        while self._folder == folder:
            try:
                for name in sorted(self._vehicles):
                    await self._record_vehicle(self._vehicles[name], folder)
            except (OSError, RpcError) as error:
                self._failed = f"the recording has ended: {error}"
                self._node.log.error("%s", self._failed)
                self._folder = None
                return
            stamp = max(stamp + interval, clock.now())
            await clock.sleep_until(stamp)

    async def _record_vehicle(self, vehicle: ServedVehicle, folder: Path) -> None:
        """Record a vehicle at this instant, while simulated time waits."""
        name, pose = vehicle.name, vehicle.pose()
        before = _numbers(self._last.get(name, Pose(Vector3r(math.inf))))
        if self._config.on_move and np.allclose(_numbers(pose), before, rtol=0.0, atol=STILL):
            return
        self._last[name] = pose
        requests = [
            ImageRequest(image.camera, image.image_type, image.pixels_as_float, image.compress)
            for image in self._config.images
            if image.vehicle in {"", name}
        ]

        async def wait_for(images: Awaitable[msgspec.Raw]) -> msgspec.Raw:
            return await images

        if requests:
            # The colours of this flavour are RGB.
            work = wait_for(self._images.capture(requests, vehicle, "cosys"))
            loop = asyncio.get_running_loop()
            images = await self._node.clock.beside(asyncio.run_coroutine_threadsafe(work, loop))
            await self._node.offload(_write, folder, name, pose, images)


def _make_folder(base: Path) -> Path:
    """Make a folder named by the date, with an empty table, and return its path."""
    date = time.strftime("%Y-%m-%d-%H-%M-%S")
    names = (date, *(f"{date}-{number}" for number in range(2, 1000)))
    folder = next(base / name for name in names if not (base / name).exists())
    (folder / "images").mkdir(parents=True)
    (folder / "airsim_rec.txt").write_text(f"{HEADER}\n", encoding="utf-8")
    return folder


def _write(folder: Path, vehicle: str, pose: Pose, encoded: msgspec.Raw) -> None:
    images = msgspec.msgpack.decode(encoded, type=list[ImageResponse])
    names = []
    for image in images:
        suffix = "pfm" if image.pixels_as_float else "png" if image.compress else "ppm"
        camera = re.sub(r"[^\w-]", "_", image.camera_name)
        name = f"img_{vehicle}_{camera}_{image.image_type}_{image.time_stamp}.{suffix}"
        (folder / "images" / name).write_bytes(_file(image, suffix))
        names.append(name)
    stamp = images[0].time_stamp // 1_000_000
    row = [vehicle, stamp, *(f"{number:.9g}" for number in _numbers(pose)), ";".join(names)]
    with (folder / "airsim_rec.txt").open("a", encoding="utf-8") as table:
        table.write("\t".join(map(str, row)) + "\n")


def _numbers(pose: Pose) -> tuple[float, ...]:
    return *astuple(pose.position), *astuple(pose.orientation)


def _file(image: ImageResponse, suffix: str) -> bytes:
    """Return an image as file content; a PFM has rows from top to bottom, as AirSim's."""
    size = f"{image.width} {image.height}\n"
    if suffix == "pfm":
        numbers = np.array(image.image_data_float, "<f4")
        return f"Pf\n{size}-1\n".encode() + numbers.tobytes()
    header = f"P6\n{size}255\n".encode() if suffix == "ppm" else b""
    return header + image.image_data_uint8
