"""A short flight past a wall with boxes, drawn exactly, for any rig; and what goes wrong on it.

A vehicle stands, is armed and flies to its right. Its cameras look ahead: one with grey images and
depth, or a stereo rig; an IMU feels the same motion. Images are black, white, noise, frozen, sent
twice or missing where the `SCRIPT` says so.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import (
    Armed,
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    VehicleAnnouncement,
)
from events.geometry import pose_matrix
from tests.nodes.estimators.monocular_odometry.world import Floats, Grey, Tile, look_with_depth

PERIOD = 50_000_000
"""Nanoseconds between two images."""
SAMPLES = 10
"""Samples of the IMU in that time."""
BASELINE = 0.12
SPEED = 1.0
LOOKING_AHEAD = (0.5, 0.5, 0.5, 0.5)
MOUNT = (0.1, 0.0, 0.0)
START = (1.0, 2.0, -3.0)
"""Of the vehicle in the world: it looks north, so it flies east."""

SCENE: tuple[Tile, ...] = (
    (2.4, -9.0, 9.0, -9.0, 9.0),
    *((1.8 + 0.2 * (i % 2), 1.6 * i - 1.8, 1.6 * i - 0.8, -1.0, 0.1) for i in range(4)),
)

SCRIPT = (
    "bbb ss ffffff ffffff t ff m ffffff n fff"  # starts in the dark, stands, flies
    " bbb ffffffff"  # dark again
    " w ff r ff h ff zzzz ff"  # white, noise, half an image, frozen
)
"""One letter each image: b black, s standing, f flying, t sent twice, m its partner is missing
(or, where it has none, itself), n depth partly NaN, w white, r random, h half, z frozen."""

GOOD = "sftn"
"""Images that are as they should be, to the IMU's and the camera's knowledge."""


class Flight(NamedTuple):
    """What is sent, and what is true.

    Attributes:
        events: Announcements, images, samples of the IMU, in order.
        kinds: Letter of each image of the `SCRIPT`, by its stamp.
        truth: The body in the world by the same stamps, shapes (4, 4).
    """

    events: tuple[Event, ...]
    kinds: dict[int, str]
    truth: dict[int, Floats]

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return (max(self.kinds) + PERIOD) / 1e9


def camera_info(width: int) -> CameraInfo:
    """Return the intrinsics of images of a width."""
    return CameraInfo.from_fov(width, width * 3 // 4, math.radians(80))


def announcements(
    reads: tuple[str, ...],
    eyes: int,
    width: int = 240,
    *,
    lens: tuple[str, tuple[float, ...]] | None = None,
) -> list[Event]:
    """Return a vehicle, the cameras of a rig and an IMU, if it is among what is read."""
    info = camera_info(width)
    if lens is not None:
        model, coefficients = lens
        info = CameraInfo(
            width=info.width, height=info.height, fx=info.fx, fy=info.fy, cx=info.cx, cy=info.cy,
            distortion_model=model, distortion=coefficients,  # type: ignore[arg-type]
        )  # fmt: skip
    said: list[Event] = [
        VehicleAnnouncement(
            stamp=0, source="drone", mass=1.0, max_thrust=20.0, control_rate=400.0,
            position=START, orientation=(1.0, 0.0, 0.0, 0.0),
        )
    ]  # fmt: skip
    said += [
        CameraAnnouncement(
            stamp=0,
            source=f"drone/{_name(eye)}",
            images=tuple(kind for kind in reads if kind != "imu"),
            info=info,
            rate=1e9 / PERIOD,
            latency=0.0,
            baseline=BASELINE * eye,
            stereo=f"drone/{_name(0)}" if eye else "",
            frame_id=f"{_name(eye)}_optical",
            parent_frame_id="base_link",
            position=(MOUNT[0], MOUNT[1] + BASELINE * eye, MOUNT[2]),
            orientation=LOOKING_AHEAD,
        )
        for eye in range(eyes)
    ]
    if "imu" in reads:
        said.append(
            ImuAnnouncement(
                stamp=0, source="drone/imu", rate=1e9 * SAMPLES / PERIOD, frame_id="base_link",
                gyroscope_noise_density=1.7e-4, gyroscope_random_walk=1.9e-5,
                accelerometer_noise_density=2e-3, accelerometer_random_walk=3e-3,
            )
        )  # fmt: skip
    return said


@cache
def fly(reads: tuple[str, ...], eyes: int, width: int = 240, script: str = SCRIPT) -> Flight:
    """Return the flight of a rig.

    Args:
        reads: ``grey``, ``rgb``, ``depth``, ``imu``: what there is, as an estimator announces it.
        eyes: Number of cameras.
        width: Of the images, pixels; three quarters of it are their height.
        script: What becomes of each image.
    """
    events = announcements(reads, eyes, width)
    letters = script.replace(" ", "")
    kinds, truth = {}, {}
    takes_off = (letters.index("s") + letters.count("s")) * PERIOD
    random = np.random.default_rng(7)
    frozen: list[tuple[Grey, npt.NDArray[np.float32]]] = []
    stamp = 0
    for number, letter in enumerate(letters):
        if "imu" in reads:
            for k in range(1, SAMPLES + 1):
                events.append(_feel(stamp + k * PERIOD // SAMPLES, takes_off))
        stamp = (number + 1) * PERIOD
        kinds[stamp], truth[stamp] = letter, _body(stamp, takes_off)
        seen = [_view(stamp, takes_off, eye, width) for eye in range(eyes)]
        seen = frozen if letter == "z" else [_spoil(letter, *view, random) for view in seen]
        frozen = seen
        for _ in range(2 if letter == "t" else 1):
            sent = [
                event
                for eye, (image, depth) in enumerate(seen)
                for event in _images(stamp, eye, reads, image, depth)
            ]
            events += sent[:-1] if letter == "m" else sent
        if stamp == takes_off:
            events.append(Armed(stamp=stamp, source="drone"))
    return Flight(tuple(events), kinds, truth)


@cache
def _view(stamp: int, takes_off: int, eye: int, width: int) -> tuple[Grey, npt.NDArray[np.float32]]:
    """Return image and depth of a camera."""
    camera = camera_in_first(stamp, takes_off)
    camera[:3, 3] += camera[:3, :3] @ (BASELINE * eye, 0.0, 0.0)
    image, depth = look_with_depth(camera, camera_info(width), SCENE)
    image.flags.writeable = depth.flags.writeable = False
    return image, depth


def _name(eye: int) -> str:
    return ("left", "right")[eye]


def _images(
    stamp: int, eye: int, reads: tuple[str, ...], image: Grey, depth: npt.NDArray[np.float32]
) -> list[Event]:
    of: dict[str, Any] = {
        "stamp": stamp,
        "source": f"drone/{_name(eye)}",
        "frame_id": f"{_name(eye)}_optical",
    }
    sent: list[Event] = []
    if "rgb" in reads:
        sent.append(Image(**of, encoding="rgb8", data=np.repeat(image[..., None], 3, axis=2)))
    elif "grey" in reads:
        sent.append(Image(**of, encoding="mono8", data=image))
    if "depth" in reads:
        sent.append(DepthImage(**of, data=depth))
    return sent


def _spoil(
    letter: str, image: Grey, depth: npt.NDArray[np.float32], random: np.random.Generator
) -> tuple[Grey, npt.NDArray[np.float32]]:
    """Return image and depth as a letter of the script has them."""
    nowhere = np.full_like(depth, np.inf)
    if letter in "bw":
        return np.full_like(image, 0 if letter == "b" else 255), nowhere
    if letter == "r":
        return random.integers(0, 256, image.shape, np.uint8), nowhere
    if letter in "hn":
        image, depth = image.copy(), depth.copy()
        lower = slice(image.shape[0] // 2 if letter == "h" else image.shape[0] * 7 // 8, None)
        depth[lower] = np.nan
        if letter == "h":
            image[lower] = 0
    return image, depth


def camera_in_first(stamp: int, takes_off: int) -> Floats:
    """Return the left camera in itself at the start: x right, y down, z ahead."""
    t = max(stamp - takes_off, 0) / 1e9
    camera = np.eye(4)
    turn = np.radians([3.0 * (1 - math.cos(3 * t)), 2.0 * (1 - math.cos(4 * t))])
    camera[:3, :3] = Rotation.from_euler("yx", turn).as_matrix()
    ramp = 0.3
    along = SPEED * (t * t / (2 * ramp) if t < ramp else t - ramp / 2)
    camera[:3, 3] = along, -0.03 * (1 - math.cos(5 * t)), 0.04 * (1 - math.cos(4 * t))
    return camera


def _body(stamp: int, takes_off: int) -> Floats:
    mount = pose_matrix(MOUNT, LOOKING_AHEAD)
    start = pose_matrix(START, (1.0, 0.0, 0.0, 0.0))
    body: Floats = start @ mount @ camera_in_first(stamp, takes_off) @ np.linalg.inv(mount)
    return body


def _feel(stamp: int, takes_off: int) -> Event:
    """Return what the IMU measures, by differences of the poses."""
    step = 1_000_000
    before, now, after = (_body(stamp + k * step, takes_off) for k in (-1, 0, 1))
    acceleration = (after - 2 * now + before)[:3, 3] / (step / 1e9) ** 2
    turned = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    force = now[:3, :3].T @ (acceleration - (0.0, 0.0, 9.81))
    return Imu(
        stamp=stamp,
        source="drone/imu",
        frame_id="base_link",
        angular_velocity=tuple((turned / (2 * step / 1e9)).tolist()),
        linear_acceleration=tuple(force.tolist()),
    )
