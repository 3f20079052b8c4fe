"""Sealed Zenoh session between the processes of a run: the only module using zenoh.

Zenoh has threads of its own and no asyncio: callbacks run there, and must not wait.

Seals keep messages from being forged, repeated or lost unnoticed::

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
import ipaddress
import json
import logging
import os
import re
import secrets
import socket
import stat
import struct
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

from runtime.config.model import NetworkConfig
from runtime.errors import CommandError, PeerError, WireError
from runtime.user_folder import user_folder

log = logging.getLogger("visnav.runtime")

OnMessage = Callable[[str, bytes, bytes], None]
"""Called in Zenoh's thread with the sender's id, the message, and its payload."""

OnPresence = Callable[[str, bool], None]
"""Called in Zenoh's thread when a process appears (True) or disappears."""

CLOSING = 3.0  # real seconds for a session to close; a hung peer keeps Zenoh waiting for longer

_ENDPOINT = re.compile(r"(\w+)/\[?([^\]#?]+?)\]?:(\d+)([#?].*)?")


class Session:
    """A place among the processes of a run.

    Args:
        secret: That they share. Without a Zenoh file, no other process can connect.

    Raises:
        PeerError: The session cannot be opened.
    """

    def __init__(self, run: str, network: NetworkConfig, secret: bytes) -> None:
        configuration = _configuration(network)
        _warn_if_open(configuration)
        try:
            with tempfile.NamedTemporaryFile("w", suffix=".door") as file:  # its user's alone
                if not network.zenoh:
                    password = derive(secret, "door").hex()
                    file.write(f"visnav:{password}\n")
                    file.flush()
                    credentials = {
                        "user": "visnav",
                        "password": password,
                        "dictionary_file": file.name,
                    }
                    configuration.insert_json5("transport/auth/usrpwd", json.dumps(credentials))
                self._session = zenoh.open(configuration)
        except (zenoh.ZError, OSError) as error:
            raise PeerError(f"expected to meet at {network.meet}, found: {error}") from error
        self.id = str(self._session.info.zid())
        self._meet = network.meet if network.meet in _endpoints(configuration, "listen") else ""
        self._prefix = f"visnav/{re.sub(r'[^A-Za-z0-9_.-]', '_', run)}"
        self._publishers: dict[str, Any] = {}
        self._declarations: list[Any] = []

    def appear(self, on_message: OnMessage, on_presence: OnPresence) -> None:
        """Become visible to the others, and watch them.

        Args:
            on_presence: Called for processes that come and go, this one not included.
        """

        def receive(sample: zenoh.Sample) -> None:
            head = sample.attachment
            if head is not None:
                sender = str(sample.key_expr).rpartition("/")[2]
                on_message(sender, head.to_bytes(), sample.payload.to_bytes())

        def report(sample: zenoh.Sample) -> None:
            other = str(sample.key_expr).rpartition("/")[2]
            if other != self.id:
                on_presence(other, sample.kind == zenoh.SampleKind.PUT)

        self._declarations = [
            self._session.declare_subscriber(
                f"{self._prefix}/to/{self.id}/*", zenoh.handlers.Callback(receive, indirect=False)
            ),
            self._session.liveliness().declare_token(f"{self._prefix}/here/{self.id}"),
            self._session.liveliness().declare_subscriber(
                f"{self._prefix}/here/*",
                zenoh.handlers.Callback(report, indirect=False),
                history=True,
            ),
        ]

    def send(self, other: str, message: bytes, payload: bytes) -> None:
        """Send a message to a process; waits if the network does."""
        if other not in self._publishers:
            self._publishers[other] = self._session.declare_publisher(
                f"{self._prefix}/to/{other}/{self.id}",
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                express=True,
            )
        try:
            self._publishers[other].put(payload, attachment=message)
        except zenoh.ZError as error:
            raise PeerError(f"a message could not be sent: {error}") from error

    def deserted(self) -> bool:
        """Return whether no process listens at the meeting point, as far as is known.

        Zenoh tries to listen only as it opens: later, its tries would keep it from closing
        (github.com/eclipse-zenoh/zenoh/pull/2754).
        """
        parts = _ENDPOINT.fullmatch(self._meet)
        if parts is None or parts[1] not in {"tcp", "tls"}:
            return False
        try:
            socket.create_connection((parts[2], int(parts[3])), timeout=1.0).close()
        except ConnectionRefusedError:
            return True
        except OSError:
            return False
        return False

    def close(self) -> None:
        """Close the session; after `CLOSING` seconds, closing continues in a thread."""
        thread = threading.Thread(target=self._session.close, name="zenoh close")
        thread.start()
        thread.join(CLOSING)


