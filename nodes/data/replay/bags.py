"""Recordings of `nodes.data.recorder`, restored unchanged, and foreign ROS bags.

Foreign messages become events in our frames (`nodes.ros2.messages`). They keep a header's stamp,
unless zero, and are sent at their time of receipt; two different clocks each count from their own
first. Topics that settings do not name are known by type and name.
Cameras sit where ``/tf_static`` puts their optical frames in ``base_link``, else look ahead from
the body's origin.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import msgspec

from events import (
    Announcement,
    CameraAnnouncement,
    EstimatorAnnouncement,
    Event,
    Image,
    ImuAnnouncement,
    Odometry,
)
from events.frames import convert_rotation, convert_vector, multiply, normalize, rotate
from events.geometry import Pose
from nodes.data.mcap import layout, native
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import Record, contents, read
from nodes.data.mcap.native import HOLDERS, arrays
from nodes.data.replay.folders import vehicle_at
from nodes.data.replay.reader import BagTopic, Reader, ReplayError, Timed, Use, Wants
from nodes.ros2.messages.incoming import MessageContext, camera_announcement
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.typestore import Bag, Stamps, TypeStore
from runtime.channels.wire import event_type
from runtime.errors import VisnavError, WireError, suggest
from runtime.time.clock import SECOND

_LOOK = 64  # messages searched for our own metadata, in files rewritten by other tools


class Recorded(Reader):
    """Reader of a recording of ours, torn ones too; a `ReplayError` if it is no MCAP file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._store = TypeStore()
        self._frames = FrameNames()
        try:
            self._contents = contents(path)
        except RecordingError as error:
            raise ReplayError(str(error)) from None
        self._announcements = tuple(self._read_announcements())
        for announcement in self._announcements:
            if isinstance(announcement, CameraAnnouncement):
                self._frames.add(announcement)

    def announcements(self) -> Sequence[Announcement]:
        """Return the recorded announcements."""
        return self._announcements

    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield the recorded events, equal to the originals."""
        holders: dict[str, Record] = {}  # the newest of each topic, until its event has come
        for record in read(self._path, start, end, self.complain):
            if record.type in HOLDERS:
                holders[record.topic] = record
            kind = record.metadata.get("kind")
            if kind is None or record.metadata.get("announcement"):
                continue
            holder = holders.pop(record.metadata.get("arrays", ""), None)
            try:
                if wants(event_type(kind), record.metadata.get("source", "")):
                    yield Timed(record.time, self._event(record, holder))
            except (WireError, ValueError) as error:
                self.left_out += 1
                self.complain(f"{record.topic}: {error}")

    def end(self) -> int | None:
        """Return the recorder's end time (ns); `None` if not noted."""
        end = self._contents.metadata.get("visnav", {}).get("end", "")
        return int(end) if end.isdigit() else None

    def _event(self, record: Record, holder: Record | None) -> Event:
        lacking = native.lacking(record.data)
        if not lacking:
            return native.event(record.data)
        if holder is None or holder.time != record.time:
            raise ValueError(f"expected a message of {record.time} ns with its arrays, found none")
        # All events with arrays and a message have a frame.
        frame = native.fields(record.data).get("frame_id", "map")
        axes = self._frames.axes(frame)
        found = arrays(self._store, holder.data, holder.type, lacking, axes)
        return native.event(record.data, found)

    def _read_announcements(self) -> Iterator[Announcement]:
        for record in read(self._path):
            if record.metadata.get("announcement"):
                try:
                    event = native.event(record.data)
                except WireError as error:
                    self.complain(f"{record.topic}: {error}")
                    continue
                if isinstance(event, Announcement):
                    yield event
            elif "kind" in record.metadata:
                return


def is_ours(path: Path) -> bool:
    """Return whether a file is our recording, or one rewritten; a `ReplayError` if no MCAP file."""
    try:
        if contents(path).ours:
            return True
        return any("kind" in record.metadata for record in islice(read(path), _LOOK))
    except RecordingError as error:
        raise ReplayError(str(error)) from None


