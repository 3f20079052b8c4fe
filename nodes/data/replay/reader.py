"""Readers of recordings of any format, beside the loop; choice of their events; settings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Literal, NamedTuple, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from events import Announcement, CameraInfo, Category, EstimatorAnnouncement, Event, PoseEstimate
from events.camera_info import DistortionModel
from runtime import Changeable, Duration, NodeConfig
from runtime.paths import InputPath

MOST_TROUBLE = 20  # largest number of different complaints kept about a recording


class ReplayError(ValueError):
    """A recording cannot be read; the message names the file and the reason."""


class Timed(NamedTuple):
    """Event with its time of publication (ns from the recording's beginning)."""

    time: int
    event: Event


class Wants(Protocol):
    """Test of type and source for events to send; others are not decoded."""

    def __call__(self, kind: type[Event], source: str) -> bool:
        """Return whether to send events of this type and source."""


class Reader(ABC):
    """Reader of a recording."""

    def __init__(self) -> None:
        self.trouble: list[str] = []  # parts unread so far, in words
        self.left_out = 0  # number of events unread so far
        self.notes: list[str] = []  # a sentence on each stream that was chosen, or was not

    @abstractmethod
    def announcements(self) -> Sequence[Announcement]:
        """Return the recorded announcements, or equivalents from data; may raise `ReplayError`."""

    @abstractmethod
    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield the events from `start` to before `end` (ns; `None` for all), in original order.

        Nothing changes arrays that events share. Stamps are on the same clock as the times.

        Raises:
            ReplayError: It cannot be read.
        """

    def end(self) -> int | None:
        """Return the noted end (ns); `None` if the last event is the end."""
        return None

    def complain(self, text: str) -> None:
        """Record an unreadable part; beyond `MOST_TROUBLE`, only the existence of more."""
        if text in self.trouble or len(self.trouble) > MOST_TROUBLE:
            return
        self.trouble.append(text if len(self.trouble) < MOST_TROUBLE else "and more of that kind")

    def check_bits(self, name: str, pixels: npt.NDArray[np.uint16]) -> None:
        """Complain of an image of 16 bits of which lower ones are used: its high byte is dark."""
        peak = int(pixels.max(initial=0))
        if 0 < peak < 1 << 13:
            self.complain(
                f"{name}: the first image uses {peak.bit_length()} of its 16 bits; of 16 the high "
                "byte is taken, so it is dark"
            )

    def close(self) -> None:  # noqa: B027  # most hold nothing
        """Release all resources."""


USUAL = Category.SENSOR | Category.GEOMETRY | Category.VEHICLE  # categories sent by default


class Choice:
    """Selection of events; see `nodes.data.replay.reader` for the rules.

    Args:
        only: Types and sources that events must be of; if empty, the usual categories, without
            estimators.
    """

    def __init__(
        self,
        only: Sequence[str] = (),
        skip: Sequence[str] = (),  # types and sources left out
        announcements: Iterable[Announcement] = (),
    ) -> None:
        types = {kind.__name__ for kind in _types(Event)}
        self._types = [name for name in only if name in types]
        self._sources = [name for name in only if name not in types]
        self._skip = list(skip)
        self._estimators = {a.source for a in announcements if isinstance(a, EstimatorAnnouncement)}
        self._answers: dict[tuple[type[Event], str], bool] = {}
        self.unmatched = {*only, *skip}  # names without a matching event so far

    def __call__(self, kind: type[Event], source: str) -> bool:
        """Return whether events of a type from a source are wanted."""
        key = kind, source
        answer = self._answers.get(key)
        if answer is None:
            answer = self._answers[key] = self._wants(kind, source)
        return answer

    def announced(self, announcement: Announcement) -> bool:
        """Return whether to replay an announcement: all but those without selected events."""
        if any(self._matches(name, type(announcement), announcement.source) for name in self._skip):
            return False
        if isinstance(announcement, EstimatorAnnouncement):
            return self(PoseEstimate, announcement.source)
        return True

    def _wants(self, kind: type[Event], source: str) -> bool:
        # All names are matched, so that `unmatched` is right.
        skipped = [self._matches(name, kind, source) for name in self._skip]
        of_type = [self._matches(name, kind, source) for name in self._types]
        of_source = [self._matches(name, kind, source) for name in self._sources]
        if any(skipped):
            return False
        if of_type or of_source:
            return (any(of_type) or not of_type) and (any(of_source) or not of_source)
        return bool(kind.category & USUAL) and source not in self._estimators

    def _matches(self, name: str, kind: type[Event], source: str) -> bool:
        matched = (
            name in {base.__name__ for base in kind.__mro__}
            or source == name
            or source.startswith(f"{name}/")
        )
        if matched:
            self.unmatched.discard(name)
        return matched


def _types(cls: type[Event]) -> list[type[Event]]:
    return [cls, *(kind for subclass in cls.__subclasses__() for kind in _types(subclass))]


Use = Literal["image", "depth", "imu", "odometry", "truth", "estimate", "camera"]


class BagTopic(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic of a ROS bag and the use of its messages.

    Attributes:
        use: ``as`` in the file. ``image`` (from Image or CompressedImage), ``depth``, ``camera``
            (CameraInfo: a camera is announced), ``imu``, ``odometry`` and ``truth`` (Odometry,
            PoseStamped or TransformStamped: the vehicle's true pose), ``estimate``.
        source: Of the events; if empty, the node's name, and for a camera the topic's namespace.
        frame_id: If set, the frame of the events, in place of the messages'.
    """

    topic: str
    use: Use = msgspec.field(name="as")
    source: str = ""
    frame_id: str = ""


class Pinhole(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Intrinsics of a camera, for data sets without intrinsics; `fx`, `fy`, `cx`, `cy` in pixels.

    Attributes:
        fx: Pixels.
        fy: Pixels.
        cx: Pixels.
        cy: Pixels.
        distortion_model: As in ROS's ``camera_info``.
        distortion: Its coefficients: of plumb_bob k1, k2, p1, p2, k3.
    """

    fx: Annotated[float, msgspec.Meta(gt=0)]
    fy: Annotated[float, msgspec.Meta(gt=0)]
    cx: float
    cy: float
    distortion_model: DistortionModel = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.info(1, 1)

    def info(self, width: int, height: int) -> CameraInfo:
        """Return the intrinsics of images of a size; a `ValueError` if coefficients are missing."""
        return CameraInfo(width=width, height=height, **msgspec.structs.asdict(self))


class ReplayConfig(NodeConfig):
    """Settings of a replay.

    Attributes:
        file: A recording of `nodes.data.recorder` (torn ones too), a ROS bag (of ROS 2 a folder, or
            an MCAP or SQLite file; of ROS 1 a file; or a folder with one of these in it), or the
            folder of a data set in the layout of EuRoC, of TUM VI, of TUM RGB-D, or of KITTI's
            odometry (``sequences/00``).
        start: Where to begin; the run's clock and stamps count from there.
        end: Where to end, on the recording's own time; 0 for its end.
        linger: How long the run goes on after the last event, so that others can react; 0 if the
            recording or `end` says when it ends.
        loop: Begin again at the end; clock and stamps go on.
        paused: Send nothing; can change in a run. The clock goes on, and events come later.
        position: Where to go on when set in a run, on the recording's own time.
        only: Types (``Image``, ``Odometry``) and sources (``drone``, with all below it); events
            must be of the types and from the sources named. ``["Event"]`` is everything. If empty:
            events of sensors and of the vehicle, and true poses; not of pilots, estimators and
            evaluations.
        skip: Types and sources left out.
        memory: Bytes that may be read ahead.
        topics: Topics read from a ROS bag, and their use; if empty, one stream a camera, IMUs and
            the first odometry, as the log says.
        calibration: Files of Kalibr's (``["camchain-imucam.yaml", "imu.yaml"]``) in the place of
            what a bag or a data set in EuRoC's layout says of cameras and IMU. A bag's cameras are
            found by ``rostopic``, a data set's by their names.
        vehicle: Source of a data set's true poses; its cameras are below it. If empty, the node's
            name.
        camera: Intrinsics of a data set in TUM's layout, if it has no camera.yaml.
        depth_factor: Steps of its depth images per metre.
    """

    file: InputPath
    start: Duration = Duration(0)  # immutable
    end: Duration = Duration(0)
    linger: Duration = Duration(0.5)
    loop: bool = False
    paused: Changeable[bool] = False
    position: Changeable[Duration] = Duration(0)
    only: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()
    memory: Annotated[int, msgspec.Meta(ge=1 << 20)] = 128 << 20
    topics: tuple[BagTopic, ...] = ()
    calibration: tuple[InputPath, ...] = ()
    vehicle: str = ""
    camera: Pinhole | None = None
    depth_factor: Annotated[float, msgspec.Meta(gt=0)] = 5000.0

    def __post_init__(self) -> None:
        if self.end and self.end <= self.start:
            raise ValueError(f"end: expected a time after start, {self.start:g} s")
