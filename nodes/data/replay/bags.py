"""Recordings of `nodes.data.recorder`, restored unchanged, and foreign ROS bags.

Foreign messages become events in our frames (`nodes.ros2.messages`). They keep a header's stamp,
unless zero, and are sent at their time of receipt; two different clocks each count from their own
first. Topics that settings do not name are chosen by `nodes.data.replay.streams`.
Cameras and IMUs sit where ``/tf_static`` puts their frames in ``base_link``, else in the body's
origin, where cameras look ahead; or where Kalibr's calibration has them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    EstimatorAnnouncement,
    Event,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
)
from events.frames import (
    Axes,
    angle_between,
    axes_of,
    convert_rotation,
    convert_vector,
    multiply,
    normalize,
    rotate,
)
from events.geometry import Pose, pose_tuples
from nodes.data.mcap import layout, native
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import Record, contents, read
from nodes.data.mcap.native import HOLDERS, arrays
from nodes.data.replay.chains import (
    as_pairs,
    check_size,
    imu_in_body,
    mountings,
    with_noise,
)
from nodes.data.replay.folders import camera_at, vehicle_at
from nodes.data.replay.reader import BagTopic, Reader, ReplayError, Timed, Use, Wants
from nodes.data.replay.streams import (
    GUESSED,
    base_of,
    calibration,
    guess,
    source_of,
    topic_in,
)
from nodes.kalibr import Chain, is_rotation
from nodes.ros2.messages.incoming import MessageContext, camera_announcement
from nodes.ros2.messages.mappings import READERS
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.typestore import Bag, MessageError, Stamps, TypeStore
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
        missing = native.missing_arrays(record.data)
        if not missing:
            return native.event(record.data)
        if holder is None or holder.time != record.time:
            raise ValueError(f"expected a message of {record.time} ns with its arrays, found none")
        # All events with arrays and a message have a frame.
        frame = native.fields(record.data).get("frame_id", "map")
        axes = self._frames.axes(frame)
        pixels = arrays(self._store, holder.data, holder.type, missing, axes)
        return native.event(record.data, pixels)

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


def is_recording(path: Path) -> bool:
    """Return whether a file is our recording, or one rewritten; a `ReplayError` if no MCAP file."""
    try:
        if contents(path).ours:
            return True
        return any("kind" in record.metadata for record in islice(read(path), _LOOK))
    except RecordingError as error:
        raise ReplayError(str(error)) from None


TYPES = {use: tuple(t for t, to in READERS if to == use) for use in get_args(Use)}
"""Readable message types of each use."""


def chosen(
    topics: Mapping[str, tuple[str, int]],  # type and number of messages, by topic
    requested: tuple[BagTopic, ...],
    vehicle: str,
) -> dict[str, BagTopic]:
    """Return the topics to read, by name, with all sources; a `ReplayError` if one is missing."""
    by_name: dict[str, BagTopic] = {}
    for topic in requested:
        name = topic_in(topics, topic.topic)
        if name not in topics:
            fit = [f"{k} ({v})" for k, (v, _) in sorted(topics.items()) if v in TYPES[topic.use]]
            raise ReplayError(
                f"topics: expected one of the bag's, found {topic.topic!r}"
                f"{suggest(topic.topic, topics)}; {topic.use} can be: {', '.join(fit) or 'none'}"
            )
        type_ = topics[name][0]
        if type_ not in TYPES[topic.use]:
            raise ReplayError(
                f"topics: {name}: expected {' or '.join(TYPES[topic.use])} "
                f"for {topic.use}, found {type_}"
            )
        source = topic.source or source_of(name, topic.use, vehicle)
        by_name[name] = msgspec.structs.replace(topic, topic=name, source=source)
    return by_name


LONGEST = 16  # transforms between a camera and the body, at most: more would go in circles
_IDENTITY: Pose = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class Mountings:
    """A tree of fixed transforms, in ROS's axes, from messages of tf2_msgs/TFMessage.

    Args:
        complain: Called with a sentence on a transform that is none, and is left out.
    """

    def __init__(self, messages: Iterable[Any], complain: Callable[[str], None]) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}
        for message in messages:
            for stamped in message.transforms:
                t, r = stamped.transform.translation, stamped.transform.rotation
                position = (float(t.x), float(t.y), float(t.z))
                try:
                    turn = normalize((float(r.w), float(r.x), float(r.y), float(r.z)))
                    if not all(map(isfinite, position)):
                        raise ValueError(f"expected a finite place, found {position}")
                except ValueError as error:
                    complain(f"/tf_static: {stamped.child_frame_id} is left out: {error}")
                    continue
                self._parents[stamped.child_frame_id] = stamped.header.frame_id, (position, turn)

    def pose(self, frame: str, axes: Axes = "optical", body: str = "base_link") -> Pose | None:
        """Return the pose of a frame, with such axes here, in the body, FRD; `None` if unknown."""
        root, (position, rotation) = self._to_root(frame, body)
        if root != body:
            return None
        return convert_vector("body", position), convert_rotation("body", axes, rotation)

    def are_same(self, frame: str, other: str) -> bool:
        """Return whether two frames are known to be one, to 0.1 mm and 0.1 mrad."""
        (root, a), (other_root, b) = self._to_root(frame), self._to_root(other)
        distance = max(abs(x - y) for x, y in zip(a[0], b[0], strict=True))
        return root == other_root and distance < 1e-4 and angle_between(a[1], b[1]) < 1e-4

    def _to_root(self, frame: str, end: str = "") -> tuple[str, Pose]:
        """Return the last known parent of a frame, or `end`, and the frame's pose in it."""
        position, rotation = _IDENTITY
        for _ in range(LONGEST):
            if frame == end or frame not in self._parents:
                break
            frame, (offset, turn) = self._parents[frame]
            x, y, z = rotate(turn, position)
            position = (x + offset[0], y + offset[1], z + offset[2])
            rotation = multiply(turn, rotation)
        return frame, (position, rotation)


