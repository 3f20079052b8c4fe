"""The layout of TUM's monoVO data set, with its photometric calibration, for one camera.

J. Engel, V. Usenko, D. Cremers, "A photometrically calibrated benchmark for monocular visual
odometry", arXiv:1607.02555, 2016; as DSO reads it.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from events import CameraInfo, Image, PoseStamped
from events.frames import flip_yz, rotation_to_nwu
from events.photometry import response_light, vignette_map
from nodes.data.dataset.recording import ImageFile, Recording, in_grey
from nodes.data.dataset.rig import Rig
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
        ValueError: The camera's distortion cannot be written down so.
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
