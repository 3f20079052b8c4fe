"""What there is to say to a run, and what crosses the connection: one JSON object a line."""

from __future__ import annotations

from typing import Annotated

import msgspec

from runtime.tools.monitor.snapshot import Snapshot

SLOWEST, QUICKEST = 1e-3, 1e6
"""Speeds that can be asked for."""


class _Asked(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", forbid_unknown_fields=True):
    """Base of the commands."""


class Pause(_Asked, frozen=True, tag="pause"):
    """Let simulated time stand."""


class Resume(_Asked, frozen=True, tag="resume"):
    """Let it run again."""


class Step(_Asked, frozen=True, tag="step"):
    """Let it run for some seconds, and then stand; without a number, to the next thing due."""

    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


class Speed(_Asked, frozen=True, tag="speed"):
    """Let it run at so many simulated seconds per real second; without a number, its fastest."""

    factor: Annotated[float, msgspec.Meta(ge=SLOWEST, le=QUICKEST)] | None = None


class Restart(_Asked, frozen=True, tag="restart"):
    """Shut a node down and start it anew."""

    node: str


class Stop(_Asked, frozen=True, tag="stop"):
    """End the run in order."""


class Set(_Asked, frozen=True, tag="set"):
    """Change a setting of a node: ``node.key=value``, the value in TOML or a bare word."""

    text: str


Command = Pause | Resume | Step | Speed | Restart | Stop | Set


class Asked(msgspec.Struct, frozen=True, kw_only=True, tag="ask"):
    """A command on its way to a run; `number` comes back with the answer."""

    number: int
    command: Command


class ImageRequest(msgspec.Struct, frozen=True, kw_only=True, tag="image"):
    """Asks for the newest image of one of a snapshot's cameras; answered while somebody watches."""

    number: int
    camera: str


class Watch(msgspec.Struct, frozen=True, tag="watch"):
    """Asks for snapshots, as long as the connection lasts."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, tag="answer"):
    """What came of a command.

    Attributes:
        number: Of the command.
        done: Whether it was done.
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


FromClient = Asked | ImageRequest | Watch
FromRun = Snapshot | Answer | EncodedImage

encode = msgspec.json.Encoder().encode
decode_from_client = msgspec.json.Decoder(FromClient).decode
decode_from_run = msgspec.json.Decoder(FromRun).decode
decode_command = msgspec.json.Decoder(Command).decode

UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding raises: no JSON, no text, something else, or nested too deeply."""

LONGEST_COMMAND = 256 << 10
"""Bytes of a line to a run at most."""

LONGEST_LINE = 16 << 20
"""Bytes of a line from a run at most; a snapshot of a hundred nodes has some tens of thousands."""