def _configuration(network: NetworkConfig) -> zenoh.Config:
    plain, configuration = zenoh.Config(), zenoh.Config()
    if network.zenoh:
        if not Path(network.zenoh).is_file():
            raise PeerError(f"network.zenoh: expected a file, found none at {network.zenoh}")
        try:
            configuration = zenoh.Config.from_file(network.zenoh)
        except zenoh.ZError as error:
            raise PeerError(
                f"network.zenoh: {network.zenoh}: expected a Zenoh configuration, found: {error}"
            ) from error
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        # Of two that discover each other only one connects: with passwords, both may fail else.
        "scouting/gossip/autoconnect_strategy": {
            "peer": {"to_router": "always", "to_peer": "greater-zid"}
        },
        # The first process on that host takes the address, and the others connect to it. Each
        # sends the others its further addresses.
        "listen/endpoints": [network.meet, *_beside(network.meet)],
        "listen/exit_on_failure": False,
        "listen/timeout_ms": 0,
        "connect/endpoints": [network.meet],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 2},
        "transport/shared_memory/enabled": False,  # we have our own, and nothing is left behind
    }
    for key, value in settings.items():
        if configuration.get_json(key) == plain.get_json(key):
            configuration.insert_json5(key, json.dumps(value))
    lease = round(float(network.lease) * 1000)
    configuration.insert_json5("transport/link/tx/lease", json.dumps(lease))
    return configuration


def certified(network: NetworkConfig) -> bool:
    """Return whether a Zenoh file lets only processes with a certificate connect."""
    configuration = _configuration(network)
    ends = [*_endpoints(configuration, "listen"), *_endpoints(configuration, "connect")]
    mutual = json.loads(configuration.get_json("transport/link/tls/enable_mtls"))
    return bool(network.zenoh and mutual and all(e.startswith(("tls/", "quic/")) for e in ends))


def _endpoints(configuration: zenoh.Config, key: str) -> list[str]:
    ends = json.loads(configuration.get_json(f"{key}/endpoints"))
    return ends if isinstance(ends, list) else [e for group in ends.values() for e in group]


def _warn_if_open(configuration: zenoh.Config) -> None:
    bare = [
        endpoint
        for endpoint in _endpoints(configuration, "listen")
        if not (endpoint.startswith(("tls/", "quic/", "unix")) or _is_here(endpoint))
    ]
    if bare:
        log.warning(
            "%s can be reached from other machines, and what is said there is not encrypted: "
            "for TLS, name a Zenoh file (network.zenoh)",
            ", ".join(bare),
        )


def _beside(meet: str) -> list[str]:
    """Return another endpoint for listening: a free port at our address towards `meet`."""
    parts = _ENDPOINT.fullmatch(meet)
    if parts is None or parts[1] not in {"tcp", "tls", "quic"}:
        return []
    protocol, host, port = parts[1], parts[2], int(parts[3])
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(address)  # of datagrams: nothing is sent
            own_address = probe.getsockname()[0]
    except OSError:  # no way there yet: Zenoh tries on
        return []
    return [
        f"{protocol}/[{own_address}]:0" if ":" in own_address else f"{protocol}/{own_address}:0"
    ]


def _is_here(endpoint: str) -> bool:
    parts = _ENDPOINT.fullmatch(endpoint)
    host = parts[2] if parts else ""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


VERSION = 3  # of `visnav_machines.messages`; processes of different ones do not meet

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
    for value in about:
        part = value.encode() if isinstance(value, str) else value
        mac.update(len(part).to_bytes(4, "little") + part)
    return mac.digest()


class Seal:
    """Seals messages, and opens messages sealed with the same key."""

    def __init__(self, key: bytes) -> None:
        self._keyed = hashlib.blake2b(key=key, digest_size=_TAG)

    def seal_message(self, number: int, message: bytes, payload: bytes = b"") -> bytes:
        """Return the message with its seal."""
        head = _HEAD.pack(VERSION, number, len(message))
        return head + self._tag(head, message, payload) + message

    def unseal(self, number: int, sealed: bytes, payload: bytes = b"") -> bytes:
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
        version, received, _ = _HEAD.unpack(head)
        if version != VERSION:
            raise PeerError(
                f"expected a process that speaks version {VERSION} of the messages, found "
                f"version {version}: install the same on both sides"
            )
        if received < number:
            raise ForgedError(f"expected message {number}, found message {received} again")
        if received > number:
            raise WireError(f"expected message {number}, found {received}: some are lost")
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

    def __init__(
        self, key: bytes, own_end: tuple[str, bytes], other_end: tuple[str, bytes]
    ) -> None:
        self.nonce, self.seen = own_end[1], other_end[1]
        both = [part for pair in sorted((own_end, other_end)) for part in pair]
        self.tag = derive(key, "tag", *both)[:NONCE]
        self._out = Seal(derive(key, "session", own_end[0], *both))
        self._in = Seal(derive(key, "session", other_end[0], *both))
        self._sent = self._opened = 0

    def seal(self, message: bytes, payload: bytes) -> bytes:
        """Seal the next message to the other process; for a single thread at a time."""
        self._sent += 1
        return self._out.seal_message(self._sent, message, payload)

    def open(self, sealed: bytes, payload: bytes) -> bytes:
        """Open the next message of the other process; raises like `Seal.unseal`."""
        message = self._in.unseal(self._opened + 1, sealed, payload)
        self._opened += 1
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
        secret = os.environ.get(name, "")
    elif kind == "file":
        secret = _read(Path(name).expanduser())
    else:
        secret = setting or _user_secret()
    if len(secret) < SHORTEST:
        place = setting if kind in {"env", "file"} else "the file"
        raise PeerError(
            f"network.secret: expected at least {SHORTEST} characters in {place}, found "
            f"{len(secret)}"
        )
    return secret.encode()


def _user_secret() -> str:
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
