"""Common parts of all data set layouts: a rig, events in, rows and images (written later) out."""

from __future__ import annotations

import functools
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
)
from events.announcements import Vehicles

WORLD_AXES = "world: x north, y west, z up; origin on the ground"
"""World axes of a data set, for file headers; bodies stay FRD and cameras optical."""


class Rig(msgspec.Struct, frozen=True):
    """Sensors of a body."""

    body: str  # source of its odometry
    cameras: tuple[CameraAnnouncement, ...]  # one or more, in the order of their announcements
    imu: ImuAnnouncement | None


def choose(announcements: Sequence[Announcement], named: str | None) -> Rig:
    """Choose the cameras and the IMU of a single body.

    Args:
        named: A source to keep to: a camera, or a body; None for the first camera's body.

    Raises:
        ValueError: No such camera gives images.
    """
    announced = [a for a in announcements if isinstance(a, CameraAnnouncement)]
    candidates = [a for a in announced if {"rgb", "grey"} & {*a.images}]
    cameras = [
        a for a in candidates if (_belongs(a, named) if named is not None else not a.undistorted)
    ]
    if not cameras:
        names = ", ".join(f"{a.source} ({', '.join(a.images)})" for a in announced) or "none"
        suffix = f" called {named}" if named is not None else ""
        raise ValueError(f"expected a camera with rgb or grey images{suffix}, found {names}")
    vehicles = Vehicles()
    for announcement in announcements:
        vehicles.announced(announcement)

    def body_of(source: str) -> str:
        return vehicles.carrier(source) or source.rpartition("/")[0] or source

    body = body_of(cameras[0].source)
    imus = (
        a for a in announcements if isinstance(a, ImuAnnouncement) and body_of(a.source) == body
    )
    undistorted = cameras[0].undistorted  # either all images as captured, or all without distortion
    return Rig(
        body=body,
        cameras=tuple(
            a
            for a in cameras
            if body_of(a.source) == body and bool(a.undistorted) == bool(undistorted)
        ),
        imu=next(imus, None),
    )


def _belongs(camera: CameraAnnouncement, named: str) -> bool:
    """Return whether a camera is, is below, or (grey images) is above the named source."""
    return f"{camera.source}/".startswith(f"{named}/") or named == f"{camera.source}/grey"


Pixels = npt.NDArray[Any]

_DEPTH = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # PNG options of depth: a third of the usual size


class ImageFile:
    """Image with its file's path; a call from any thread writes the file, only once."""

    def __init__(self, path: Path, data: Pixels, convert: Callable[[Pixels], Pixels]) -> None:
        self._path = path
        self._data: Pixels | None = data
        self._convert = convert
        self._lock = threading.Lock()

    def __call__(self) -> None:
        """Write the file if not yet written, or wait for another thread; may raise `OSError`."""
        with self._lock:
            if self._data is not None:
                image = self._convert(self._data)
                flags = _DEPTH if image.dtype == np.uint16 else ()
                _, code = cv2.imencode(".png", image, flags)
                part = self._path.with_name(f"{self._path.name}.part")
                part.write_bytes(code.tobytes())
                part.replace(self._path)  # a killed run leaves no half of an image
                self._data = None


def in_colour(data: Pixels) -> Pixels:
    """Return an ``rgb8`` or ``mono8`` image in OpenCV's channel order."""
    return cv2.cvtColor(data, cv2.COLOR_RGB2BGR) if data.ndim == 3 else data


def in_grey(data: Pixels) -> Pixels:
    """Return an ``rgb8`` or ``mono8`` image in grey (ITU-R BT.601)."""
    return cv2.cvtColor(data, cv2.COLOR_RGB2GRAY) if data.ndim == 3 else data


_FLUSH_INTERVAL = 100_000_000  # nanoseconds between flushes to the operating system


