"""Message types, their hashes, and CDR: the only module that imports rosbags.

Messages are objects of the classes that rosbags makes from the types' definitions; their fields
have the names in ROS's files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from nodes.ros2_bridge.keys import NO_HASH, dds_type
from runtime.errors import MissingDependencyError, suggest

Distribution = Literal["humble", "iron", "jazzy", "kilted"]


class MessageError(ValueError):
    """Bytes are not the message that they should be; the message says what is wrong."""


class TypeStore:
    """The message types of one distribution of ROS 2.

    Args:
        distribution: Whose definitions hold; a few differ (``sensor_msgs/msg/Range``).
        definitions: Further types, with the ``.msg`` file of each.

    Raises:
        MissingDependencyError: rosbags is not installed.
        ValueError: A definition cannot be read.
    """

    def __init__(
        self, distribution: Distribution = "jazzy", definitions: Mapping[str, str] | None = None
    ) -> None:
        try:
            from rosbags.serde import SerdeError
            from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
        except ImportError as error:
            raise MissingDependencyError(
                "the ROS 2 bridge needs rosbags: pip install 'visnav-runtime[ros2]'"
            ) from error
        self._error = SerdeError
        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._hashed = distribution != "humble"
        for name, file in (definitions or {}).items():
            dds_type(name)
            try:
                self._store.register(get_types_from_msg(Path(file).read_text("utf-8"), name))
            except (OSError, UnicodeError, TypesysError) as error:
                raise ValueError(
                    f"definitions: {name}: expected a readable .msg file, found {file}: {error}"
                ) from error

    def check(self, type_: str) -> None:
        """Make sure that a type is known, and what it is made of.

        Raises:
            ValueError: It is not known.
        """
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
        """Return a type's hash as it stands in keys (REP 2011: ``RIHS01_`` and 64 digits).

        Raises:
            ValueError: The type is not known.
        """
        self.check(type_)
        return self._store.hash_rihs01(type_) if self._hashed else NO_HASH

    def message(self, type_: str) -> Any:
        """Return the class of a type's messages."""
        return self._store.types[type_]

    def serialize(self, message: Any) -> bytearray:
        """Return a message as CDR, with its header of four bytes."""
        written = self._store.serialize_cdr(message, message.__msgtype__, little_endian=True)
        buffer = written.obj
        return buffer if isinstance(buffer, bytearray) else bytearray(written)

    def deserialize(self, data: bytes, type_: str) -> Any:
        """Read a message. Its arrays are views of `data`.

        Raises:
            MessageError: The bytes are no message of that type.
        """
        try:
            return self._store.deserialize_cdr(data, type_)
        # rosbags means to raise its own error only; what comes from outside had better not test it.
        except (self._error, ValueError, ArithmeticError, LookupError, MemoryError) as error:
            raise MessageError(str(error)) from None
