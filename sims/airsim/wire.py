"""msgpack-rpc as AirSim speaks it: bytes to messages and back, with limits. No sockets.

A connection carries msgpack objects one after another, without frames: a request is
``[0, id, "method", [arguments]]``, its reply ``[1, id, error, result]``. Source: the specification
of msgpack-rpc (https://github.com/msgpack-rpc/msgpack-rpc) and rpclib, which AirSim uses.
"""

from __future__ import annotations

import reprlib
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack
import msgspec
import numpy as np
import numpy.typing as npt

REQUEST, REPLY, NOTIFICATION = 0, 1, 2

LONGEST = 4 << 20
"""Bytes of a message that a server takes."""

MOST_LISTS = 50_000
"""Lists and maps in a message that a server takes: 4 MB of empty ones would take seconds."""

LONGEST_REPLY = 1 << 30
"""Bytes of a message that a client takes: float images of several cameras are long."""


class WireFormatError(Exception):
    """Bytes that are no message; what follows them cannot be understood any more."""


class Request(NamedTuple):
    """A call of a method; of a notification, whose answer nobody wants, `id` is `None`."""

    id: int | None
    method: str
    arguments: list[Any]


class Reply(NamedTuple):
    """What a call led to: an error's text, or else a result."""

    id: int
    error: Any
    result: Any


class Decoder:
    """Makes messages of the bytes of one connection, however they are split.

    A message is decoded once it is complete: until then it takes no more memory than its bytes,
    whatever lengths it claims.

    Args:
        longest: Bytes of a message beyond which it is refused.
    """

    def __init__(self, longest: int = LONGEST) -> None:
        self._longest = longest
        self._splitter = msgpack.Unpacker(max_buffer_size=2**31 - 1)
        self._bytes = bytearray()
        self._begin = 0
        """Where in the stream `_bytes` begins."""

    def feed(self, data: bytes) -> Iterator[Request | Reply]:
        """Yield the messages that are complete with these bytes, in order.

        Raises:
            WireFormatError: They are no messages, or one is longer than allowed.
        """
        self._bytes += data
        try:
            self._splitter.feed(data)
            while self._next_is_complete():
                end: int = self._splitter.tell()
                length, self._begin = end - self._begin, end
                message = bytes(self._bytes[:length])
                del self._bytes[:length]
                yield decode(message)
        except msgpack.UnpackException as error:
            raise WireFormatError(f"expected msgpack, found {type(error).__name__}") from None

    def _next_is_complete(self) -> bool:
        try:
            self._splitter.skip()
        except msgpack.OutOfData:
            if len(self._bytes) > self._longest:
                raise WireFormatError(
                    f"expected messages of at most {self._longest} bytes, found a longer one"
                ) from None
            return False
        return True


def decode(message: bytes) -> Request | Reply:
    """Return the message that these bytes are; text that is not UTF-8 is made so.

    Raises:
        WireFormatError: They are none.
    """
    left = MOST_LISTS

    def count(each: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise WireFormatError(f"expected at most {MOST_LISTS} lists and maps, found more")
        return each

    try:
        found = msgpack.unpackb(
            message,
            raw=False,
            unicode_errors="replace",
            strict_map_key=False,
            timestamp=0,
            list_hook=count,
            object_hook=count,
        )
    except WireFormatError:
        raise
    except Exception as error:  # of many kinds, by the bytes
        raise WireFormatError(f"expected msgpack, found {type(error).__name__}: {error}") from None
    match found:
        case [0, int(id_), str(method), list(arguments)]:
            return Request(id_, method, arguments)
        case [1, int(id_), error, result]:
            return Reply(id_, error, result)
        case [2, str(method), list(arguments)]:
            return Request(None, method, arguments)
    raise WireFormatError(f"expected a request or a reply, found {reprlib.repr(found)}")


_encode = msgspec.msgpack.Encoder().encode


def request(id_: int, method: str, arguments: tuple[Any, ...] | list[Any]) -> bytes:
    """Return the bytes of a call."""
    return _encode((REQUEST, id_, method, arguments))


def reply(id_: int, error: str | None, result: Any) -> bytes:
    """Return the bytes of an answer; structs become maps, and bytes ``bin``.

    Raises:
        TypeError: The result has something that msgpack cannot hold.
    """
    return _encode((REPLY, id_, error, result))


def float_array(numbers: npt.NDArray[Any]) -> msgspec.Raw:
    """Return an array of float32, as rpclib packs a ``std::vector<float>``, ready for `reply`.

    Args:
        numbers: Any shape; taken in C order.
    """
    flat = np.ascontiguousarray(numbers, np.float32).ravel()
    packed = np.empty(len(flat), [("kind", "u1"), ("value", ">f4")])
    packed["kind"], packed["value"] = 0xCA, flat
    return msgspec.Raw(struct.pack(">BI", 0xDD, len(flat)) + packed.tobytes())
