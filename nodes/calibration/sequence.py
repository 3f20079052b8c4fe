"""The layout of VSLAM-LAB's sequences: images, IMU and ground truth beside ``calibration.yaml``.

github.com/VSLAM-LAB/VSLAM-LAB, ``Datasets/DatasetVSLAMLAB.py`` and its data sets.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from events import DepthImage, Image, Imu, Odometry
from events.frames import flip_yz, rotation_to_nwu
from nodes.dataset.images import ImageFile, in_16_bits, in_colour
from nodes.dataset.recording import Recording
from nodes.dataset.rig import Rig


class VslamLab(Recording):
    """Images of the rig's cameras, the IMU, and the body's poses in a world with z up.

    ::

        rgb_0/<ns>.png, depth_0/<ns>.png      one folder for each camera; depth in 16 bits
        rgb.csv                               images that belong together, row by row
        imu_0.csv                             in the IMU's frame
        groundtruth.csv                       the body (FRD) in north, west, up
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._stamps: dict[str, list[int]] = {}
        self._names = {camera.source: number for number, camera in enumerate(rig.cameras)}
        for number, camera in enumerate(rig.cameras):
            for kind in ("rgb", *(("depth",) if "depth" in camera.images else ())):
                self._stamps[f"{kind}_{number}"] = []
                (folder / f"{kind}_{number}").mkdir()
        if rig.imu is not None:
            axes = ("wx (rad s^-1)", "wy (rad s^-1)", "wz (rad s^-1)")
            force = ("ax (m s^-2)", "ay (m s^-2)", "az (m s^-2)")
            self._imu = self.rows("imu_0.csv", ",".join(("ts (ns)", *axes, *force)) + "\n")
        header = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n"
        self._truth = self.rows("groundtruth.csv", header)

    def image(self, event: Image) -> ImageFile | None:
        """Note an image of one of the cameras."""
        return self.note(event)

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Note a depth image of one of the cameras."""
        return self.note(event)

    def note(self, event: Image | DepthImage) -> ImageFile | None:
        """Note an image of either kind, and return what is left to write."""
        kind = "rgb" if isinstance(event, Image) else "depth"
        name = f"{kind}_{self._names.get(event.source, -1)}"
        if name not in self._stamps:
            return None
        self._stamps[name].append(self.epoch + event.stamp)
        convert = functools.partial(in_16_bits, factor=self.depth_factor)
        path = self.folder / name / f"{self.epoch + event.stamp}.png"
        return ImageFile(path, event.data, in_colour if kind == "rgb" else convert)

    def odometry(self, event: Odometry) -> None:
        """Note where the body is."""
        if event.source == self.rig.body:
            (x, y, z), (w, i, j, k) = flip_yz(event.position), rotation_to_nwu(event.orientation)
            row = f"{x:.9f},{y:.9f},{z:.9f},{i:.12f},{j:.12f},{k:.12f},{w:.12f}"
            self._truth.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def imu(self, event: Imu) -> None:
        """Note what the IMU measures."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            values = (*event.angular_velocity, *event.linear_acceleration)
            row = ",".join(f"{value:.12g}" for value in values)
            self._imu.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def close(self) -> None:
        """Write the rows of images that belong together: within half of the first one's period."""
        head = ",".join(f"ts_{name} (ns),path_{name}" for name in self._stamps)
        rows = self.rows("rgb.csv", f"{head}\n")
        most = 0.5e9 / self.rig.cameras[0].rate
        for stamp in self._stamps["rgb_0"]:
            cells = []
            for name, stamps in self._stamps.items():
                away = np.abs(np.asarray(stamps, np.int64) - stamp)
                if len(stamps) and away.min() <= most:
                    near = stamps[int(away.argmin())]
                    cells.append(f"{near},{name}/{near}.png")
            if len(cells) == len(self._stamps):
                rows.add(stamp, ",".join(cells) + "\n")
        super().close()
