"""An event as bytes, and back: how events cross between processes and into recordings.

    u32 LE   length of the head
    head     msgpack: [kind, [[dtype, shape, offset], …], fields]
    arrays   raw, C order, each at its offset from the start, a multiple of 16

`kind` is ``module:Class`` of the event; in `fields`, an array is the number of its entry in the
list before. Only types that this process knows are made, so bytes from elsewhere create no code.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from typing_extensions import Buffer

from events import Event
from runtime.errors import WireError

Array = npt.NDArray[Any]
ALIGNED = 16
_LENGTH = struct.Struct("<I")


class Packed(msgspec.Struct, frozen=True):
    """An event taken apart: a head, and the event's own arrays, C-contiguous, not copied.

    `offsets` and `size` are bytes in the frame.
    """

    head: bytes
    arrays: tuple[Array, ...]
    offsets: tuple[int, ...]
    size: int

    def write(self, into: memoryview) -> None:
        """Write the frame into `size` bytes; the interpreter runs on while arrays are copied."""
        begin = _LENGTH.size + len(self.head)
        into[:begin] = _LENGTH.pack(len(self.head)) + self.head
        whole = np.frombuffer(into, np.uint8)
        for array, offset in zip(self.arrays, self.offsets, strict=True):
            whole[offset : offset + array.nbytes] = array.reshape(-1).view(np.uint8)

    def parts(self) -> list[bytes | memoryview]:
        """Return the frame in parts, none of them empty; no array is copied."""
        parts: list[bytes | memoryview] = [_LENGTH.pack(len(self.head)) + self.head]
        place = _LENGTH.size + len(self.head)
        for array, offset in zip(self.arrays, self.offsets, strict=True):
            parts += [bytes(offset - place), array.reshape(-1).view(np.uint8).data]
            place = offset + array.nbytes
        parts.append(bytes(self.size - place))
        return [part for part in parts if len(part)]

    def frame(self) -> bytes:
        """Return the frame, with the only copy of the arrays."""
        return b"".join(self.parts())


def kind_of(event: type[Event]) -> str:
    """Return ``module:Class``, the name of a type of event in other processes."""
    return f"{event.__module__}:{event.__qualname__}"


def event_type(kind: str) -> type[Event]:
    """Return the type of event of a kind imported in this process, or raise `WireError`."""
    known = _types.get(kind)
    if known is None:
        _types.update((kind_of(each), each) for each in _subclasses(Event))
        known = _types.get(kind)
    if known is None:
        raise WireError(f"expected a type of event that this process knows, found {kind!r}")
    return known


def pack(event: Event) -> Packed:
    """Take an event apart, contiguous arrays uncopied; `WireError` if it holds what is no data."""
    arrays: list[Array] = []

    def encode(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if value.dtype.hasobject or value.dtype.names:
                raise NotImplementedError(f"an array of {value.dtype}")
            arrays.append(np.asarray(value, order="C"))
            return len(arrays) - 1
        if isinstance(value, np.generic):
            return value.item()
        raise NotImplementedError(type(value).__name__)

    try:
        fields = msgspec.msgpack.Encoder(enc_hook=encode).encode(event)
    except (NotImplementedError, OverflowError, TypeError) as error:
        raise WireError(f"{type(event).__name__} cannot be sent elsewhere: {error}") from error
    kind = kind_of(type(event))
    if not arrays:
        head = _encode((kind, (), msgspec.Raw(fields)))
        return Packed(head, (), (), _LENGTH.size + len(head))
    # Offsets are counted from where the arrays begin, so that the head need not know its length.
    relative, place = [], 0
    for array in arrays:
        relative.append(place)
        place += -(-array.nbytes // ALIGNED) * ALIGNED
    shapes = [(a.dtype.str, a.shape, at) for a, at in zip(arrays, relative, strict=True)]
    head = _encode((kind, shapes, msgspec.Raw(fields)))
    begin = _arrays_begin(len(head))
    return Packed(head, tuple(arrays), tuple(begin + at for at in relative), begin + place)


def unpack(frame: Buffer) -> Event:
    """Put an event together, its arrays in `frame`, read-only; `WireError` if it is none known."""
    view = memoryview(frame).cast("B").toreadonly()
    try:
        (length,) = _LENGTH.unpack_from(view)
        if _LENGTH.size + length > len(view):
            raise WireError(f"expected a head of {length} bytes, found {len(view)} in all")
        kind, shapes, fields = _decode(view[_LENGTH.size : _LENGTH.size + length])
        begin = _arrays_begin(length)
        arrays = [_array(view, begin, *shape) for shape in shapes]
        cls = event_type(kind)
        decoder = _decoder(cls, arrays) if arrays else _plain_decoder(cls)
        event: Event = decoder.decode(fields)
        return event
    except (struct.error, msgspec.DecodeError, TypeError, ValueError, IndexError) as error:
        raise WireError(f"expected an event, found something else: {error}") from error


_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(
    tuple[str, list[tuple[str, tuple[int, ...], int]], msgspec.Raw]
).decode
_types: dict[str, type[Event]] = {}


def _arrays_begin(head: int) -> int:
    return -(-(_LENGTH.size + head) // ALIGNED) * ALIGNED


def _array(
    view: memoryview, begin: int, dtype_text: str, shape: tuple[int, ...], offset: int
) -> Array:
    dtype = np.dtype(dtype_text)
    if dtype.kind not in "biufc" or offset < 0 or any(n < 0 for n in shape):
        raise WireError(f"expected an array of numbers, found {dtype_text} {shape} at {offset}")
    count = 1
    for n in shape:  # of Python's integers, which do not overflow
        count *= n
    if begin + offset + count * dtype.itemsize > len(view):
        raise WireError(f"expected an array of shape {shape} within {len(view)} bytes")
    return np.frombuffer(view, dtype, count, begin + offset).reshape(shape)


@functools.cache
def _plain_decoder(cls: type[Event]) -> msgspec.msgpack.Decoder[Any]:
    return _decoder(cls, ())


def _decoder(cls: type[Event], arrays: Sequence[Array]) -> msgspec.msgpack.Decoder[Any]:
    def decode(_: Any, value: Any) -> Any:
        if isinstance(value, int) and 0 <= value < len(arrays):
            return arrays[value]
        raise WireError(f"expected one of {len(arrays)} arrays, found {value!r}")

    return msgspec.msgpack.Decoder(cls, dec_hook=decode)


def _subclasses(cls: type[Event]) -> list[type[Event]]:
    return [cls, *(found for each in cls.__subclasses__() for found in _subclasses(each))]