TYPES = {use: tuple(t for t, to in READERS if to == use) for use in get_args(Use)}
"""Readable message types of each use."""

_PARTS = {
    "image", "image_raw", "image_rect", "image_color", "image_rect_color", "image_mono",
    "camera_info", "compressed", "compressedDepth", "depth", "color", "rgb", "depth_registered",
}  # fmt: skip
"""Parts of topic names for the kind of data, not its source."""


def chosen(
    found: Mapping[str, tuple[str, int]],  # type and number of messages, by topic
    wanted: tuple[BagTopic, ...],  # from the file; if empty, topics are taken by type and name
    vehicle: str,
) -> dict[str, BagTopic]:
    """Return the topics to read, by name, with all sources; a `ReplayError` if one is missing."""
    there = ", ".join(f"{name} ({type_})" for name, (type_, _) in sorted(found.items()))
    for topic in wanted:
        if topic.topic not in found:
            fit = [f"{k} ({v})" for k, (v, _) in sorted(found.items()) if v in TYPES[topic.use]]
            raise ReplayError(
                f"topics: expected one of the bag's, found {topic.topic!r}"
                f"{suggest(topic.topic, found)}; {topic.use} can be: {', '.join(fit) or 'none'}"
            )
        type_ = found[topic.topic][0]
        if type_ not in TYPES[topic.use]:
            raise ReplayError(
                f"topics: {topic.topic}: expected {' or '.join(TYPES[topic.use])} "
                f"for {topic.use}, found {type_}"
            )
    taken = wanted or _guessed(found)
    if not taken:
        raise ReplayError(f"expected topics of cameras, IMUs or poses, found: {there or 'none'}")
    return {
        topic.topic: msgspec.structs.replace(topic, source=topic.source or _source(topic, vehicle))
        for topic in taken
    }


def _guessed(found: Mapping[str, tuple[str, int]]) -> list[BagTopic]:
    taken: list[BagTopic] = []
    truth = False
    for name, (type_, count) in sorted(found.items()):
        use: Use | None = None
        if not count or name.startswith("/visnav/"):
            continue
        if type_ == "sensor_msgs/msg/Image":
            use = "depth" if "depth" in name else "image"
        elif type_ == "sensor_msgs/msg/CompressedImage":
            raw_type, raw_count = found.get(name.rpartition("/")[0], ("", 0))
            if not (raw_type == "sensor_msgs/msg/Image" and raw_count):
                use = "depth" if "depth" in name.lower() else "image"
        elif type_ == "sensor_msgs/msg/CameraInfo":
            use = None if "depth" in name else "camera"
        elif type_ == "sensor_msgs/msg/Imu":
            use = "imu"
        elif type_ == "nav_msgs/msg/Odometry" and not truth:
            use, truth = "odometry", True
        if use is not None and "segmentation" not in name:
            taken.append(BagTopic(topic=name, use=use))
    return taken


def _source(topic: BagTopic, vehicle: str) -> str:
    """Return the source of a topic's events: of a camera, its namespace, below the vehicle."""
    if topic.use in {"odometry", "truth"}:
        return vehicle
    if topic.use == "estimate":
        return topic.topic.strip("/")
    parts = [part for part in topic.topic.split("/") if part]
    if parts and parts[0] == vehicle:
        parts = parts[1:]
    if topic.use != "imu":
        cut = next((n for n, part in enumerate(parts) if part in _PARTS), len(parts))
        parts = parts[:cut]
    return "/".join((vehicle, *(parts or ["camera"])))


