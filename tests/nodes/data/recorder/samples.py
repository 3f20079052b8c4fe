"""One event of each kind that a recording treats in a way of its own."""

from __future__ import annotations

import numpy as np

from events import (
    Armed,
    BarometerAnnouncement,
    BodyAnnouncement,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    FluidPressure,
    Image,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
    LidarScan,
    MagneticField,
    MagnetometerAnnouncement,
    NavSatAnnouncement,
    NavSatFix,
    Odometry,
    PilotAnnouncement,
    PointCloud,
    PoseEstimate,
    PoseStamped,
    Range,
    RangeAnnouncement,
    Score,
    SegmentationImage,
    TrackedFeatures,
    TransformStamped,
    VehicleAnnouncement,
    Wind,
)
from runtime.channels.wire import pack

CAMERA = "drone/front"
OPTICAL = "drone/front_optical"
TURNED = (0.5, -0.5, 0.5, -0.5)


class Found(Event):
    """An event that only a test knows."""

    number: int
    where: dict[str, float]


def announcements() -> list[Event]:
    return [
        VehicleAnnouncement(
            stamp=0,
            source="drone",
            mass=1.2,
            max_thrust=26.0,
            control_rate=400.0,
            position=(1.0, 2.0, -0.1),
            orientation=(1.0, 0.0, 0.0, 0.0),
        ),
        CameraAnnouncement(
            stamp=0,
            source=CAMERA,
            images=("rgb", "depth", "segmentation"),
            info=CameraInfo(width=5, height=4, fx=5.0, fy=5.5, cx=2.0, cy=1.5),
            rate=10.0,
            latency=0.04,
            frame_id=OPTICAL,
            parent_frame_id="base_link",
            position=(0.15, 0.0, 0.0),
            orientation=(0.5, 0.5, 0.5, 0.5),
        ),
        ImuAnnouncement(
            stamp=0,
            source="drone/imu",
            rate=200.0,
            frame_id="base_link",
            gyroscope_noise_density=1e-4,
            gyroscope_random_walk=1e-5,
            accelerometer_noise_density=2e-3,
            accelerometer_random_walk=3e-3,
        ),
        EstimatorAnnouncement(stamp=0, source="odometry", method="test"),
        BarometerAnnouncement(
            stamp=0, source="drone/barometer", rate=50.0, noise=3.0, altitude=122.0
        ),
        NavSatAnnouncement(
            stamp=0,
            source="drone/gps",
            rate=5.0,
            latency=0.2,
            latitude=47.641468,
            longitude=-122.140165,
            altitude=122.0,
            horizontal_noise=0.3,
            vertical_noise=0.4,
        ),
        MagnetometerAnnouncement(
            stamp=0, source="drone/magnetometer", rate=50.0, noise=1e-7, field=(2e-5, 5e-6, 4e-5)
        ),
        RangeAnnouncement(
            stamp=0, source="drone/down", rate=20.0, noise=0.01, min_range=0.1, max_range=9.0
        ),
        LidarAnnouncement(
            stamp=0,
            source="drone/lidar",
            rate=10.0,
            channels=16,
            columns=1024,
            horizontal_fov=6.283,
            elevations=(-0.26, 0.26),
            noise=0.02,
            min_range=0.2,
            max_range=50.0,
        ),
        BodyAnnouncement(stamp=0, source="world/person", kind="person", object_ids=(7, 8)),
        PilotAnnouncement(stamp=0, source="pilot", vehicle="drone"),
    ]


def image(stamp: int, source: str = CAMERA, *, grey: bool = False) -> Image:
    """Return an image that is another at every stamp."""
    shape = (4, 5) if grey else (4, 5, 3)
    data = np.random.default_rng(stamp).integers(0, 255, shape, np.uint8)
    encoding = "mono8" if grey else "rgb8"
    return Image(
        stamp=stamp,
        source=source,
        frame_id=OPTICAL,
        encoding=encoding,
        exposure_time=0.008,
        gain=1.5,
        data=data,
    )


