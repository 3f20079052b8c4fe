"""Layouts of two TUM benchmarks, for a single camera.

monoVO, with its photometric calibration, as DSO reads it: J. Engel, V. Usenko, D. Cremers, "A
photometrically calibrated benchmark for monocular visual odometry", arXiv:1607.02555, 2016.
RGB-D: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, and
cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; stamps have nine decimals in place of six.
"""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np

from events import CameraInfo, DepthImage, Image, Imu, PoseStamped
from events.camera_info import response_light, vignette_map
from events.frames import flip_yz, rotate, rotation_to_nwu
from nodes.data.dataset.recording import (
    WORLD_AXES,
    ImageFile,
    Recording,
    Rig,
    RowFile,
    in_colour,
    in_grey,
)
from nodes.ros2.messages.images import depth_in_steps
from nodes.trajectory.formats import tum_row
from nodes.trajectory.table import seconds_text


class TumMono(Recording):
    """Grey images of the rig's first camera, its calibration, and its poses.

    ::

        images/<number>.png
        times.txt               number, stamp, and milliseconds of exposure, times the gain
        camera.txt              intrinsics and size, as DSO reads them
        pcalib.txt              light of each of the 256 grey levels, 0 to 255
        vignette.png            share of the light that reaches each pixel, 16 bits
        groundtruthSync.txt     the camera's optical frame in the world, at the images' stamps

    Raises:
        ValueError: The camera's distortion cannot be expressed.
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._camera = camera = rig.cameras[0]
        own_grey = {"rgb", "grey"} <= {*camera.images}  # they have a source of their own
        self._source = f"{camera.source}/grey" if own_grey else camera.source
        self.write("camera.txt", _calibration(camera.source, camera.info))
        light = 255.0 * response_light(camera.response)
        self.write("pcalib.txt", " ".join(f"{value:.9g}" for value in light) + "\n")
        shares = vignette_map(camera.info, camera.vignette)
        _, code = cv2.imencode(".png", np.rint(65535 * shares / shares.max()).astype(np.uint16))
        (folder / "vignette.png").write_bytes(code.tobytes())
        (folder / "images").mkdir()
        self._times = self.rows("times.txt", "")
        self._truth = self.rows("groundtruthSync.txt", "")
        self._poses: dict[int, PoseStamped] = {}

    def image(self, event: Image) -> ImageFile | None:
        """Note an image of the camera, and the pose of its stamp."""
        if event.source != self._source:
            return None
        number, stamp = self._times.count, self.epoch + event.stamp
        row = f"{number:05d} {seconds_text(stamp)}"
        if event.exposure_time:
            row += f" {1e3 * event.exposure_time * event.gain:.9g}"
        if not self._times.add(event.stamp, f"{row}\n"):
            return None
        if (pose := self._poses.get(event.stamp)) is not None:
            place = flip_yz(pose.position), rotation_to_nwu(pose.orientation)
            self._truth.add(event.stamp, tum_row(stamp, *place))
        self._poses = {s: pose for s, pose in self._poses.items() if s > event.stamp}
        return ImageFile(self.folder / "images" / f"{number:05d}.png", event.data, in_grey)

    def pose(self, event: PoseStamped) -> None:
        """Note where the camera is, until its image comes."""
        if event.source == self._camera.source:
            self._poses[event.stamp] = event


def _calibration(source: str, info: CameraInfo) -> str:
    """Return a camera.txt; pixel centres have whole coordinates, as in all others of ours."""
    coefficients: tuple[float, ...]
    if info.is_pinhole:
        model, coefficients, size = "Pinhole", (0.0,), "none"
    elif info.distortion_model == "equidistant":
        model, coefficients, size = "EquiDistant", info.distortion, "crop"
    elif info.distortion_model == "plumb_bob" and info.distortion[4] == 0.0:
        model, coefficients, size = "RadTan", info.distortion[:4], "crop"
    else:
        raise ValueError(
            f"{source}: expected distortion with four coefficients, which camera.txt has place "
            f"for, found {info.distortion_model} {info.distortion}"
        )
    numbers = " ".join(map(repr, (info.fx, info.fy, info.cx, info.cy, *coefficients)))
    return f"{model} {numbers}\n{info.width} {info.height}\n{size}\n{info.width} {info.height}\n"


class TumRgbd(Recording):
    """Images of the rig's first camera and its poses, `depth_factor` 5000 in the original.

    ::

        rgb/<s>.png, depth/<s>.png        depth: 16 bits, 0 for none
        rgb.txt, depth.txt                stamp and file
        associations.txt                  pairs of both with one stamp
        groundtruth.txt                   the camera's optical frame in the world
        accelerometer.txt                 in the body's frame
        camera.yaml                       intrinsics
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._camera = camera = rig.cameras[0]
        colour = "rgb" in camera.images
        self._files = {
            "rgb": self._index("rgb", "color images" if colour else "grey images"),
            "groundtruth": self._rows(
                "groundtruth", "ground truth trajectory", f"{WORLD_AXES}; camera: {_OPTICAL}",
                "timestamp tx ty tz qx qy qz qw",
            ),
        }  # fmt: skip
        if "depth" in camera.images:
            scale = f"{depth_factor:g} steps per metre along the optical axis, 0 for none"
            self._files["depth"] = self._index("depth", f"depth maps, {scale}")
            self._pairs = self.rows("associations.txt", "")
        if rig.imu is not None:
            self._files["accelerometer"] = self._rows(
                "accelerometer", "accelerometer data", "body: x forward, y right, z down; m/s^2",
                "timestamp ax ay az",
            )  # fmt: skip
        self._unpaired: dict[int, str] = {}  # by stamp: rgb or depth, whichever came
        self.describe("camera.yaml", "tum_rgbd.camera.yaml", camera=camera, factor=depth_factor)

    def image(self, event: Image) -> ImageFile | None:
        """Add an image of the camera, in colour if available."""
        if event.source != self._camera.source or not self._add("rgb", event.stamp):
            return None
        return ImageFile(self._path("rgb", event.stamp), event.data, in_colour)

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Note a depth image of the camera."""
        if event.source != self._camera.source or not self._add("depth", event.stamp):
            return None
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        return ImageFile(self._path("depth", event.stamp), event.data, convert)

    def pose(self, event: PoseStamped) -> None:
        """Note where the camera is."""
        if event.source == self._camera.source:
            pose = flip_yz(event.position), rotation_to_nwu(event.orientation)
            self._files["groundtruth"].add(event.stamp, tum_row(self.epoch + event.stamp, *pose))

    def imu(self, event: Imu) -> None:
        """Note the accelerations."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            x, y, z = rotate(self.rig.imu.orientation, event.linear_acceleration)
            row = f"{self._seconds(event.stamp)} {x:.9f} {y:.9f} {z:.9f}\n"
            self._files["accelerometer"].add(event.stamp, row)

    def _add(self, kind: str, stamp: int) -> bool:
        """Add an image, and its partner if received; return whether in order."""
        name = f"{self._seconds(stamp)} {kind}/{self._seconds(stamp)}.png"
        if kind not in self._files or not self._files[kind].add(stamp, f"{name}\n"):
            return False
        if "depth" in self._files:
            partner = self._unpaired.pop(stamp, None)
            if partner is None:
                self._unpaired[stamp] = name
            else:
                first, second = sorted((name, partner), key=lambda n: "depth/" in n)
                self._pairs.add(stamp, f"{first} {second}\n")
                self._unpaired = {s: n for s, n in self._unpaired.items() if s > stamp}
        return True

    def _path(self, kind: str, stamp: int) -> Path:
        return self.folder / kind / f"{self._seconds(stamp)}.png"

    def _seconds(self, stamp: int) -> str:
        return seconds_text(self.epoch + stamp)

    def _index(self, kind: str, title: str) -> RowFile:
        (self.folder / kind).mkdir()
        return self._rows(kind, title, f"camera: {self._camera.source}", "timestamp filename")

    def _rows(self, name: str, *header: str) -> RowFile:
        """Open a file with a header of three lines, as some readers skip exactly three."""
        return self.rows(f"{name}.txt", "".join(f"# {line}\n" for line in header))


_OPTICAL = "x right, y down, z forward"
