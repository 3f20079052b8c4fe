"""Events as bytes, and back, for other processes and recordings; and the fingerprint of a run.

    u32 LE   length of the head
    head     msgpack: [kind, [[dtype, shape, offset], …], fields]
    arrays   raw, C order, each at its offset from the start, a multiple of 16

`kind` is ``module:Class`` of the event; in `fields`, an array is the number of its entry in the
list before. Only types that this process knows are made, so bytes from elsewhere create no code.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import xxhash

from events import Event
from runtime.channels.sender import Sender
from runtime.errors import ChannelTypeError, WireError

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
        _types.update((kind_of(event), event) for event in _subclasses(Event))
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


def unpack(frame: bytes | bytearray | memoryview) -> Event:
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
    return [cls, *(type_ for child in cls.__subclasses__() for type_ in _subclasses(child))]


_CHUNK = 1 << 16


class Digest:
    """Hashes every event: its type, stamp, source and content, arrays included.

    Each output (and what each node announces) has a fingerprint of its own, of its events in order,
    and that of the run is made of these. So it says nothing of the order of events of different
    outputs at one time, is the same for a run in one process and in several, and names the output
    at which two runs differ. What an event holds must be data: numbers, texts, lists, mappings and
    what else msgspec knows, and arrays of numbers. Of any other object it cannot be told whether it
    is the same again. XXH3 (xxhash.com) takes 0.1 ms for a megabyte image; it guards against
    accidents, not against forgery.
    """

    def __init__(self) -> None:
        self._encode_into = _ENCODER.encode_into
        self._outputs: dict[str, _Output] = {}

    def __call__(self, sender: Sender[Any] | None, event: Event) -> None:
        """Add an event, as a tap on every sender; `ChannelTypeError` if it is no data."""
        name = self.name_of(sender, event)
        try:
            output = self._outputs[name]
        except KeyError:
            output = self._outputs[name] = _Output()
        pending = output.pending
        pending += type(event).__name__.encode()
        try:
            self._encode_into(event, pending, -1)
        except (TypeError, OverflowError) as error:
            raise ChannelTypeError(
                f"{name}: expected {type(event).__name__} to hold data, which has a digest, "
                f"found {error}; or run without one, digest = false under [run]"
            ) from None
        if len(pending) > _CHUNK:  # one call of the hash for many small events
            output.hash_pending()

    @staticmethod
    def name_of(sender: Sender[Any] | None, event: Event) -> str:
        """Return the name of an event's output."""
        return sender.name if sender else event.source.partition("/")[0] + ".announced"

    def mark(self, name: str) -> int:
        """Return half of the fingerprint of an output's events so far, of 64 bits."""
        return int(self._outputs[name].hexdigest()[:16], 16)

    def outputs(self) -> dict[str, str]:
        """Return the fingerprint of each output's events so far, 32 hexadecimal digits each."""
        return {name: output.hexdigest() for name, output in sorted(self._outputs.items())}

    def hexdigest(self) -> str:
        """Return the fingerprint of all events so far, 32 hexadecimal digits."""
        return combined(self.outputs())


def fingerprint(data: Any) -> int:
    """Return a fingerprint of data, arrays included, of 64 bits."""
    digest: int = xxhash.xxh3_64_intdigest(_ENCODER.encode(data))
    return digest


def combined(outputs: Mapping[str, str]) -> str:
    """Return the fingerprint of a run, made of those of its outputs."""
    return xxhash.xxh3_128_hexdigest(msgspec.msgpack.encode(sorted(outputs.items())))


class _Output:
    __slots__ = ("hash", "pending")

    def __init__(self) -> None:
        self.hash = xxhash.xxh3_128()
        self.pending = bytearray()

    def hash_pending(self) -> None:
        self.hash.update(self.pending)
        self.pending.clear()

    def hexdigest(self) -> str:
        self.hash_pending()
        digest: str = self.hash.hexdigest()
        return digest


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = xxhash.xxh3_128_digest(np.ascontiguousarray(value).view(np.uint8).data)
        return (value.dtype.str, value.shape, content)
    if isinstance(value, np.generic) and not isinstance(scalar := value.item(), np.generic):
        return scalar
    shown = " ".join(f"{value!r:.80}".split())  # in one line
    raise TypeError(f"{shown} ({type(value).__name__})")


# "deterministic": equal sets and mappings are encoded equally
_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_array, order="deterministic")
