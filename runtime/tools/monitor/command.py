"""Commands to a run, and all messages of the connection: one JSON object per line."""

from __future__ import annotations

from typing import Annotated

import msgspec

from runtime.tools.monitor.snapshot import Snapshot

SLOWEST, QUICKEST = 1e-3, 1e6
"""Limits of the speed, in simulated seconds per real second."""


class _Command(
    msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True
):
    """Base of the commands."""


class Pause(_Command, frozen=True, tag="pause"):
    """Pause simulated time."""


class Resume(_Command, frozen=True, tag="resume"):
    """Resume simulated time."""


class Step(_Command, frozen=True, tag="step"):
    """Run for some seconds and pause; without a number, up to what is due next."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


class Speed(_Command, frozen=True, tag="speed"):
    """Set how many simulated seconds pass per real second; without a number, as many as can."""

    factor: Annotated[float, msgspec.Meta(ge=SLOWEST, le=QUICKEST)] | None = None


class Restart(_Command, frozen=True, tag="restart"):
    """Shut a node down and start it again."""

    node: str


class Stop(_Command, frozen=True, tag="stop"):
    """End the run in order."""


class Set(_Command, frozen=True, tag="set"):
    """Change a setting of a node: ``node.key=value``, the value in TOML or a bare word."""

    text: str


Command = Pause | Resume | Step | Speed | Restart | Stop | Set


class CommandRequest(msgspec.Struct, frozen=True, kw_only=True, tag="ask"):
    """A command to a run; its answer has the same `number`."""

    number: int
    command: Command


class ImageRequest(msgspec.Struct, frozen=True, kw_only=True, tag="image"):
    """Asks for the newest image of one of a snapshot's cameras; answered while somebody watches."""

    number: int
    camera: str


class WatchRequest(msgspec.Struct, frozen=True, tag="watch"):
    """Asks for snapshots for as long as the connection lasts."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, tag="answer"):
    """The answer to a command, or why there is no image.

    Attributes:
        number: Of the request.
        done: Whether it was carried out.
        text: What was done, or why not.
    """

    number: int
    done: bool
    text: str


class EncodedImage(msgspec.Struct, frozen=True, kw_only=True, tag="jpeg"):
    """The image that was asked for.

    Attributes:
        number: Of the request.
        jpeg: The image, made small.
    """

    number: int
    jpeg: bytes


FromClient = CommandRequest | ImageRequest | WatchRequest
FromRun = Snapshot | Answer | EncodedImage

encode = msgspec.json.Encoder().encode
decode_from_client = msgspec.json.Decoder(FromClient).decode
decode_from_run = msgspec.json.Decoder(FromRun).decode
decode_command = msgspec.json.Decoder(Command).decode

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding raises: invalid JSON, invalid UTF-8, another type, or too deep nesting."""

LONGEST_COMMAND = 256 << 10
"""Bytes of a line to a run at most."""

LONGEST_LINE = 16 << 20
"""Bytes of a line from a run at most; a snapshot of a hundred nodes has some tens of thousands."""
