"""A finished run's calibration, and its data where the format has a place for it: VSLAM-LAB's.

github.com/VSLAM-LAB/VSLAM-LAB, ``Datasets/DatasetVSLAMLAB.py`` and its data sets.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import events
from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
)
from events.frames import flip_yz, rotation_to_nwu
from nodes.calibration.formats import DEPTH_FACTOR, write_files
from nodes.data.dataset.recording import ImageFile, Recording, Rig, choose, in_colour
from nodes.ros2.messages.images import depth_in_steps
from nodes.trajectory.table import EPOCH, epoch_of
from runtime.run.results import claim


def export_calibration(
    run: Path,
    form: str,
    out: Path | None = None,
    epoch: int | str = EPOCH,
    camera: str | None = None,
) -> list[Path]:
    """Write what a run announced of its cameras and its IMU as another program's calibration.

    ``vslamlab`` also gets images, IMU and ground truth, if the run has a recording.

    Args:
        form: One of `nodes.calibration.formats.FORMATS`.
        out: Folder for the files; ``export/<form>`` in the run's folder if None.
        epoch: The run's time 0 in the data: a date (ISO 8601), or nanoseconds of Unix time.
        camera: Source of a camera, or of the body whose cameras are wanted; the first camera's
            body if None.

    Returns:
        What was written.

    Raises:
        ValueError: The run left no announcements, it has no such camera, or the format has no word
            for it.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    rig = choose(announcements(run), camera)
    files = write_files(rig, form)
    folder = out or run / "export" / form
    recording = run / "recording.mcap"
    if form == "vslamlab" and recording.is_file():
        claim(folder)  # images that an earlier export has left there are removed
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    written = [folder / name for name in files]
    if form != "vslamlab" or not recording.is_file():
        return written
    from nodes.data.replay.recorded import Recorded  # which wants what reads MCAP

    for number in range(len(rig.cameras)):
        for kind in ("rgb", "depth"):
            shutil.rmtree(folder / f"{kind}_{number}", ignore_errors=True)
    reader, sequence = Recorded(recording), VslamLab(folder, rig, DEPTH_FACTOR, zero)
    take: dict[type[Any], Callable[[Any], ImageFile | None]] = {
        Image: sequence.image,
        DepthImage: sequence.depth,
        Imu: sequence.imu,
        Odometry: sequence.odometry,
    }
    for _, event in reader.events(0, None, lambda kind, _: kind in take):
        if (file := take[type(event)](event)) is not None:
            file()
    reader.close()
    sequence.close()
    return written + [file.path for file in sequence.files]


def announcements(run: Path) -> list[Announcement]:
    """Return what a run announced of its cameras and IMUs: they stand in its summary.

    Raises:
        ValueError: It left none, as a run that was killed does.
    """
    path = run / "summary.json"
    try:
        found = msgspec.json.decode(path.read_bytes())["announcements"]
        return [
            msgspec.convert(
                {key: value for key, value in each.items() if key != "type"},
                getattr(events, each["type"]),
            )
            for each in found
            if each["type"] in {CameraAnnouncement.__name__, ImuAnnouncement.__name__}
        ]
    except (OSError, KeyError, TypeError, msgspec.MsgspecError) as error:
        raise ValueError(
            f"{path}: expected the summary of a finished run with what it announced, found: {error}"
        ) from None


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

    def image(self, event: Image | DepthImage) -> ImageFile | None:
        """Note an image of one of the cameras, and return what is left to write."""
        kind = "rgb" if isinstance(event, Image) else "depth"
        name = f"{kind}_{self._names.get(event.source, -1)}"
        if name not in self._stamps:
            return None
        self._stamps[name].append(self.epoch + event.stamp)
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        path = self.folder / name / f"{self.epoch + event.stamp}.png"
        return ImageFile(path, event.data, in_colour if kind == "rgb" else convert)

    depth = image

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
