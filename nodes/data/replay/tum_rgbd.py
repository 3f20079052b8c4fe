"""Data sets in the layout of TUM's RGB-D benchmark.

As published and as `nodes.data.dataset` writes it: J. Sturm et al., "A benchmark for the evaluation
of RGB-D SLAM systems", IROS 2012, and cvg.cit.tum.de/data/datasets/rgbd-dataset/ file_formats. The
world, z up, is turned to NED by half a turn about x. A depth image gets the stamp of the nearest
colour image, within 20 ms as in their associate.py. Times count from the first stamp, or from the
epoch that ``camera.yaml`` notes (``epoch_ns``).
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from events import Announcement, DepthImage, Image, Odometry, PoseStamped, Quaternion, Vector3
from events.frames import OPTICAL_TO_FRD, flip_yz, inverse, multiply, rotation_to_ned
from nodes.data.replay.euroc import noted_epoch, read_sensor
from nodes.data.replay.folders import (
    FolderReader,
    Rows,
    camera_at,
    read_image,
    vehicle_at,
    while_seen,
)
from nodes.data.replay.reader import Pinhole, ReplayError
from nodes.trajectory.formats import read_tum
from nodes.trajectory.table import read_rows

FARTHEST = 20_000_000  # nanoseconds between a depth image and its colour image
_Images = list[tuple[int, Path]]


class TumRgbd(FolderReader):
    """Reader of colour, depth and true poses; the camera looks ahead from the body's origin.

    Raises:
        ReplayError: A file is not as published, or the intrinsics are missing.
    """

    def __init__(
        self,
        folder: Path,  # the one with rgb.txt in it
        vehicle: str,  # source of the truth; the camera is below it
        camera: Pinhole | None,  # intrinsics; if `None`, those of camera.yaml
        depth_factor: float,  # steps per metre
    ) -> None:
        super().__init__(folder, vehicle)
        self._source = f"{vehicle}/camera"
        try:
            self._rgb = self._index("rgb.txt")
            depth = self._index("depth.txt") if (folder / "depth.txt").is_file() else []
            self._truth = self._poses()
        except ValueError as error:
            raise ReplayError(str(error)) from None
        self._depth = self._paired(depth)
        calibration = folder / "camera.yaml"
        self._factor = depth_factor
        rate = _rate(self._rgb)
        if calibration.is_file():
            sensor = read_sensor(calibration)
            self._factor = sensor.number("depth_factor", depth_factor)
            rate = sensor.number("rate_hz", rate)
            if camera is None:
                model = sensor.texts.get("distortion_model", "plumb_bob")
                lens = {"distortion_model": model, "distortion": sensor.lists.get("distortion")}
                middle = {name: sensor.number(name) for name in ("fx", "fy", "cx", "cy")}
                camera = sensor.converted({**middle, **lens}, Pinhole)
        if camera is None:
            raise ReplayError(
                f"{folder}: expected a camera.yaml or the setting camera, found neither: write "
                "camera = { fx = …, fy = …, cx = …, cy = … } (pixels); the benchmark's page has "
                "those of its sequences (freiburg1: 517.3, 516.5, 318.6, 255.3)"
            )
        self._truth = while_seen(self._truth, self._rgb[0][0], self._rgb[-1][0])
        firsts = [self._rgb[0][0], *(row[0] for row in self._truth[:1])]
        self._origin = min(firsts + noted_epoch(calibration))
        self._announcements = self._announced(camera, rate)

    def _rows(self) -> Iterator[Rows]:
        source = self._source
        yield Rows(Odometry, self._vehicle, self._truth, self._odometry)
        yield Rows(PoseStamped, source, self._truth, self._camera_pose)
        depth_image = partial(self._depth_image, source, self._factor)
        yield Rows(DepthImage, source, self._depth, depth_image)
        yield Rows(Image, source, self._rgb, partial(self._image, source))

    def _odometry(self, stamp: int, position: Vector3, optical: Quaternion) -> Odometry:
        return self._pose(stamp, position, multiply(optical, inverse(OPTICAL_TO_FRD)))

    def _camera_pose(self, stamp: int, position: Vector3, optical: Quaternion) -> PoseStamped:
        return PoseStamped(
            stamp=stamp - self._origin, source=self._source, position=position, orientation=optical
        )

    def _paired(self, depth: _Images) -> _Images:
        """Give each depth image the stamp of its colour image; those without are left out."""
        stamps = [stamp for stamp, _ in self._rgb]
        taken: dict[int, tuple[int, Path]] = {}
        for stamp, path in depth:
            at = bisect.bisect_left(stamps, stamp)
            near = min(stamps[max(at - 1, 0) : at + 1], key=lambda each: abs(each - stamp))
            distance = abs(near - stamp)
            if distance <= FARTHEST and (near not in taken or distance < taken[near][0]):
                taken[near] = distance, path
        if left_out := len(depth) - len(taken):
            self.trouble.append(f"{left_out} depth images have no colour image near them")
        return sorted((stamp, path) for stamp, (_, path) in taken.items())

    def _announced(self, camera: Pinhole, rate: float) -> list[Announcement]:
        first = read_image(self._rgb[0][1], 0, self._source, "")
        height, width = first.data.shape[:2]
        kinds = ("rgb" if first.encoding == "rgb8" else "grey", *(["depth"] if self._depth else []))
        announced: list[Announcement]
        announced = [camera_at(self._source, kinds, camera.info(width, height), rate)]
        if self._truth:
            begin = self._rgb[0][0]
            row = next((row for row in self._truth if row[0] >= begin), self._truth[0])
            announced.insert(0, vehicle_at(self._odometry(*row)))
        return announced

    def _index(self, name: str) -> _Images:
        rows = read_rows(self._folder / name, None, (2,), "timestamp filename")
        return sorted((row.seconds(), self._folder / row.fields[1]) for row in rows)

    def _poses(self) -> list[tuple[int, Vector3, Quaternion]]:
        path = self._folder / "groundtruth.txt"
        if not path.is_file():
            return []
        truth = read_tum(path, in_order=False)
        return [
            (stamp, flip_yz(place), rotation_to_ned(turn)) for stamp, place, turn in truth.poses()
        ]


def _rate(rows: _Images) -> float:
    lasts = rows[-1][0] - rows[0][0]
    return (len(rows) - 1) * 1e9 / lasts if lasts else 30.0
