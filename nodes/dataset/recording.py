"""What recordings of all layouts have in common: events in, rows and images out.

Rows are written at once; an image is returned as a `ImageFile`, for whoever has time to write
it. Nothing here waits or knows a clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from events import DepthImage, Image, Imu, Odometry, PoseStamped
from nodes.dataset.images import ImageFile
from nodes.dataset.rig import Rig
from nodes.dataset.rows import RowFile


class Recording(ABC):
    """A data set that is being written.

    Args:
        folder: Where; it exists and is empty.
        rig: The sensors. Events of others are passed over.
        depth_factor: Steps of a depth image per metre.
        epoch: The run's time 0 in the files, nanoseconds of Unix time.
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        self.folder = folder
        self.rig = rig
        self.depth_factor = depth_factor
        self.epoch = epoch
        self.files: list[RowFile] = []

    @abstractmethod
    def image(self, event: Image) -> ImageFile | None:
        """Note an image, and return what is left to write."""

    # What a layout has no place for is passed over.

    def depth(self, event: DepthImage) -> ImageFile | None:  # noqa: ARG002
        """Note a depth image, and return what is left to write."""
        return None

    def pose(self, event: PoseStamped) -> None:  # noqa: B027
        """Note where a camera is."""

    def odometry(self, event: Odometry) -> None:  # noqa: B027
        """Note where the body is."""

    def imu(self, event: Imu) -> None:  # noqa: B027
        """Note what the IMU measures."""

    def close(self) -> None:
        """Write out what is left."""
        for file in self.files:
            file.close()

    def epoch_line(self) -> str:
        """Return the line of a YAML file that says what was the run's time 0."""
        return f"epoch_ns: {self.epoch}  # the run's time 0; all stamps are Unix time\n"

    def rows(self, name: str, header: str) -> RowFile:
        """Open a file of rows in the folder; its folder is made if need be."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        file = RowFile(path, header)
        self.files.append(file)
        return file

    def write(self, name: str, text: str) -> None:
        """Write a whole text file."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def empty(self) -> list[str]:
        """Return the files that have no rows yet."""
        return [str(f.path.relative_to(self.folder)) for f in self.files if not f.count]

    def warnings(self) -> list[str]:
        """Return what else a reader should know."""
        return []

    def left_out(self) -> int:
        """Return how many events came out of order and are in no file."""
        return sum(file.left_out for file in self.files)


def real(value: float) -> str:
    """Return a number as YAML 1.1 has it: ``2e-05`` would be a text, ``2.0e-05`` is none."""
    digits, e, exponent = repr(value).partition("e")
    return f"{digits if '.' in digits else digits + '.0'}{e}{exponent}"
