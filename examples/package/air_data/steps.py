"""A reader of a data set: images and depth images as arrays, a step at a time, and a path."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import CameraInfo
from nodes.data.replay.folders import Dataset, camera_at

RATE = 10.0


class Steps(Dataset):
    """Reader of path.txt (x y z in NED, a line a step), and of grey/0.npy and depth/0.npy, …."""

    layout = "steps' (path.txt)"

    @classmethod
    def find(cls, path: Path) -> Path | None:
        """Return the folder of path.txt."""
        return path if (path / "path.txt").is_file() else None

    def load(self) -> None:
        """Read the path, and find the images."""
        source = f"{self.vehicle}/camera"
        rows = np.loadtxt(self.folder / "path.txt", ndmin=2).tolist()
        stamps = [round(number * 1e9 / RATE) for number in range(len(rows))]
        for stamp, (x, y, z) in zip(stamps, rows, strict=True):
            self.truth.append((stamp, (x, y, z), (1.0, 0.0, 0.0, 0.0)))
        for folder, files in (("grey", self.images), ("depth", self.depths)):
            paths = [self.folder / folder / f"{number}.npy" for number in range(len(rows))]
            if missing := [path for path in paths if not path.is_file()]:
                raise ValueError(f"{missing[0]}: expected an array of step {missing[0].stem}")
            listed = [*zip(stamps, paths, strict=True)]
            files[source] = (listed, 1.0) if files is self.depths else listed
        kind, width, height = self.first_image(self.images[source][0][1])
        info = CameraInfo(width=width, height=height, fx=80.0, fy=80.0, cx=width / 2, cy=height / 2)
        self.sensors.append(camera_at(source, (kind, "depth"), info, RATE))

    def read_image(self, path: Path) -> npt.NDArray[np.uint8]:
        """Read an array of grey values."""
        return np.asarray(np.load(path), np.uint8)

    def read_depth(self, path: Path, factor: float) -> npt.NDArray[np.float32]:
        """Read an array of metres."""
        return np.asarray(np.load(path), np.float32) / np.float32(factor)
