"""The secret of a run, and seals on messages: none is forged, repeated or missing.

    u8       version of the messages
    u64 LE   number: 0 for a hello, then one more for each message of a session and direction
    u32 LE   length of the message
    16       tag: keyed BLAKE2b of what stands before it, of the message and of the payload
    message

A hello is sealed with the key of the run. It carries a nonce, and once it answers another hello,
that one's nonce; so an old hello proves nothing. From both nonces comes the key of a session.

A process that has the secret may take part, and no other. On one machine it is a random key in a
file that only its user can read, made when it is first needed. Processes on several machines, or of
several users, are given one by `network.secret`.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import stat
import struct
import tempfile
from pathlib import Path

from runtime.errors import CommandError, PeerError, WireError
from runtime.paths import user_folder

VERSION = 3  # of the messages of `runtime.peers.messages`; processes of different ones do not meet

NONCE = 16
_HEAD = struct.Struct("<BQI")
_TAG = 16
_LONG = 4096
"""Least bytes of a payload for SHA-256, with hardware support, to be quicker than BLAKE2."""


class ForgedError(WireError):
    """Wrong seal: a message of another process, or an old message."""


def derive(secret: bytes, *about: str | bytes) -> bytes:
    """Return a key (32 bytes) for a single purpose, derivable only with the secret."""
    mac = hashlib.blake2b(key=hashlib.sha256(secret).digest(), digest_size=32)
    for each in about:
        part = each.encode() if isinstance(each, str) else each
        mac.update(len(part).to_bytes(4, "little") + part)
    return mac.digest()


class Seal:
    """Puts seals on messages, and opens messages sealed with the same key."""

    def __init__(self, key: bytes) -> None:
        self._keyed = hashlib.blake2b(key=key, digest_size=_TAG)

    def put_on(self, number: int, message: bytes, payload: bytes = b"") -> bytes:
        """Return the message with its seal."""
        head = _HEAD.pack(VERSION, number, len(message))
        return head + self._tag(head, message, payload) + message

    def take_off(self, number: int, sealed: bytes, payload: bytes = b"") -> bytes:
        """Return the message without its seal.

        Raises:
            ForgedError: The seal is wrong.
            WireError: It is right, but the message has another number: some are missing.
            PeerError: It is right, but of another version.
        """
        head, message = sealed[: _HEAD.size], sealed[_HEAD.size + _TAG :]
        tag = self._tag(head, message, payload)
        if not hmac.compare_digest(tag, sealed[_HEAD.size : _HEAD.size + _TAG]):
            raise ForgedError("expected a message of this run, found another seal")
        version, found, _ = _HEAD.unpack(head)
        if version != VERSION:
            raise PeerError(
                f"expected a process that speaks version {VERSION} of the messages, found "
                f"version {version}: install the same on both sides"
            )
        if found < number:
            raise ForgedError(f"expected message {number}, found message {found} again")
        if found > number:
            raise WireError(f"expected message {number}, found {found}: some are lost")
        return message

    def _tag(self, head: bytes, message: bytes, payload: bytes) -> bytes:
        mac = self._keyed.copy()
        mac.update(head + message)
        mac.update(payload if len(payload) < _LONG else hashlib.sha256(payload).digest())
        return mac.digest()


class Sealing:
    """Seals of a session, in both directions.

    Attributes:
        tag: Names the session.
    """

    def __init__(self, key: bytes, mine: tuple[str, bytes], other: tuple[str, bytes]) -> None:
        self.nonce, self.seen = mine[1], other[1]
        both = [part for pair in sorted((mine, other)) for part in pair]
        self.tag = derive(key, "tag", *both)[:NONCE]
        self._out = Seal(derive(key, "session", mine[0], *both))
        self._in = Seal(derive(key, "session", other[0], *both))
        self._sent = self._taken = 0

    def seal(self, message: bytes, payload: bytes) -> bytes:
        """Seal the next message to the other process; for a single thread at a time."""
        self._sent += 1
        return self._out.put_on(self._sent, message, payload)

    def open(self, sealed: bytes, payload: bytes) -> bytes:
        """Open the next message of the other process; raises like `Seal.take_off`."""
        message = self._in.take_off(self._taken + 1, sealed, payload)
        self._taken += 1
        return message


def hello_seal(key: bytes, sender: str, receiver: str) -> Seal:
    """Return the seal of hellos from a process to another."""
    return Seal(derive(key, "hello", sender, receiver))


def is_hello(sealed: bytes) -> bool:
    """Return whether a message claims to be a hello."""
    return sealed[1:9] == bytes(8)


SHORTEST = 16  # characters of a secret at least


def secret_of(setting: str) -> bytes:
    """Return a run's secret by `network.secret`; `PeerError` without one, or if others read it."""
    kind, _, name = setting.partition(":")
    if kind == "env":
        found = os.environ.get(name, "")
    elif kind == "file":
        found = _read(Path(name).expanduser())
    else:
        found = setting or _of_this_user()
    if len(found) < SHORTEST:
        where = setting if kind in {"env", "file"} else "the file"
        raise PeerError(
            f"network.secret: expected at least {SHORTEST} characters in {where}, found "
            f"{len(found)}"
        )
    return found.encode()


def _of_this_user() -> str:
    try:
        path = user_folder() / "network.key"
        if not path.exists():
            _make(path)
        return _read(path)
    except (CommandError, OSError) as error:
        raise PeerError(
            f"network.secret: expected a private folder for the key of this machine, found: "
            f"{error}; name a secret"
        ) from None


def _make(path: Path) -> None:
    with tempfile.NamedTemporaryFile("w", dir=path.parent) as file:  # mode 0600
        file.write(secrets.token_hex(32))
        file.flush()
        with contextlib.suppress(FileExistsError):
            os.link(file.name, path)


def _read(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_IMODE(mode) & 0o077:
                raise PeerError(
                    f"network.secret: expected a file that only its user may read, found mode "
                    f"{stat.S_IMODE(mode):o}: {path}"
                )
            return file.read().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise PeerError(f"network.secret: expected a secret in {path}, found: {error}") from None
