"""Announcements of the sources a node will provide, sent once before the first event.

Bridges build publishers from these, estimators their calibration, reports their tables.
"""

from __future__ import annotations

from events.base import Category, Event, Quaternion, Vector3, check, check_pose
from events.camera_info import CameraInfo
from events.estimates import TrackedFeatures

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""The matrix of a sensor without errors of scale and alignment, row by row."""


class Announcement(Event, category=Category.ANNOUNCEMENT):
    """Base of all announcements; `source` is the announced name.

    The announcing node may send in this name, and in those below it. This class itself says no
    more; with the source ``*``, it is for all names that no other node announces.
    """

    def __post_init__(self) -> None:
        check(self)


class VehicleAnnouncement(Announcement):
    """A vehicle controlled by set-points.

    Attributes:
        mass: Kilograms.
        max_thrust: Newtons, all motors together.
        control_rate: Rate of its controller, hertz.
        position: At the start, metres in ``map``.
        orientation: Rotation from body to ``map`` at the start.
    """

    mass: float
    max_thrust: float
    control_rate: float
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, (self.mass, self.max_thrust, self.control_rate))


class CameraAnnouncement(Announcement):
    """A camera and its place on a body.

    Attributes:
        images: What it gives: ``rgb``, ``grey``, ``depth``, ``segmentation``.
        info: Intrinsics; the same for all its images.
        rate: Frames per second.
        latency: Seconds from exposure to delivery.
        exposure: Seconds that the shutter is open, half of them before the stamp; the longest, if
            the camera chooses it.
        readout: Seconds from the first row's exposure to the last row's; 0 is a global shutter.
            `stamp` is that of the middle row: row v of an image with h rows is exposed at
            ``stamp + readout · (v / (h - 1) - 1/2)``.
        time_offset: Seconds by which the images' stamps are late on the clock of the IMU and the
            ground truth: what is stamped t was exposed at ``t - time_offset``. (Kalibr's
            ``timeshift_cam_imu`` is its negative.)
        time_jitter: Greatest random error of the stamps besides, seconds, either way.
        noise: Standard deviation of the images' noise at middle grey (128), grey levels; at gain 1
            if the camera chooses it.
        full_well: Electrons of a white pixel at gain 1, whose number has a Poisson distribution
            (shot noise); 0 if the noise is the same at all grey levels.
        reference_exposure: Exposure time, seconds, at which an image of gain 1 is as bright as its
            scene is drawn; 0 if brightness does not depend on the exposure time.
        response: Light of each of the 256 grey levels, as a ``pcalib.txt`` of TUM's monoVO data
            set has it: rising, of any scale. Empty: that of sRGB (`events.camera_info`).
        vignette: Coefficients a1, a2, … of the share of light ``1 + a1 r² + a2 r⁴ + …`` at the
            distance r from the principal point, in halves of the image's diagonal.
        depth_noise: k in ``sigma = k z²``, the standard deviation of depth z, 1/m.
        depth_step: k in ``step = k z²``, the distance between two values that depth can have, 1/m.
        min_depth: Metres; what is nearer has no depth.
        max_depth: Metres; what is farther has no depth. 0: no limit.
        baseline: Of the right camera of a stereo rig, metres to the left one; 0 of all others.
        stereo: Source of the left camera of that rig; empty of all others.
        undistorted: Source of the camera whose images these are, without distortion; empty if
            these are a camera's own.
        frame_id: Optical frame, as in its images.
        parent_frame_id: Frame it is mounted on; ``map`` for a free camera.
        position: The camera in the parent frame, metres.
        orientation: Rotation from the **optical** frame to the parent frame.
    """

    images: tuple[str, ...]
    info: CameraInfo
    rate: float
    latency: float
    exposure: float = 0.0
    readout: float = 0.0
    time_offset: float = 0.0
    time_jitter: float = 0.0
    noise: float = 0.0
    full_well: float = 0.0
    reference_exposure: float = 0.0
    response: tuple[float, ...] = ()
    vignette: tuple[float, ...] = ()
    depth_noise: float = 0.0
    depth_step: float = 0.0
    min_depth: float = 0.0
    max_depth: float = 0.0
    baseline: float = 0.0
    stereo: str = ""
    undistorted: str = ""
    frame_id: str
    parent_frame_id: str
    position: Vector3
    orientation: Quaternion

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, (self.rate, self.latency, self.exposure))
        check(self, (self.readout, self.time_offset, self.time_jitter))
        check(self, (self.noise, self.baseline, 0.0))
        check(self, (self.full_well, self.reference_exposure, 0.0))
        check(self, (self.depth_noise, self.depth_step, 0.0))
        check(self, (self.min_depth, self.max_depth, 0.0))


class ImuAnnouncement(Announcement):
    """An IMU and its noise model (continuous-time densities, as in Kalibr's files).

    A measurement is matrix · truth + bias + white noise (and what `vibration` says), cut off at its
    range, in steps of its resolution.

    Attributes:
        rate: Hertz.
        frame_id: Frame of the measurements.
        gyroscope_noise_density: rad/s/√Hz.
        gyroscope_random_walk: rad/s²/√Hz.
        accelerometer_noise_density: m/s²/√Hz.
        accelerometer_random_walk: m/s³/√Hz.
        gyroscope_turn_on_bias: Standard deviation of the bias at the start, rad/s.
        accelerometer_turn_on_bias: Standard deviation of the bias at the start, m/s².
        gyroscope_matrix: Scale and misalignment, 9 numbers, row by row.
        accelerometer_matrix: Scale and misalignment, 9 numbers, row by row.
        g_sensitivity: Angular velocity that an acceleration feigns, rad/s per m/s².
        gyroscope_range: Greatest angular velocity, rad/s; 0 is no limit.
        accelerometer_range: Greatest acceleration, m/s²; 0 is no limit.
        gyroscope_resolution: Step, rad/s; 0 is none.
        accelerometer_resolution: Step, m/s²; 0 is none.
        vibration: Amplitude of the rotors' vibration at full thrust, m/s², its noise as at half of
            it included; 0 is none.
        averaged: True if a measurement is the mean since the one before, as of delta angles and
            delta velocities; False if it is that of its stamp.
        parent_frame_id: Frame that it is mounted on.
        position: The IMU in the parent frame, metres.
        orientation: Rotation from its frame to the parent frame.
    """

    rate: float
    frame_id: str
    gyroscope_noise_density: float
    gyroscope_random_walk: float
    accelerometer_noise_density: float
    accelerometer_random_walk: float
    gyroscope_turn_on_bias: float = 0.0
    accelerometer_turn_on_bias: float = 0.0
    gyroscope_matrix: tuple[float, ...] = IDENTITY
    accelerometer_matrix: tuple[float, ...] = IDENTITY
    g_sensitivity: float = 0.0
    gyroscope_range: float = 0.0
    accelerometer_range: float = 0.0
    gyroscope_resolution: float = 0.0
    accelerometer_resolution: float = 0.0
    vibration: float = 0.0
    averaged: bool = False
    parent_frame_id: str = "base_link"
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        for matrix in (self.gyroscope_matrix, self.accelerometer_matrix):
            check(self, matrix[:3], matrix[3:6], matrix[6:])


class SensorAnnouncement(Announcement):
    """Base of the other sensors' announcements.

    Attributes:
        rate: Hertz.
        latency: Seconds from the measurement to its delivery.
        frame_id: Frame of the measurements.
        parent_frame_id: Frame that it is mounted on.
        position: The sensor in the parent frame, metres.
        orientation: Rotation from the sensor's frame to the parent frame.
    """

    rate: float
    latency: float = 0.0
    frame_id: str = "base_link"
    parent_frame_id: str = "base_link"
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_pose(self, self.position, self.orientation)
        check(self, (self.rate, self.latency, 0.0))


class BarometerAnnouncement(SensorAnnouncement):
    """A barometer; its measurements are sent as `FluidPressure`.

    Attributes:
        noise: Standard deviation of the white noise, pascal.
        altitude: Altitude of the origin of ``map`` above sea level, metres.
        drift: Standard deviation of the slow error, relative to the pressure.
        drift_time: Time constant of the slow error, seconds.
    """

    noise: float
    altitude: float
    drift: float = 0.0
    drift_time: float = 0.0


class NavSatAnnouncement(SensorAnnouncement):
    """A satellite receiver; its fixes are sent as `NavSatFix`.

    Attributes:
        latitude: Degrees north, of the origin of ``map``.
        longitude: Degrees east, of the origin of ``map``.
        altitude: Metres above the WGS 84 ellipsoid, of the origin of ``map``.
        horizontal_noise: Standard deviation of the white noise, north and east, metres.
        vertical_noise: Standard deviation of the white noise, down, metres.
        horizontal_drift: Standard deviation of the slow error, north and east, metres.
        vertical_drift: Standard deviation of the slow error, down, metres.
        drift_time: Time constant of the slow error, seconds.
        velocity_noise: Standard deviation of the velocity's white noise, metres per second.
    """

    latitude: float
    longitude: float
    altitude: float
    horizontal_noise: float
    vertical_noise: float
    horizontal_drift: float = 0.0
    vertical_drift: float = 0.0
    drift_time: float = 0.0
    velocity_noise: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, (self.latitude, self.longitude, self.altitude))


class MagnetometerAnnouncement(SensorAnnouncement):
    """A magnetometer; its measurements are sent as `MagneticField`.

    Attributes:
        noise: Standard deviation of the white noise of each axis, tesla.
        field: Of the earth at the origin of ``map``, tesla in ``map``.
        bias: Greatest constant error of each axis, tesla.
    """

    noise: float
    field: Vector3
    bias: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, self.field)


class RangeAnnouncement(SensorAnnouncement):
    """A range finder along the x axis of its frame; its measurements are sent as `Range`.

    Attributes:
        noise: Standard deviation of the white noise, metres.
        min_range: Metres.
        max_range: Metres.
        field_of_view: Radians; 0 of a single ray.
    """

    noise: float
    min_range: float
    max_range: float
    field_of_view: float = 0.0


class LidarAnnouncement(SensorAnnouncement):
    """A lidar; each turn is sent as a `LidarScan`.

    Attributes:
        channels: Number of its rings, or of the rays of one column.
        columns: Directions of each ring in a turn.
        horizontal_fov: Radians.
        elevations: Lowest and highest ray above the sensor's x-y plane, radians.
        noise: Standard deviation of the white noise along the ray, metres.
        min_range: Metres.
        max_range: Metres.
    """

    channels: int
    columns: int
    horizontal_fov: float
    elevations: tuple[float, float]
    noise: float
    min_range: float
    max_range: float


class WindAnnouncement(Announcement):
    """Wind at a vehicle, sent as `Wind`; `source` is ``world/vehicle``.

    Attributes:
        rate: Hertz of the events.
        velocity: Mean of the wind without gusts and turbulence, m/s in ``map``.
        turbulence: Wind at a height of 20 feet by which its strength is given, m/s; 0 for none.
    """

    rate: float
    velocity: Vector3
    turbulence: float = 0.0

    def __post_init__(self) -> None:
        check(self, self.velocity, (self.rate, self.turbulence, 0.0))


class BodyAnnouncement(Announcement):
    """A body moving by itself in the world; its true pose is sent as `PoseStamped`.

    Attributes:
        kind: Kind in a word: ``person``, ``car``, ``door``.
        object_ids: Its numbers in a `SegmentationImage`: these pixels are its mask.
    """

    kind: str
    object_ids: tuple[int, ...]


class PilotAnnouncement(Announcement):
    """A node sending commands or set-points; `source` is their source.

    Attributes:
        vehicle: Name of its vehicle; empty if not given, which is refused where there are several.
    """

    vehicle: str = ""


class PathAnnouncement(Announcement):
    """Planned path of a pilot; a simulator refuses a path not free of obstacles.

    Attributes:
        waypoints: Places to pass in this order, metres in ``map``; at first the vehicle climbs from
            where it stands to the height of the first one.
        margin: Distance along each axis that the vehicle may move to and fro before it sets off,
            metres.
        vehicle: Name of the vehicle; empty for the only one.
    """

    vehicle: str = ""
    waypoints: tuple[Vector3, ...]
    margin: float = 0.0


class EstimatorAnnouncement(Announcement):
    """An estimator of poses; `source` is the source of its estimates.

    Attributes:
        method: Name in a word or two: ``features``, ``ORB-SLAM3 rgbd``.
        scale_free: True if its unit of length is its own (monocular).
        reads: Kinds of input data: ``grey``, ``depth``, ``imu``, ``lidar``; ``truth`` if made from
            ground truth, as of an estimator for studies.
        eyes: Number of cameras whose images are used together: 2 is a stereo rig.
        lenses: Supported distortion models, besides an ideal camera.
        rectifies: Whether images of other lenses are first rectified to a pinhole camera.
        vehicle: Name of the estimated vehicle, where neither `source` nor the camera followed
            says so.
        cameras: Sources of the cameras or lidars that it reads, as far as they are known when it is
            announced: those named in the file.
    """

    method: str
    scale_free: bool = False
    reads: tuple[str, ...] = ()
    eyes: int = 1
    lenses: tuple[str, ...] = ()
    rectifies: bool = False
    vehicle: str = ""
    cameras: tuple[str, ...] = ()


class Vehicles:
    """Vehicles of a run, and the sources of each.

    A source belongs to the vehicle whose name it equals or begins with: ``drone/camera`` to
    ``drone``. An estimator with another name belongs to the vehicle that it announces, or that
    carries the camera in whose images it tracks features; any other source belongs to the first
    vehicle.
    """

    def __init__(self) -> None:
        self.names: list[str] = []  # names of the vehicles, in the order of their announcements
        self._cameras: dict[str, str] = {}
        self._followed: dict[str, str] = {}
        self._estimated: dict[str, str] = {}

    def announced(self, announcement: Announcement) -> None:
        """Note a vehicle, a camera or an estimator."""
        if isinstance(announcement, VehicleAnnouncement):
            self.add(announcement.source)
        elif isinstance(announcement, CameraAnnouncement):
            self._cameras.setdefault(announcement.frame_id, announcement.source)
        elif isinstance(announcement, EstimatorAnnouncement):
            self._estimated[announcement.source] = announcement.vehicle

    def add(self, name: str) -> None:
        """Note a vehicle."""
        if name not in self.names:
            self.names.append(name)

    def tracked(self, event: TrackedFeatures) -> None:
        """Note whose images an estimator looks at."""
        self._followed[event.source] = event.frame_id

    def camera_of(self, source: str) -> str:
        """Return the camera in whose images an estimator tracks features; empty if unknown."""
        return self._cameras.get(self._followed.get(source, ""), "")

    def carrier(self, source: str) -> str:
        """Return the vehicle named in a source; empty if there is none."""
        vehicles = (v for v in self.names if source == v or source.startswith(f"{v}/"))
        return next(vehicles, "")

    def of(self, source: str) -> str:
        """Return the vehicle of a source; empty if there are no vehicles."""
        camera = self.camera_of(source)
        vehicle = self._estimated.get(source, "") or self.carrier(source)
        return vehicle or self.carrier(camera) or next(iter(self.names), "")