LONGEST = 16  # transforms between a camera and the body, at most: more would go in circles
_HERE: Pose = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class Mountings:
    """A tree of fixed transforms, in ROS's axes, from messages of tf2_msgs/TFMessage."""

    def __init__(self, messages: Iterable[Any]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for each in message.transforms:
                t, r = each.transform.translation, each.transform.rotation
                pose = (
                    (float(t.x), float(t.y), float(t.z)),
                    normalize((float(r.w), float(r.x), float(r.y), float(r.z))),
                )
                self._parents[each.child_frame_id] = each.header.frame_id, pose

    def of(self, optical: str, body: str = "base_link") -> Pose | None:
        """Return the pose of an optical frame in the body, FRD; `None` if unknown."""
        frame, (position, rotation) = optical, _HERE
        for _ in range(LONGEST):
            if frame == body:
                return convert_vector("body", position), convert_rotation(
                    "body", "optical", rotation
                )
            if frame not in self._parents:
                return None
            frame, (offset, turn) = self._parents[frame]
            x, y, z = rotate(turn, position)
            position = (x + offset[0], y + offset[1], z + offset[2])
            rotation = multiply(turn, rotation)
        return None


_SAME_CLOCK = 60 * SECOND  # largest difference of stamp and receipt on a common clock, nanoseconds
_EVENTS = {use: row.becomes or row.events[0] for (_, use), row in READERS.items() if use in TYPES}
_LATER = 1 << 62  # placeholder for the stamp of a message without a stamp


class RosBag(Reader):
    """Reader of a ROS bag.

    Args:
        path: A folder, or an MCAP or SQLite file.
        topics: Topics to read; if empty, by types and names.

    Raises:
        ReplayError: It cannot be read, or a topic is not there.
    """

    def __init__(self, path: Path, topics: tuple[BagTopic, ...], vehicle: str) -> None:
        super().__init__()
        self._path, self._vehicle = path, vehicle
        with readable(path):
            self._bag = open_bag(path)
        try:
            with readable(path):
                found = self._bag.topics()
                self._topics = chosen(found, topics, vehicle)
                self._firsts = self._first_messages()
                self._times, self._stamps = self._origins()
                self._announcements = list(self._announced(found))
        except ReplayError:
            self._bag.close()
            raise

    def announcements(self) -> Sequence[Announcement]:
        """Return the announcements of vehicle (first pose), cameras, IMUs, estimators."""
        return self._announcements

    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield the events of the topics' messages; invalid messages are left out."""
        names = [
            name
            for name, topic in self._topics.items()
            if topic.use != "camera" and wants(_EVENTS[topic.use], topic.source)
        ]
        stop = None if end is None else end + self._times
        wrong: set[str] = set()
        with readable(self._path):
            for name, type_, time, message in self._bag.messages(names, start + self._times, stop):
                try:
                    event = self._event(self._topics[name], type_, message)
                except (ValueError, TypeError, ArithmeticError, AttributeError) as error:
                    self.left_out += 1
                    if name not in wrong:  # one example of each topic is enough
                        wrong.add(name)
                        self.complain(f"{name}: {error}")
                    continue
                if event.stamp == _LATER:
                    event = msgspec.structs.replace(event, stamp=time - self._times)
                yield Timed(time - self._times, event)

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()

    def _event(self, topic: BagTopic, type_: str, message: Any) -> Event:
        if 0 < (at := _stamp(message)) < self._stamps.offset:
            early = (self._stamps.offset - at) / 1e9
            raise ValueError(
                f"expected no stamp before the first, found one {early:.3f} s before it"
            )
        context = MessageContext(
            source=topic.source, now=_LATER, stamps=self._stamps, frame_id=topic.frame_id
        )
        use = "truth" if topic.use == "odometry" else topic.use  # the vehicle's
        event = READERS[type_, use].read(message, context)
        assert event is not None
        return event

    def _first_messages(self) -> dict[str, tuple[str, int, Any]]:
        """Return type, time of receipt and content of each topic's first message."""
        found: dict[str, tuple[str, int, Any]] = {}
        for name in self._topics:
            for _, type_, time, message in self._bag.messages([name]):
                found[name] = type_, time, message
                break
        if not found:
            raise ReplayError(f"expected messages on {', '.join(self._topics)}, found none")
        return found

    def _origins(self) -> tuple[int, Stamps]:
        """Return the time of receipt counted as 0, and the conversion of stamps."""
        times = [time for _, time, _ in self._firsts.values()]
        found = ((time, _stamp(message)) for _, time, message in self._firsts.values())
        stamped = [(time, at) for time, at in found if at]
        stamps = [at for _, at in stamped]
        if all(abs(time - at) < _SAME_CLOCK for time, at in stamped):
            origin = min(times + stamps)
            return origin, Stamps(origin)
        return min(times), Stamps(min(stamps))

    def _announced(self, found: dict[str, tuple[str, int]]) -> Iterator[Announcement]:
        for name, topic in self._topics.items():
            if topic.use in {"odometry", "truth"} and name in self._firsts:
                type_, _, message = self._firsts[name]
                event = self._event(topic, type_, message)
                assert isinstance(event, Odometry)
                yield vehicle_at(event)
        yield from self._cameras(found)
        for name, topic in self._topics.items():
            if topic.use == "imu" and name in self._firsts:
                header = self._firsts[name][2].header
                yield ImuAnnouncement(
                    stamp=0,
                    source=topic.source,
                    rate=self._rate(found[name][1]),
                    frame_id=topic.frame_id or header.frame_id or "base_link",
                    gyroscope_noise_density=0.0,  # messages do not say
                    gyroscope_random_walk=0.0,
                    accelerometer_noise_density=0.0,
                    accelerometer_random_walk=0.0,
                )
            elif topic.use == "estimate":
                yield EstimatorAnnouncement(
                    stamp=0, source=topic.source, method=f"ROS: {topic.topic}"
                )

    def _cameras(self, found: dict[str, tuple[str, int]]) -> Iterator[CameraAnnouncement]:
        mountings = Mountings(
            message
            for _, type_, _, message in self._bag.messages(["/tf_static"])
            if type_ == "tf2_msgs/msg/TFMessage"
        )
        images: dict[str, list[str]] = {}
        rates: dict[str, float] = {}
        for name, topic in self._topics.items():
            if topic.use in {"image", "depth"} and name in self._firsts:
                type_, _, message = self._firsts[name]
                kind = "depth"
                if topic.use == "image":
                    event = self._event(topic, type_, message)
                    assert isinstance(event, Image)
                    kind = "rgb" if event.encoding == "rgb8" else "grey"
                images.setdefault(topic.source, []).append(kind)
                rates[topic.source] = self._rate(found[name][1])
        for name, topic in self._topics.items():
            if topic.use == "camera" and name in self._firsts and topic.source in images:
                kinds = tuple(images.pop(topic.source))
                message = self._firsts[name][2]
                camera = camera_announcement(message, topic.source, kinds, topic.frame_id)
                camera = msgspec.structs.replace(camera, rate=rates[topic.source])
                mounting = mountings.of(message.header.frame_id)
                if mounting is not None:
                    place, turn = mounting
                    camera = msgspec.structs.replace(camera, position=place, orientation=turn)
                yield camera
        for source in images:
            self.complain(f"{source}: expected a camera_info, found none: it is not announced")

    def _rate(self, count: int) -> float:
        seconds = (self._bag.end - self._bag.start) / 1e9
        return max(count - 1, 1) / seconds if seconds > 0 else 1.0


def open_bag(path: Path) -> Bag:
    """Open a bag after a check of its chunks' claimed sizes; call within `readable`."""
    for each in [path] if path.is_file() else sorted(path.glob("*.mcap")):
        with each.open("rb") as file:
            if file.read(len(layout.MAGIC)) == layout.MAGIC:
                layout.check_chunks(file)  # rosbags would believe whatever they claim
    return Bag(path)


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn any exception of rosbags on a damaged bag into an error with the bag's name."""
    try:
        yield
    except VisnavError:
        raise
    except Exception as error:
        what = " ".join(str(error).split()) or type(error).__name__
        if not isinstance(error, ReplayError | ValueError):
            what = f"expected a readable bag, found: {what}"
        raise ReplayError(what if str(path) in what else f"{path}: {what}") from error


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)
