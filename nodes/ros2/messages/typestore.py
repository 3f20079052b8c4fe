"""Message types, their hashes, CDR, and bags: the only import of rosbags.

Messages are of rosbags' classes, with fields as in ROS's files. A mapping of the user's own is
called with an event and a `MessageBuilder`::

    def battery(event: Battery, builder: MessageBuilder) -> Any:
        return builder.make(
            "sensor_msgs/msg/BatteryState",
            header=builder.header(event.stamp, "base_link", event.source),
            percentage=event.percentage,
        )
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec
import numpy as np

from nodes.ros2.messages.topics import NO_HASH, FrameNames, dds_type
from runtime.errors import MissingDependencyError, suggest
from runtime.extras import install_command
from runtime.time.clock import SECOND
from runtime.typed import override

Distribution = Literal["humble", "iron", "jazzy", "kilted"]


def _hash_as_ros_2_does() -> None:
    """Make rosbags hash ``char`` as ``uint8``, as rosidl_adapter does: keys contain the hash."""
    from rosbags.typesys.store import TIDMAP

    TIDMAP["char"] = TIDMAP["uint8"]


class MessageError(ValueError):
    """Bytes do not hold the expected message; the error text has the reason."""


class _Compiled(dict[str, Any]):
    """Compiled definitions of a store, those of ROS's own types shared with all later stores."""

    shared: ClassVar[dict[str, dict[str, Any]]] = {}
    """By distribution; a definition takes some milliseconds."""

    def __init__(self, distribution: str, standard: Collection[str]) -> None:
        self._shared = self.shared.setdefault(distribution, {})
        self._standard = frozenset(standard)
        super().__init__(self._shared)

    @override
    def __setitem__(self, name: str, definition: Any) -> None:
        super().__setitem__(name, definition)
        if name in self._standard:
            self._shared[name] = definition