class RowFile:
    """A text file of rows with rising stamps, after the lines of a header; may raise `OSError`.

    A run that is killed leaves all rows but those of the last tenth of a second; the last one may
    be cut off.
    """

    def __init__(self, path: Path, header: str) -> None:
        self.path = path
        self.count = 0  # rows so far
        self.left_out = 0  # rows left out because their stamp did not rise, as readers expect
        self._last: int | None = None
        self._written = -_FLUSH_INTERVAL  # stamp of the last row flushed to the operating system
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._file.write(header)
        self._file.flush()

    def add(self, stamp: int, row: str) -> bool:
        """Add a row with its line end; return whether its stamp was in order."""
        if self._last is not None and stamp <= self._last:
            self.left_out += 1
            return False
        self._last = stamp
        self.count += 1
        self._file.write(row)
        if stamp - self._written >= _FLUSH_INTERVAL:
            self._file.flush()
            self._written = stamp
        return True

    def close(self) -> None:
        """Close the file, with all rows written."""
        self._file.close()


class Recording(ABC):
    """Base class of data sets being written."""

    def __init__(
        self,
        folder: Path,  # existing and empty
        rig: Rig,  # the sensors; other sources' events are ignored
        depth_factor: float,  # steps of a depth image per metre
        epoch: int,  # the run's time 0 in the files, nanoseconds of Unix time
    ) -> None:
        self.folder, self.rig, self.depth_factor, self.epoch = folder, rig, depth_factor, epoch
        self.files: list[RowFile] = []

    @abstractmethod
    def image(self, event: Image) -> ImageFile | None:
        """Add an image; return its file, still to be written."""

    # By default, data that a layout has no file for is ignored.

    def depth(self, event: DepthImage) -> ImageFile | None:  # noqa: ARG002
        """Add a depth image; return its file, still to be written."""
        return None

    def pose(self, event: PoseStamped) -> None:  # noqa: B027
        """Record a camera's pose."""

    def odometry(self, event: Odometry) -> None:  # noqa: B027
        """Record the body's pose."""

    def imu(self, event: Imu) -> None:  # noqa: B027
        """Add an IMU sample."""

    def close(self) -> None:
        """Close all files."""
        for file in self.files:
            file.close()

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

    def describe(self, name: str, template: str, **values: Any) -> None:
        """Write a file from a template beside this module, with variable ``epoch``."""
        jinja_template = templates(Path(__file__).parent).get_template(f"{template}.jinja")
        self.write(name, jinja_template.render(values, epoch=self.epoch))

    def empty(self) -> list[str]:
        """Return the files without rows."""
        return [str(f.path.relative_to(self.folder)) for f in self.files if not f.count]

    def warnings(self) -> list[str]:
        """Return further warnings for readers of the data set."""
        return []

    def left_out(self) -> int:
        """Return how many events came out of order and are in no file."""
        return sum(file.left_out for file in self.files)


_STANDARD_FIELDS = {
    "position",
    "orientation",
    "parent_frame_id",
    "baseline",
    "stereo",
    "undistorted",
}


def extra_fields(kind: Any) -> list[msgspec.structs.FieldInfo]:
    """Return the fields of an announcement that no layout defines, all with defaults.

    Our own data sets contain them nevertheless.
    """
    fields = msgspec.structs.fields(kind)
    return [
        f for f in fields if f.default is not msgspec.NODEFAULT and f.name not in _STANDARD_FIELDS
    ]


def extra_values(announcement: CameraAnnouncement | ImuAnnouncement) -> dict[str, str]:
    """Return the `extra_fields` that are not their defaults, as YAML."""
    fields = {}
    for field in extra_fields(announcement):
        value = getattr(announcement, field.name)
        if value != field.default:
            text = _row(value) if isinstance(value, tuple) else str(value).lower()
            fields[field.name] = text if isinstance(value, bool | tuple) else real(value)
    return fields


def real(value: float) -> str:
    """Return a number in YAML 1.1: ``2.0e-05``, since ``2e-05`` would be text."""
    digits, e, exponent = repr(value).partition("e")
    return f"{digits if '.' in digits else digits + '.0'}{e}{exponent}"


@functools.lru_cache(8)  # of its templates, which take ten milliseconds each to compile
def templates(folder: Path) -> jinja2.Environment:
    """Return the template environment of a folder, with filters ``real`` and ``row``."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=False,  # noqa: S701  # neither YAML nor JSON is HTML
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"real": real, "row": _row}
    return environment


def _row(values: Iterable[float]) -> str:
    return f"[{', '.join(real(float(value)) for value in values)}]"