_SAME_CLOCK = 60 * SECOND  # largest difference of stamp and receipt on a common clock, nanoseconds
_EVENTS = {use: row.becomes or row.events[0] for (_, use), row in READERS.items() if use in TYPES}
_INVALID = (ValueError, TypeError, ArithmeticError, AttributeError)  # of a message's content
_TRIED = 100  # first messages of a topic among which there has to be a valid one
_LATER = 1 << 62  # placeholder for the stamp of a message without a stamp


class RosBag(Reader):
    """Reader of a ROS bag.

    Args:
        path: A folder, or an MCAP or SQLite file.
        topics: Topics to read; if empty, by types, names and calibrations, and topics that cannot
            be read are left out, each with a complaint.
        calibration: Of its cameras, found by their topics, in the place of their camera_info.

    Raises:
        ReplayError: It cannot be read, a named topic is not there or cannot be read, or nothing is
            left.
    """

    def __init__(
        self,
        path: Path,
        topics: tuple[BagTopic, ...],
        vehicle: str,
        calibration: Chain | None = None,
    ) -> None:
        super().__init__()
        self._path, self._vehicle, self._chain = path, vehicle, calibration
        self._named = bool(topics)
        with readable(path):
            self._bag = open_bag(path)
        try:
            with readable(path):
                self._bag_topics = self._bag.topics()
                self._mountings = self._read_mountings()
                self._firsts = self._first_messages(topics)
                self._topics = self._choose(topics)
                self._firsts = {k: v for k, v in self._firsts.items() if k in self._topics}
                self._times, self._stamps = self._origins()
                self._announcements = list(self._announced())
                names = (name for name in self._firsts if name in self._topics)
                if all(self._topics[name].use == "camera" for name in names):
                    raise ReplayError(f"{path}: expected a topic to replay; {self._reasons()}")
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
                except _INVALID as error:
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

    def _read_mountings(self) -> Mountings:
        try:
            messages = (
                message
                for _, type_, _, message in self._bag.messages(["/tf_static", "tf_static"])
                if type_ == "tf2_msgs/msg/TFMessage"
            )
            return Mountings(messages, self.complain)
        except MessageError as error:
            self.complain(f"/tf_static: left out: {error}")
            return Mountings((), self.complain)

    def _first_messages(self, topics: tuple[BagTopic, ...]) -> dict[str, tuple[str, int, Any]]:
        """Return type, time of receipt and content of the first message of each topic to read."""
        names = list(chosen(self._bag_topics, topics, self._vehicle))
        if not self._named:
            listed = self._bag_topics.items()
            names = [name for name, (type_, count) in listed if count and type_ in GUESSED]
        firsts: dict[str, tuple[str, int, Any]] = {}
        for name in sorted(names):
            try:
                for _, type_, time, message in self._bag.messages([name]):
                    firsts[name] = type_, time, message
                    break
            except MessageError as error:
                self._refuse(name, error)
        if self._named and not firsts:
            raise ReplayError(f"expected messages on {', '.join(names)}, found none")
        return firsts

    def _choose(self, topics: tuple[BagTopic, ...]) -> dict[str, BagTopic]:
        if self._named:
            return chosen(self._bag_topics, topics, self._vehicle)
        messages = {name: message for name, (_, _, message) in self._firsts.items()}
        cameras = self._chain.cameras if self._chain else ()
        calibrated = {topic_in(self._bag_topics, camera.topic): camera.info for camera in cameras}
        same_frame = self._mountings.are_same
        streams = guess(self._bag_topics, messages, self._vehicle, same_frame, calibrated)
        self.notes += streams.notes
        for reason in streams.left_out:
            self.complain(reason)
        if not streams.topics:
            types = sorted((name, type_) for name, (type_, _) in self._bag_topics.items())
            listed = ", ".join(f"{name} ({type_})" for name, type_ in types)
            reasons = f"; {self._reasons()}" if self.trouble else ""
            raise ReplayError(
                f"expected topics of cameras, IMUs or poses, found: {listed or 'none'}{reasons}"
            )
        return {topic.topic: topic for topic in streams.topics}

    def _reasons(self) -> str:
        return "; ".join(self.trouble) or "none has a message"

    def _refuse(self, name: str, error: object) -> None:
        """Leave a topic out, by name; raise a `ReplayError` if the settings name it."""
        if self._named:
            raise ReplayError(f"topics: {name}: {error}") from None
        self.complain(f"{name}: left out: {error}")

    def _origins(self) -> tuple[int, Stamps]:
        """Return the time of receipt counted as 0, and the conversion of stamps."""
        times = [time for _, time, _ in self._firsts.values()]
        pairs = ((time, _stamp(message)) for _, time, message in self._firsts.values())
        stamped = [(time, at) for time, at in pairs if at]
        stamps = [at for _, at in stamped]
        if all(abs(time - at) < _SAME_CLOCK for time, at in stamped):
            origin = min(times + stamps)
            return origin, Stamps(origin)
        return min(times), Stamps(min(stamps))

    def _first_events(self, *uses: Use) -> Iterator[tuple[str, BagTopic, Event]]:
        """Yield the first valid event of each topic; a topic without any is left out."""
        for name, topic in list(self._topics.items()):
            if topic.use not in uses or name not in self._firsts:
                continue
            wrong: Exception | None = None
            for _, type_, _, message in islice(self._bag.messages([name]), _TRIED):
                try:
                    yield name, topic, self._event(topic, type_, message)
                    break
                except _INVALID as error:
                    wrong = wrong or error
            else:
                self._refuse(name, wrong)
                del self._topics[name]

    def _announced(self) -> Iterator[Announcement]:
        for _, _, event in self._first_events("odometry", "truth"):
            assert isinstance(event, Odometry)
            yield vehicle_at(event)
        imus = [self._imu(*event) for event in self._first_events("imu")]
        yield from self._cameras(imus)
        yield from imus
        for topic in self._topics.values():
            if topic.use == "estimate":
                yield EstimatorAnnouncement(
                    stamp=0, source=topic.source, method=f"ROS: {topic.topic}"
                )

    def _imu(self, name: str, topic: BagTopic, event: Event) -> ImuAnnouncement:
        assert isinstance(event, Imu)
        frame = topic.frame_id or self._firsts[name][2].header.frame_id
        position, orientation = self._mountings.pose(frame, axes_of(event.frame_id)) or _IDENTITY
        return ImuAnnouncement(
            stamp=0,
            source=topic.source,
            rate=self._rate(name),
            frame_id=event.frame_id,
            position=position,
            orientation=orientation,
            gyroscope_noise_density=0.0,  # not in messages
            gyroscope_random_walk=0.0,
            accelerometer_noise_density=0.0,
            accelerometer_random_walk=0.0,
        )

    def _cameras(self, imus: list[ImuAnnouncement]) -> Iterator[CameraAnnouncement]:
        images: dict[str, list[tuple[str, str]]] = {}  # topics and kinds, by source
        sizes: dict[str, tuple[int, ...]] = {}
        for name, topic, event in self._first_events("image", "depth"):
            kind = "depth"
            if isinstance(event, Image):
                kind = "rgb" if event.encoding == "rgb8" else "grey"
                self._check_bits(name)
            assert isinstance(event, Image | DepthImage)
            images.setdefault(topic.source, []).append((name, kind))
            sizes[name] = event.data.shape[1::-1]
        for source, streams in images.items():
            several = [name for name, kind in streams if kind != "depth"]
            if len(several) > 1:
                self.complain(
                    f"{source}: expected one stream of images, found {', '.join(several)}: each "
                    "stamp may come twice; give each a source of its own"
                )
        if self._chain is not None:
            yield from self._by_chain(self._chain, images, sizes, imus)
        for name, topic in self._topics.items():
            if topic.use == "camera" and name in self._firsts and topic.source in images:
                try:
                    yield self._camera(name, topic, images[topic.source])
                except ValueError as error:
                    self._refuse(name, error)
                    continue
                del images[topic.source]
        for source in images:
            self.complain(
                f"{source}: expected a camera_info, found none: it is not announced; give a "
                "calibration by the setting calibration"
            )

    def _camera(
        self, name: str, topic: BagTopic, images: list[tuple[str, str]]
    ) -> CameraAnnouncement:
        """Return a camera by its CameraInfo; a `ValueError` if that is no calibration."""
        message, first = self._firsts[name][2], images[0][0]
        kinds = tuple(kind for _, kind in images)
        camera = camera_announcement(message, topic.source, kinds, topic.frame_id)
        info = calibration(message, first)
        place, turn = self._mountings.pose(message.header.frame_id) or (
            camera.position,
            camera.orientation,
        )
        if info != camera.info:  # rectified images are turned, too
            rectification = np.reshape(message.r, (3, 3)).astype(np.float64)
            if is_rotation(rectification):
                moved = np.eye(4)
                moved[:3, :3] = rectification.T
                turn = multiply(turn, pose_tuples(moved)[1])
        return msgspec.structs.replace(
            camera,
            rate=self._rate(first),
            info=info,
            baseline=abs(float(message.p[3])) / info.fx,
            position=place,
            orientation=turn,
        )

    def _by_chain(
        self,
        chain: Chain,
        images: dict[str, list[tuple[str, str]]],
        sizes: dict[str, tuple[int, ...]],
        imus: list[ImuAnnouncement],
    ) -> Iterator[CameraAnnouncement]:
        """Yield the cameras of a calibration, whose images are taken away; note the IMU's."""
        topics = {
            base_of(name): (source, name) for source, pairs in images.items() for name, _ in pairs
        }
        index = next(
            (n for n, i in enumerate(imus) if _is_calibrated(chain, self._topics, i)), None
        )
        body = imu_in_body(imus[index] if index is not None else None)
        if index is not None:
            imus[index] = with_noise(imus[index], chain)
        first = chain.cameras[0].topic if chain.cameras else ""
        _, name = topics.get(topic_in(topics, first), ("", ""))
        camera_pose = self._mountings.pose(self._firsts[name][2].header.frame_id) if name else None
        places = mountings(chain, body, camera_pose)
        cameras: list[CameraAnnouncement] = []
        for camera, (position, orientation) in zip(chain.cameras, places, strict=True):
            topic = topic_in(topics, camera.topic)
            if topic not in topics:
                self.complain(
                    f"calibration: {camera.name} is of the topic {camera.topic or '(none)'}, which "
                    f"is not read; those that are: {', '.join(sorted(topics)) or 'none'}"
                )
                continue
            source, name = topics[topic]
            check_size(camera, sizes[name], name)
            announced = camera_at(
                source,
                tuple(kind for _, kind in images.pop(source)),
                camera.info,
                self._rate(name),
                position,
                orientation,
            )
            cameras.append(
                msgspec.structs.replace(
                    announced,
                    frame_id=self._topics[name].frame_id or self._firsts[name][2].header.frame_id,
                    time_offset=camera.time_offset,
                )
            )
        if chain.cameras and not cameras:
            raise ReplayError(
                f"{chain.where}: expected the calibration of a camera that is read, found "
                f"{', '.join(c.topic or c.name for c in chain.cameras)}; set rostopic to one of "
                f"{', '.join(sorted(topics)) or 'none'}"
            )
        yield from as_pairs(cameras)

    def _check_bits(self, name: str) -> None:
        message = self._firsts[name][2]
        if getattr(message, "encoding", "").endswith("16"):
            order = ">" if message.is_bigendian else "<"
            self.check_bits(name, np.frombuffer(message.data.tobytes(), f"{order}u2"))

    def _rate(self, name: str) -> float:
        count = self._bag_topics[name][1]
        seconds = (self._bag.end - self._bag.start) / 1e9
        return max(count - 1, 1) / seconds if seconds > 0 else 1.0


def _is_calibrated(chain: Chain, topics: Mapping[str, BagTopic], imu: ImuAnnouncement) -> bool:
    """Return whether a calibration's transforms are of an IMU: by its topic, or as the only one."""
    names = {name: topic.source for name, topic in topics.items() if topic.use == "imu"}
    named = topic_in(names, chain.imu.topic) if chain.imu and chain.imu.topic else ""
    return names[named] == imu.source if named in names else len(names) == 1


def open_bag(path: Path) -> Bag:
    """Open a bag after a check of its chunks' claimed sizes; call within `readable`."""
    for mcap_path in [path] if path.is_file() else sorted(path.glob("*.mcap")):
        with mcap_path.open("rb") as file:
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
        text = " ".join(str(error).split()) or type(error).__name__
        if not isinstance(error, ReplayError | ValueError):
            text = f"expected a readable bag, found: {text}"
        raise ReplayError(text if str(path) in text else f"{path}: {text}") from error


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)
