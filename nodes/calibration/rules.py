"""``lint`` rules for rigs: sensors at odds with each other or with their estimators."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Image,
    Imu,
    ImuAnnouncement,
    LidarAnnouncement,
)
from runtime.config.model import Config, NodeSpec
from runtime.tools.preflight import Finding

Announced = Sequence[Announcement]


def baseline(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Check the baseline: too short gives no depth, too long no overlap."""
    for left, right in stereo_pairs(announced):
        distance = math.dist(left.position, right.position)
        if not 0.02 <= distance <= 1.0:
            yield Finding(
                right.source, f"its baseline is {distance:.3g} m", "0.05 to 0.5 m is usual"
            )
        elif abs(distance - right.baseline) > 1e-3:
            yield Finding(
                right.source,
                f"it is {distance:.3f} m from {left.source}, and announces {right.baseline:.3f} m",
                "announce the distance between both positions",
            )


def square_pixels(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Pixels are square: fx and fy of a real camera differ by less than a percent."""
    for camera in cameras(announced):
        fx, fy = camera.info.fx, camera.info.fy
        if abs(fx / fy - 1.0) > 0.01:
            fault = f"fx is {fx:.4g} px and fy {fy:.4g} px"
            yield Finding(camera.source, fault, "take the same focal length for both")


def exposure(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Before the next exposure the shutter is closed, and all rows are read out."""
    for camera in cameras(announced):
        period, duration = 1.0 / camera.rate, camera.exposure + camera.readout
        if duration > period * (1.0 + 1e-9):
            fault = f"exposure and readout take {1e3 * duration:.3g} ms of {1e3 * period:.3g} ms"
            yield Finding(camera.source, fault, "expose for a shorter time, or lower the rate")


def imu_rate(config: Config, announced: Announced) -> Iterator[Finding]:
    """Between two images an inertial estimator wants some ten IMU samples."""
    for camera, imu in inertial_pairs(config, announced):
        if imu.rate < 10.0 * camera.rate:
            yield Finding(
                camera.source,
                f"{imu.source} gives {imu.rate / camera.rate:.3g} samples for each of its images",
                f"raise imu_rate to {10 * camera.rate:g} Hz, or lower the camera's rate",
            )


def rates_divide(config: Config, announced: Announced) -> Iterator[Finding]:
    """Images between two IMU samples have to be interpolated to by an inertial estimator."""
    for camera, imu in inertial_pairs(config, announced):
        share = imu.rate / camera.rate
        if not math.isclose(share, round(share), rel_tol=1e-9):
            lower = imu.rate / math.ceil(share)
            yield Finding(
                camera.source,
                f"{camera.rate:g} Hz does not divide the {imu.rate:g} Hz of {imu.source}",
                f"take a rate that does, such as {lower:.4g} Hz",
            )


def extrinsics(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Sensor fusion requires known poses of both sensors, on the same body."""
    for camera in cameras(announced):
        for imu in (a for a in announced if isinstance(a, ImuAnnouncement)):
            if body_of(imu.source) != body_of(camera.source):
                continue
            if imu.parent_frame_id != camera.parent_frame_id:
                yield Finding(
                    camera.source,
                    f"it is mounted on {camera.parent_frame_id}, {imu.source} on "
                    f"{imu.parent_frame_id}",
                    "announce both in the frame of one body",
                )
        nowhere = camera.position == (0.0, 0.0, 0.0) and camera.parent_frame_id != "map"
        if nowhere and camera.orientation == (1.0, 0.0, 0.0, 0.0):
            fault = "its pose on the body is none, as if nobody had measured it"
            yield Finding(camera.source, fault, "give its position and orientation")


def monotonic(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Distortion must be monotonic, or two directions fall on the same pixel."""
    for camera in cameras(announced):
        info = camera.info
        across, down = np.linspace(0, info.width - 1, 41), np.linspace(0, info.height - 1, 41)
        rim = [(u, v) for u in across for v in (0, info.height - 1)]
        rim += [(u, v) for v in down for u in (0, info.width - 1)]
        blind = ~np.isfinite(info.unproject(rim)).all(axis=1)
        if blind.any():
            yield Finding(
                camera.source,
                f"{blind.mean():.0%} of its image's rim shows nothing: the lens's polynomial turns "
                f"back {math.degrees(info.widest_angle()):.0f}° off the axis",
                "take a narrower field of view, or other coefficients",
            )


def latency(config: Config, announced: Announced) -> Iterator[Finding]:
    """Estimators take time on a vehicle, and with more than an image period skip images."""
    rate = max((camera.rate for camera in cameras(announced)), default=0.0)
    for spec in estimators(config, announced):
        delay = float(getattr(spec.config, "latency", -1.0))
        if delay == 0.0 and config.run.clock == "lockstep":
            fault = "its estimates take no time on the run's clock"
            yield Finding(spec.name, fault, "give it the latency of the vehicle, as 15ms")
        if rate and delay > 1.0 / rate * (1.0 + 1e-9):
            yield Finding(
                spec.name,
                f"its latency is {1e3 * delay:.3g} ms, and images come every {1e3 / rate:.3g} ms",
                "lower the latency or the camera's rate, or mean it to skip images",
            )


def zero_noise(config: Config, announced: Announced) -> Iterator[Finding]:
    """Without noise in simulation an estimator is flattered; recordings are exempt."""
    if not any("thresholds" in spec.config.__struct_fields__ for spec in config.nodes):
        return  # nothing is judged
    if any(isinstance(announcement, EstimatorAnnouncement) for announcement in announced):
        for camera in cameras(announced):
            seen = not camera.undistorted and {"rgb", "grey"} & {*camera.images}
            if not camera.noise and seen and not _recorded(config, camera.source):
                yield Finding(camera.source, "its images have no noise", "noise = 2.0 is usual")
    for _, imu in inertial_pairs(config, announced):
        densities = imu.gyroscope_noise_density, imu.accelerometer_noise_density
        if not all(densities) and not _recorded(config, imu.source):
            fault = "a noise density of it is 0"
            yield Finding(imu.source, fault, "take the densities of a data sheet")


def stamps(config: Config, announced: Announced) -> Iterator[Finding]:  # noqa: ARG001
    """Both eyes of a stereo pair are matched by their stamps."""
    for left, right in stereo_pairs(announced):
        for name in ("rate", "time_offset"):
            left_value, right_value = getattr(left, name), getattr(right, name)
            if left_value != right_value:
                fault = f"its {name} is {right_value:g}, that of {left.source} {left_value:g}"
                yield Finding(right.source, fault, "take the same, or stamps cannot match")
        if left.time_jitter or right.time_jitter:
            fault = f"its stamps and those of {left.source} have a jitter"
            yield Finding(right.source, fault, "take it out, or match them by nearest stamps")


def needs(config: Config, announced: Announced) -> Iterator[Finding]:
    """Kinds of data needed by an estimator, and its IMU, must come from some sensor."""
    available = {kind for camera in cameras(announced) for kind in camera.images}
    available |= {"grey"} if "rgb" in available else set()
    available |= {"lidar"} if any(isinstance(a, LidarAnnouncement) for a in announced) else set()
    for spec in config.nodes:
        required: Any = getattr(spec.node, "needs", frozenset())
        if missing := sorted(required - available if isinstance(required, frozenset) else ()):
            sensor = "sensor" if "lidar" in missing else "camera"
            fault = f"it needs {', '.join(missing)}, which no {sensor} gives"
            cure = "add one" if "lidar" in missing else "add it to the camera's images"
            yield Finding(spec.name, fault, cure)
        read = {port.event for port in spec.node.declared.inputs.values()}
        if {Image, DepthImage} & read and not cameras(announced):
            yield Finding(spec.name, "it reads images, and no camera is announced", "add one")
        inertial = "inertial" in str(getattr(spec.config, "mode", ""))
        if inertial and not any(isinstance(a, ImuAnnouncement) for a in announced):
            yield Finding(spec.name, "it needs an IMU, which nobody announces", "add one")


RULES = [
    baseline, square_pixels, exposure, imu_rate, rates_divide, extrinsics, monotonic, latency,
    zero_noise, stamps, needs,
]  # fmt: skip


def cameras(announced: Announced) -> list[CameraAnnouncement]:
    """Return the cameras."""
    return [a for a in announced if isinstance(a, CameraAnnouncement)]


def stereo_pairs(announced: Announced) -> Iterator[tuple[CameraAnnouncement, CameraAnnouncement]]:
    """Yield the left and the right camera of each stereo rig."""
    for right in cameras(announced):
        yield from ((left, right) for left in cameras(announced) if right.stereo == left.source)


def estimators(config: Config, announced: Announced) -> list[NodeSpec]:
    """Return the nodes of announced estimators."""
    names = {a.source.partition("/")[0] for a in announced if isinstance(a, EstimatorAnnouncement)}
    return [spec for spec in config.nodes if spec.name in names]


def inertial_pairs(
    config: Config, announced: Announced
) -> Iterator[tuple[CameraAnnouncement, ImuAnnouncement]]:
    """Yield cameras with the IMU of their body, if an estimator of the file fuses both."""
    on_images = [a for a in announced if "lidar" not in getattr(a, "reads", ())]
    fused = any(
        "inertial" in str(getattr(spec.config, "mode", "inertial")) and _reads_imu(spec)
        for spec in estimators(config, on_images)
    )
    imus = [a for a in announced if isinstance(a, ImuAnnouncement) and fused]
    for camera in cameras(announced):
        for imu in imus:
            if body_of(imu.source) == body_of(camera.source):
                yield camera, imu


def body_of(source: str) -> str:
    """Return the source of a sensor's body: ``drone`` for ``drone/front``."""
    return source.rpartition("/")[0] or source


def _recorded(config: Config, source: str) -> bool:
    """Return whether a sensor is in a file's recording, and of no other node of the file."""
    from nodes.data.replay import Replay

    replays = {spec.name for spec in config.nodes if issubclass(spec.node, Replay)}
    others = {spec.name for spec in config.nodes} - replays
    return bool(replays) and source.partition("/")[0] not in others


def _reads_imu(spec: NodeSpec) -> bool:
    from runtime.run.graph import input_types

    return any(Imu in events for events in input_types(spec.node).values())
