"""A fingerprint of all events of a run: equal digests mean equal events, to the byte."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
import xxhash

from events import Event
from runtime.channels.sender import Sender
from runtime.errors import ChannelTypeError

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
            output.take_in()

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
    found: int = xxhash.xxh3_64_intdigest(_ENCODER.encode(data))
    return found


def combined(outputs: Mapping[str, str]) -> str:
    """Return the fingerprint of a run, made of those of its outputs."""
    return xxhash.xxh3_128_hexdigest(msgspec.msgpack.encode(sorted(outputs.items())))


class _Output:
    __slots__ = ("hash", "pending")

    def __init__(self) -> None:
        self.hash = xxhash.xxh3_128()
        self.pending = bytearray()

    def take_in(self) -> None:
        self.hash.update(self.pending)
        self.pending.clear()

    def hexdigest(self) -> str:
        self.take_in()
        digest: str = self.hash.hexdigest()
        return digest


def _encode_array(value: Any) -> Any:
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        content = xxhash.xxh3_128_digest(np.ascontiguousarray(value).view(np.uint8).data)
        return (value.dtype.str, value.shape, content)
    if isinstance(value, np.generic) and not isinstance(found := value.item(), np.generic):
        return found
    shown = " ".join(f"{value!r:.80}".split())  # in one line
    raise TypeError(f"{shown} ({type(value).__name__})")


# "deterministic": equal sets and mappings are encoded equally
_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_array, order="deterministic")