def depth(stamp: int) -> DepthImage:
    data = np.linspace(0.5, 70.0, 20, dtype=np.float32).reshape(4, 5)
    data[0, :3] = [np.inf, np.nan, -0.0]
    return DepthImage(stamp=stamp, source=CAMERA, frame_id=OPTICAL, data=data)


def imu(stamp: int) -> Imu:
    rates, force = (0.1, -0.2, 1e-17), (0.3, -0.0, -9.81)
    return Imu(stamp=stamp, source="drone/imu", angular_velocity=rates, linear_acceleration=force)


def odometry(stamp: int) -> Odometry:
    return Odometry(
        stamp=stamp,
        source="drone",
        position=(1.0 / 3.0, 2.0, -3.0),
        orientation=TURNED,
        linear_velocity=(0.5, 0.0, -1.0),
        angular_velocity=(0.0, 0.1, 0.0),
    )


def cloud(stamp: int, source: str, count: int, *, colours: bool) -> PointCloud:
    rng = np.random.default_rng(stamp + count)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    points[:1] = [np.nan, -0.0, np.inf]
    colors = rng.integers(0, 255, (count if colours else 0, 3), np.uint8)
    return PointCloud(stamp=stamp, source=source, points=points, colors=colors)


def said(stamp: int) -> list[Event]:
    """Return one of everything."""
    return [
        imu(stamp),
        odometry(stamp),
        PoseStamped(stamp=stamp, source=CAMERA, position=(1.0, 2.0, 3.0), orientation=TURNED),
        image(stamp),
        image(stamp, f"{CAMERA}/grey", grey=True),
        depth(stamp),
        SegmentationImage(
            stamp=stamp,
            source=CAMERA,
            frame_id=OPTICAL,
            data=np.arange(-1, 19, dtype=np.int32).reshape(4, 5),
        ),
        cloud(stamp, "map", 7, colours=True),
        cloud(stamp, "map/plain", 3, colours=False),
        cloud(stamp, "map/none", 0, colours=True),
        LidarScan(
            stamp=stamp,
            source="drone/lidar",
            frame_id="l",
            points=np.ones((2, 3), np.float32),
            intensities=np.array([0.25, 0.75], np.float32),
            times=np.array([0.0, 0.05], np.float32),
            rings=np.array([0, 15], np.uint16),
        ),
        TrackedFeatures(
            stamp=stamp,
            source="odometry",
            frame_id=OPTICAL,
            points=np.ones((3, 2), np.float32),
            inliers=np.array([True, False, True]),
        ),
        PoseEstimate(
            stamp=stamp,
            source="odometry",
            position=(0.1, 0.2, 0.3),
            orientation=TURNED,
            covariance=tuple(float(n) for n in range(36)),
        ),
        TransformStamped(
            stamp=stamp,
            source="drone",
            frame_id="base_link",
            child_frame_id="mast",
            translation=(0.0, 0.0, -0.2),
            rotation=(1.0, 0.0, 0.0, 0.0),
            static=True,
        ),
        Range(stamp=stamp, source="drone/down", range=1.0, min_range=0.1, max_range=9.0),
        FluidPressure(stamp=stamp, source="drone/barometer", fluid_pressure=99_871.5, variance=9.0),
        MagneticField(stamp=stamp, source="drone/magnetometer", magnetic_field=(2e-5, -1e-6, 4e-5)),
        NavSatFix(
            stamp=stamp,
            source="drone/gps",
            latitude=47.6415,
            longitude=-122.1402,
            altitude=123.5,
            position_covariance=(0.09, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.16),
            velocity=(1.0, -0.5, 0.25),
        ),
        Wind(stamp=stamp, source="drone", velocity=(3.0, -1.0, 0.5)),
        PoseStamped(
            stamp=stamp, source="world/person", position=(4.0, 5.0, -0.9), orientation=TURNED
        ),
        Score(stamp=stamp, source="judge", subject="odometry", metric="ate", value=0.5, unit="m"),
        Armed(stamp=stamp, source="drone"),
        Found(stamp=stamp, source="test", number=2**60, where={"x": 0.1}),
    ]


def same(event: Event, expected: Event) -> bool:
    """Tell whether two events are equal to the byte, arrays included."""
    return pack(event).frame() == pack(expected).frame()