class TypeStore:
    """Message types of a distribution of ROS 2.

    Args:
        distribution: Of ROS 2; a few definitions differ (``sensor_msgs/msg/Range``).
        definitions: Further types, with the ``.msg`` file of each.

    Raises:
        MissingDependencyError: rosbags is not installed.
        ValueError: A definition cannot be read.
    """

    def __init__(
        self, distribution: Distribution = "jazzy", definitions: Mapping[str, str] | None = None
    ) -> None:
        try:
            from rosbags.interfaces import Nodetype
            from rosbags.serde import SerdeError
            from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

            _hash_as_ros_2_does()
        except ImportError as error:
            raise MissingDependencyError(
                f"messages of ROS 2 need rosbags: {install_command('ros2')}"
            ) from error
        self._error = SerdeError
        self._node, self._parse = Nodetype, get_types_from_msg
        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._store.cache = _Compiled(distribution, self._store.fielddefs)
        self._hashed = distribution != "humble"
        for name, file in (definitions or {}).items():
            dds_type(name)
            try:
                self._store.register(get_types_from_msg(Path(file).read_text("utf-8"), name))
            except (OSError, UnicodeError, TypesysError) as error:
                raise ValueError(
                    f"definitions: {name}: expected a readable .msg file, found {file}: {error}"
                ) from error

    def add(self, type_: str, definition: str) -> None:
        """Add a message or service, also of an action, by its file's text without default values.

        A service's messages are ``…_Request`` and ``…_Response``; its hash is that of a type with
        these and an event as its fields (REP 2016).
        """
        plain, node = f"{type_.split('/')[0]}/msg/Plain", self._node  # rosbags names it so
        if "---" not in definition:
            self._store.register({type_: self._parse(definition, plain)[plain]})
            return
        request, _, response = definition.partition("---")
        types: Any = {
            f"{type_}_Request": self._parse(request, plain)[plain],
            f"{type_}_Response": self._parse(response, plain)[plain],
        }
        if self._hashed:
            event: Any = [("info", (node.NAME, "service_msgs/msg/ServiceEventInfo"))]
            event += [
                (part.lower(), (node.SEQUENCE, ((node.NAME, f"{type_}_{part}"), 1)))
                for part in ("Request", "Response")
            ]
            types[f"{type_}_Event"] = [], event
        parts = [name.rpartition("_")[2] for name in types]
        types[type_] = (
            [],
            [(f"{part.lower()}_message", (node.NAME, f"{type_}_{part}")) for part in parts],
        )
        self._store.register(types)

    def check(self, type_: str) -> None:
        """Raise a `ValueError` if a type, or one of its fields' types, is unknown."""
        if type_ not in self._store.types:
            raise ValueError(
                f"expected a known message type, found {type_!r}"
                + suggest(type_, self._store.types)
            )
        try:
            self._store.get_msgdef(type_)
        except KeyError as error:
            raise ValueError(f"{type_}: expected a definition of {error} too, found none") from None

    def hash(self, type_: str) -> str:
        """Return a known type's hash for keys (REP 2011: ``RIHS01_`` and 64 digits)."""
        self.check(type_)
        return self._store.hash_rihs01(type_) if self._hashed else NO_HASH

    def definition(self, type_: str) -> str:
        """Return a known type's definition with those of its fields' types, as in recordings."""
        self.check(type_)
        text: str = self._store.generate_msgdef(type_, ros_version=2)[0]
        return text

    def message(self, type_: str) -> Any:
        """Return the class of a type's messages."""
        return self._store.types[type_]

    def header(self, time: tuple[int, int], frame_id: str) -> Any:
        """Return a ``std_msgs/msg/Header`` with a time in seconds and nanoseconds."""
        stamp = self.message("builtin_interfaces/msg/Time")(sec=time[0], nanosec=time[1])
        return self.message("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)

    def zero(self, type_: str) -> Any:
        """Return a message of a known type, with zeros, empty texts and empty sequences."""
        self.check(type_)
        _, fields = self._store.fielddefs[type_]
        return self._store.types[type_](**{name: self._zero(*kind) for name, kind in fields})

    def _zero(self, kind: Any, of: Any) -> Any:
        if kind.name == "NAME":
            return self.zero(of)
        if kind.name == "BASE":
            texts = {"string": "", "wstring": "", "bool": False}
            return texts.get(of[0], 0.0 if of[0].startswith("float") else 0)
        inner, count = of
        count = count if kind.name == "ARRAY" else 0  # of a sequence, the most there may be
        if inner[0].name == "BASE" and "string" not in inner[1][0]:
            name = inner[1][0]
            return np.zeros(count, "uint8" if name in {"octet", "byte", "char"} else name)
        return [self._zero(*inner) for _ in range(count)]

    def serialize(self, message: Any) -> bytearray:
        """Return a message as CDR, with its header of four bytes."""
        written = self._store.serialize_cdr(message, message.__msgtype__, little_endian=True)
        buffer = written.obj
        return buffer if isinstance(buffer, bytearray) else bytearray(written)

    def deserialize(self, data: bytes, type_: str) -> Any:
        """Read a message, its arrays views of `data`; a `MessageError` if it is of no such type."""
        try:
            return self._store.deserialize_cdr(data, type_)
        # rosbags means to raise its own error only; what comes from outside had better not test it.
        except (self._error, ValueError, ArithmeticError, LookupError, MemoryError) as error:
            raise MessageError(str(error)) from None


class Bag:
    """Reader of a bag of ROS 2 (a folder, MCAP, SQLite) or ROS 1; may raise `ValueError`."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
            from rosbags.typesys import Stores, get_typestore

            _hash_as_ros_2_does()
        except ImportError as error:
            raise MissingDependencyError(
                f"bags need rosbags: {install_command('record')}"
            ) from error
        self._path = path
        try:
            # For bags that have no definitions, as SQLite's of before Iron.
            store = get_typestore(Stores.ROS2_JAZZY)
            self._reader = AnyReader([path], default_typestore=store)
            self._reader.open()  # one that fails closes what it had opened
        except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
            raise ValueError(f"{path}: expected a bag of ROS, found: {error}") from error
        self._errors = (AnyReaderError, ValueError, ArithmeticError, LookupError, MemoryError)
        self.start = int(self._reader.start_time)  # when the first message was received (ns)
        self.end = int(self._reader.end_time)

    def topics(self) -> dict[str, tuple[str, int]]:
        """Return the type and the number of messages of each topic; the type is empty if mixed."""
        return {
            name: (info.msgtype or "", int(info.msgcount))
            for name, info in self._reader.topics.items()
        }

    def messages(
        self,
        topics: Collection[str],
        start: int | None = None,  # first time of receipt (ns)
        stop: int | None = None,  # time of receipt (ns) before which messages end
        newest: bool = False,  # only the last of all; no other is decoded
    ) -> Iterator[tuple[str, str, int, Any]]:
        """Yield topic, type, time of receipt (ns) and message in order; may raise `ValueError`."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        try:
            records = self._reader.messages(chosen, start, stop)
            for connection, time, data in deque(records, maxlen=1) if newest else records:
                yield connection.topic, connection.msgtype, time, self._message(connection, data)
        except MessageError:
            raise
        except self._errors as error:
            raise ValueError(f"{self._path}: expected a readable bag, found: {error}") from error

    def _message(self, connection: Any, data: bytes) -> Any:
        try:
            return self._reader.deserialize(data, connection.msgtype)
        except self._errors as error:
            raise MessageError(
                f"{self._path}: {connection.topic}: expected a readable {connection.msgtype}, "
                f"found: {error}"
            ) from error

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()


AHEAD = SECOND  # how far ahead of the run's clock a stamp from outside may be (ns)
Time = tuple[int, int]  # the time in a message: seconds and nanoseconds


class Stamps(msgspec.Struct, frozen=True):
    """Converter of stamps of the run's clock to times in messages (`offset` in ns), and back."""

    offset: int = 0

    def out(self, stamp: int) -> Time:
        """Return the seconds and nanoseconds of a stamp."""
        return divmod(stamp + self.offset, SECOND)

    def stamp(self, seconds: int, nanoseconds: int) -> int:
        """Return a message's time on the run's clock (ns), inside or outside the run."""
        return int(seconds) * SECOND + int(nanoseconds) - self.offset

    def back(self, seconds: int, nanoseconds: int, now: int) -> int:
        """Return a message's time (both 0: now) on the run's clock, ns, or raise `ValueError`."""
        if seconds == 0 and nanoseconds == 0:
            return now
        stamp = self.stamp(seconds, nanoseconds)
        if not 0 <= stamp <= now + AHEAD:
            raise ValueError(
                f"stamp: expected a time of this run, from 0 s to {now / SECOND:.3f} s, "
                f"found {stamp / SECOND:.3f} s"
            )
        return stamp


class MessageBuilder:
    """Builder of messages; `time` returns a stamp's time in messages."""

    def __init__(self, store: TypeStore, names: FrameNames, time: Callable[[int], Time]) -> None:
        self._store, self._names, self._time = store, names, time

    def make(self, type_: str, **fields: Any) -> Any:
        """Return a message, zero but for given fields; a `ValueError` or `TypeError` if unknown."""
        message = self._store.zero(type_)
        for name, value in fields.items():
            if not hasattr(message, name):
                raise TypeError(f"{type_} has no field {name!r}")
            setattr(message, name, value)
        return message

    def stamp(self, stamp: int) -> Any:
        """Return the ``builtin_interfaces/msg/Time`` of a stamp (ns)."""
        sec, nanosec = self._time(stamp)
        return self._store.message("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)

    def header(self, stamp: int, frame_id: str, source: str = "") -> Any:
        """Return a ``std_msgs/msg/Header`` of a stamp (ns), and a frame of a source's vehicle."""
        return self._store.header(self._time(stamp), self._names.name(frame_id, source))
