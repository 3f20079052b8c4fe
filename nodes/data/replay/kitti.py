"""KITTI odometry sequences: rectified cameras in a row on a car.

A. Geiger, P. Lenz and R. Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark
suite", CVPR 2012, and cvlibs.net/datasets/kitti/eval_odometry.php::

    sequences/00/image_0/000000.png …    left grey camera; 1: right one; 2, 3: the same in colour
    sequences/00/calib.txt               P0 to P3: projection of the left grey camera's points
    sequences/00/times.txt               seconds
    poses/00.txt                         true poses of the left grey camera, of the first 11 only

The body is the left grey camera with the axes of a vehicle (FRD), and begins in the world's origin.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from events import CameraAnnouncement, CameraInfo, Image, Odometry, Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD
from events.geometry import pose_matrix, pose_tuples
from nodes.data.replay.folders import FolderReader, Rows, as_pair, camera_at, read_image, vehicle_at
from nodes.data.replay.reader import ReplayError
from nodes.trajectory.formats import read_kitti
from nodes.trajectory.table import Row, read_rows

_AXES = pose_matrix((0.0, 0.0, 0.0), OPTICAL_TO_FRD)


class Kitti(FolderReader):
    """Reader of the cameras, and of the true poses if they are there.

    Args:
        folder: The sequence's, with times.txt in it.
        vehicle: Source of the truth; the cameras are below it.

    Raises:
        ReplayError: A file is not as published.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        super().__init__(folder, vehicle)
        try:
            rows = read_rows(folder / "times.txt", None, (1,), "seconds")
            self._stamps = [row.seconds() for row in rows]
            self._origin = self._stamps[0]
            self._truth = self._poses()
            self._images = {
                f"{vehicle}/{path.name}": sorted(path.glob("*.png"))
                for path in sorted(folder.glob("image_[0-3]"))
            }
            projections = read_rows(folder / "calib.txt", None, (13,), "name: 12 numbers")
            self._announce({row.fields[0].rstrip(":"): row for row in projections})
        except ValueError as error:
            raise ReplayError(str(error)) from None

    def _rows(self) -> Iterator[Rows]:
        yield Rows(Odometry, self._vehicle, self._truth, self._pose)
        for source, paths in self._images.items():
            rows = list(zip(self._stamps, paths, strict=True))
            yield Rows(Image, source, rows, partial(self._image, source))

    def _poses(self) -> list[tuple[int, Vector3, Quaternion]]:
        path = self._folder.parent.parent / "poses" / f"{self._folder.name}.txt"
        if not path.is_file():
            self.complain(f"expected true poses in {path}, found none")
            return []
        poses = read_kitti(path)
        self._count(path, "poses", len(poses))
        bodies = _AXES @ poses @ np.linalg.inv(_AXES)
        return [(s, *pose_tuples(body)) for s, body in zip(self._stamps, bodies, strict=True)]

    def _announce(self, projections: dict[str, Row]) -> None:
        seconds = (self._stamps[-1] - self._stamps[0]) / 1e9
        rate = (len(self._stamps) - 1) / seconds if seconds > 0 else 10.0
        if self._truth:
            self._announcements.append(vehicle_at(self._pose(*self._truth[0])))
        if not self._images:
            raise ReplayError(f"{self._folder}: expected images in image_0 to image_3, found none")
        cameras: dict[str, CameraAnnouncement] = {}
        for source, paths in self._images.items():
            number = source[-1]
            self._count(self._folder / f"image_{number}", "images", len(paths))
            if (row := projections.get(f"P{number}")) is None:
                raise ReplayError(f"{self._folder / 'calib.txt'}: expected P{number}, found none")
            cameras[number] = _camera(source, row, paths[0], rate)
            if (left := cameras.get({"1": "0", "3": "2"}.get(number, ""))) is not None:
                cameras[number] = as_pair(left, cameras[number])
        self._announcements += cameras.values()

    def _count(self, where: Path, what: str, found: int) -> None:
        if found != len(self._stamps):
            raise ReplayError(
                f"{where}: expected {len(self._stamps)} {what}, as many as times.txt has stamps, "
                f"found {found}"
            )


def _camera(source: str, row: Row, image: Path, rate: float) -> CameraAnnouncement:
    """Return a camera by its projection K [I | t] of points in the left grey camera."""
    projection = np.reshape(row.numbers(1, 13), (3, 4))
    first = read_image(image, 0, source, "")
    (fx, _, cx), (_, fy, cy) = projection[:2, :3].tolist()
    info = CameraInfo(
        width=first.data.shape[1], height=first.data.shape[0], fx=fx, fy=fy, cx=cx, cy=cy
    )
    moved = np.eye(4)
    moved[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    images = ("rgb" if first.encoding == "rgb8" else "grey",)
    return camera_at(source, images, info, rate, *pose_tuples(_AXES @ moved))
