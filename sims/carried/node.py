"""A body with sensors, carried along a recorded motion, as a node: its settings and timing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec

import events as ev
from events import Vector3
from events.frames import yaw_of
from runtime import Duration, Tick
from runtime.paths import InputPath
from runtime.recorded import MotionError, MotionFile, WorldAxes, read_motion
from sims.cameras import add_camera, add_free_body
from sims.carried.clearance import Clearance
from sims.carried.motion import BodyAxes, CarriedMotion, axes_of, rows_of
from sims.carried.placing import Placement, eased, find_place, placed
from sims.carried.spline import MotionSpline, fit
from sims.carried.survey import collision, in_time, in_words, survey
from sims.sensors.platform import FRAME, PlatformConfig, SensorPlatform
from sims.vehicle.autopilot import show
from sims.world import SharedWorld
from sims.worlds import Dynamics, Scene

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]
HARDEST = 500.0  # m/s², what nothing carried does: the file has other units, or a jump
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class CarriedConfig(PlatformConfig):
    """Settings of a carried body, besides those of its sensors.

    Attributes:
        trajectory: File with poses and stamps, in a format that ``judge`` reads (TUM, EuRoC, TUM
            VI, KITTI and others), a bag, or the folder of a run, whose ground truth is followed.
        topic: Of a bag; of a table of several vehicles, the vehicle.
        times: File of the stamps of poses without any, such as KITTI's.
        columns: Meaning of a text file's columns, a word each, such as ``sec x y z qw qx qy qz``.
        axes: Axes of the recorded world: ``ned``, ``nwu`` (z up), ``enu``, or ``optical``, of a
            camera that looks ahead; also of the body, unless it is ``nwu``. ``auto``: what the file
            declares, or such files have as a rule.
        body: Axes of the recorded body: ``frd``, ``flu``, ``optical``, or ``euroc`` (x up, y right,
            z ahead). ``auto``: what the file or `axes` says, else by which of them points down.
        lever: The recorded point on the body, metres forward, right, down of its origin.
        knots: Interval of the spline's knots; what is quicker than two of them is smoothed.
        rest: Time at rest before the motion, which then sets in smoothly.
        place: ``fit``: where the motion has the most clearance. ``recorded``: as it stands in the
            file. Or ``{ position, heading, scale }`` of its start.
        speed: Speed of the playback; 0.5 is half as fast, and all that the IMU feels is as then.
        margin: Distance of a solid, metres, below which the run warns.
        thrust: Thrust of imagined rotors, 0 to 1, for the IMU's vibration; none while at rest.
    """

    trajectory: InputPath = ""
    topic: str = ""
    times: InputPath = ""
    columns: str = ""
    axes: WorldAxes = "auto"
    body: Literal["auto"] | BodyAxes = "auto"
    lever: Vector3 = (0.0, 0.0, 0.0)
    knots: Duration = Duration(0.05)  # immutable
    rest: Duration = Duration(2.5)
    place: Literal["fit", "recorded"] | Placement = "fit"
    speed: Positive = 1.0
    margin: NonNegative = 0.3
    thrust: Share = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.trajectory:
            raise ValueError("trajectory: expected a file, a bag or a run, found none")
        if not self.knots:
            raise ValueError("knots: expected an interval above 0, found 0")


class Carried(SensorPlatform[CarriedConfig]):
    """Cameras, an IMU and other sensors, carried along a recorded motion, with ground truth.

    The motion is a smooth curve through the recorded poses, placed in the world. The body has no
    motors, obeys nobody, and passes through what moves. The run ends with the motion. Ground truth
    is sent as `odometry` and `camera_poses`, without noise.
    """

    ends_run = "plan"

    async def join(self, world: SharedWorld) -> CarriedMotion:
        """Read the motion, place it in the world, and refuse one that cannot be followed."""
        self.doing = "fitting the motion"
        try:
            self._spline = await self.offload(self._prepared, world)
        except ValueError as error:
            raise MotionError(str(error)) from None
        self.doing = ""
        self._carried = CarriedMotion(
            world,
            self.name,
            self._spline,
            self.config.imu,
            float(self.config.rest),
            self.config.thrust,
        )
        world.starts.setdefault(self.name, self._carried.state(0))
        return self._carried

    def _prepared(self, world: SharedWorld) -> MotionSpline:
        config = self.config
        recorded = read_motion(
            MotionFile(
                path=config.trajectory,
                part=config.topic,
                times=config.times,
                columns=config.columns,
                axes=config.axes,
            )
        )
        axes = axes_of(recorded) if config.body == "auto" else config.body
        rows = eased(rows_of(recorded, axes, config.lever, config.speed), config.rest)
        clearance = Clearance(world.model)
        place = find_place(rows, clearance) if config.place == "fit" else config.place
        if isinstance(place, Placement):
            rows = placed(rows, place)
        spline, report = fit(rows, config.knots)
        points = [(0.0, 0.0, 0.0), *(camera.position for camera in config.cameras)]
        moving = Clearance(world.model, world.dynamics)
        result = survey(spline, clearance, moving, points, config.margin)
        start = spline.at(spline.start_ns)
        for note in recorded.notes:
            self.log.warning("trajectory: %s", note)
        self.log.info(
            "trajectory: from %s, heading %.0f° (recorded body: %s)",
            show(_rounded(start.position)),
            math.degrees(yaw_of(start.orientation)),
            axes,
        )
        for line in in_words(len(recorded.stamps), report, result):
            self.log.info("trajectory: %s", line)
        if result.acceleration > HARDEST:
            raise ValueError(
                f"trajectory, speed: expected accelerations of up to {HARDEST:g} m/s², found "
                f"{result.acceleration:.3g} m/s²"
            )
        if 0.0 < config.imu.accelerometer_range < result.acceleration:
            self.log.warning("imu: some accelerations are beyond the range of the accelerometer")
        if 0.0 < config.imu.gyroscope_range < result.rate:
            self.log.warning("imu: some angular velocities are beyond the range of the gyroscope")
        if config.imu.vibration.shakes and not config.thrust:
            self.log.warning("thrust: 0, so that the IMU does not vibrate as its settings have it")
        if inside := collision(result):
            raise ValueError(f"place: expected a free way, found it {inside}")
        for near in (result.near, result.met):
            if near:
                self.log.warning("margin: nearer than %g m: %s", config.margin, in_time(near))
        return spline

    @classmethod
    def populate(cls, scene: Scene, name: str, config: Any) -> Dynamics:
        """Put the body and its cameras into the world; without a shape, so that none sees it."""
        add_free_body(scene.spec, f"{name}/{FRAME}", f"{name}/free")
        for camera in config.cameras:
            add_camera(scene.spec, f"{name}/{FRAME}", camera, f"{name}/")
        return Dynamics()

    def announce(self) -> Iterable[ev.Announcement]:
        """Announce the body, without motors, its sensors and its cameras."""
        start = self._carried.state(0)
        yield ev.VehicleAnnouncement(
            stamp=0,
            source=self.name,
            mass=0.0,
            max_thrust=0.0,
            control_rate=0.0,
            position=start.position,
            orientation=start.orientation,
        )
        yield from super().announce()

    def on_announcement(self, announcement: ev.Announcement) -> None:
        """Refuse a path to fly, and warn of other orders: the body obeys nobody."""
        if not isinstance(announcement, ev.PathAnnouncement | ev.PilotAnnouncement):
            return
        if not self._addressee.obeys(announcement, "setpoints"):
            return
        if isinstance(announcement, ev.PathAnnouncement):
            raise ValueError(
                f"expected no path for a carried body, found that of {announcement.source}"
            )
        self.log.warning("it is carried, and does not obey %s", announcement.source)

    def sample_sensors(self, tick: Tick) -> None:
        """Send an IMU sample and the ground truth, expose triggered cameras, or end the run."""
        if tick.stamp > self._spline.end_ns:
            self.stop("trajectory ended")
            return
        super().sample_sensors(tick)


def _rounded(place: Vector3) -> Vector3:
    x, y, z = place
    return round(x, 3), round(y, 3), round(z, 3)
