"""Handshake: from two visible processes to a session, and a check of their compatibility.

Each greets the other with a nonce; a process that answers ours with the seal of the run is present
and knows the secret: then a session begins, and only what it seals is received. A greeting that
answers nothing may be an old one, and changes nothing. A new session ends the one before: the other
process had lost us. Processes fit if they make up the run: all nodes once, and equal files.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import msgspec

from runtime.config.explain import show
from runtime.config.model import Config, to_builtins
from runtime.errors import PeerError, VisnavError, WireError
from runtime.paths import file_names
from visnav_machines.member import Member, Outbox
from visnav_machines.messages import Hello, decode, encode
from visnav_machines.session import NONCE, ForgedError, OnMessage, Sealing, Session, hello_seal

log = logging.getLogger("visnav.runtime")

GREET_EVERY = 0.2  # seconds between two greetings of a process without an answer yet
STRANGERS = 256  # most processes greeted without a session; further processes are not seen


@dataclass(eq=False)
class Contact:
    """A visible process, known or not.

    Attributes:
        nonce: In our greetings, until one is answered.
        doubt: Nonce of a greeting of another session than ours, until it is replied to.
    """

    nonce: bytes = field(default_factory=lambda: secrets.token_bytes(NONCE))
    member: Member | None = None
    doubt: bytes = b""


class Group(Protocol):
    """Processes of a run as the handshakes know them; called on its loop, by `soon`."""

    hello: Hello

    def soon(self, call: Callable[..., Any], *args: Any) -> None:
        """Call a function on the run's loop; may be called in any thread."""

    def joined(self, member: Member) -> None:
        """Handle the start of a session."""

    def left(self, member: Member, reason: str = ...) -> None:
        """Handle the end of a session."""

    def unsent(self, name: str, error: VisnavError) -> None:
        """Handle a failure to send."""


class Handshakes:
    """All visible processes, and our sessions with them.

    Zenoh's callbacks hold its locks: requests to Zenoh are left to the loop.

    Attributes:
        refused: Number of messages left out, since no process of the run wrote them.
    """

    def __init__(self, key: bytes, session: Session, membership: Group) -> None:
        self.refused = 0
        self._key = key
        self._session = session
        self._membership = membership
        self._lock = threading.Lock()
        self._contacts: dict[str, Contact] = {}
        self._complained: set[str] = set()
        self._enough = threading.Event()

    def begin(self, on_message: OnMessage) -> None:
        """Become visible, and greet silent processes repeatedly."""
        self._session.appear(on_message, self.on_presence)
        threading.Thread(target=self._greet, name="greet", daemon=True).start()

    async def alone(self) -> bool:
        """Return whether no process is seen, and none listens where they meet."""
        return not self._contacts and await asyncio.to_thread(self._session.deserted)

    async def close(self) -> None:
        """Send the waiting messages, and leave."""
        self._enough.set()
        for member in self.members():
            await asyncio.to_thread(member.outbox.close)
        await asyncio.to_thread(self._session.close)

    def member(self, sender: str) -> Member | None:
        """Return the process of this id, if there is a session; otherwise `None`."""
        contact = self._contacts.get(sender)
        return None if contact is None else contact.member

    def members(self) -> list[Member]:
        """Return all processes with a session."""
        with self._lock:
            return [c.member for c in self._contacts.values() if c.member is not None]

    def on_presence(self, other: str, present: bool) -> None:
        """Handle the appearance or disappearance of a process."""
        with self._lock:
            contact = self._contact(other) if present else self._contacts.pop(other, None)
            if not present:
                self._complained.add(other)  # its last messages may arrive late
        if contact is None:
            return
        if present:
            self._membership.soon(self._greet_one, other, contact.nonce)
        elif contact.member is not None:
            self._membership.soon(self._membership.left, contact.member)

    def receive(self, sender: str, sealed: bytes) -> None:
        """Handle a greeting; begin a session if the greeting is fresh.

        Raises:
            ForgedError: The greeting is none of the run's.
            PeerError: The greeting is of another version.
        """
        seal = hello_seal(self._key, sender, self._session.id)
        try:
            hello = decode(seal.unseal(0, sealed))
        except ForgedError:
            raise
        except WireError as error:
            raise PeerError(f"expected a process that speaks as we do: {error}") from None
        if not isinstance(hello, Hello):
            raise ForgedError("expected a hello of a process without a session")
        soon = self._membership.soon
        with self._lock:
            contact = self._contact(sender)
            if contact is None:
                return
            before = contact.member
            if hello.seen == contact.nonce and (
                before is None or hello.session != before.sealing.tag
            ):
                sealing = Sealing(
                    self._key, (self._session.id, contact.nonce), (sender, hello.nonce)
                )
                contact.member = member = self._member(sender, hello, sealing)
                contact.nonce, contact.doubt = secrets.token_bytes(NONCE), b""
                # Before anything that the loop seals for the session.
                soon(self._greet_one, sender, sealing.nonce, sealing.seen, sealing.tag)
                if before is not None:
                    soon(self._membership.left, before, "their process had lost us")
                soon(self._membership.joined, member)
            elif before is None:
                soon(self._greet_one, sender, contact.nonce, hello.nonce)
            elif hello.session == before.sealing.tag:  # all is well, or it is an old one
                contact.nonce = secrets.token_bytes(NONCE)  # answers on their way end no session
            elif hello.nonce == before.sealing.seen:  # ours did not get there
                current = before.sealing
                soon(self._greet_one, sender, current.nonce, current.seen, current.tag)
            else:
                contact.doubt = hello.nonce

    def _member(self, sender: str, hello: Hello, sealing: Sealing) -> Member:
        def write(message: bytes, payload: bytes) -> None:
            self._session.send(sender, sealing.seal(message, payload), payload)

        failed = partial(self._membership.soon, self._membership.unsent, ", ".join(hello.nodes))
        return Member(sender, hello, sealing, Outbox(sender, write, failed))

    def refuse(self, sender: str, error: VisnavError) -> None:
        """Log a process whose messages are refused: once each, for so many."""
        self.refused += 1
        if sender not in self._complained and len(self._complained) < STRANGERS:
            self._complained.add(sender)
            log.warning("from %s: %s (network.secret): left out", sender, error)

    def end(self, sender: str, error: WireError) -> None:
        """End a session after an error; another may follow."""
        with self._lock:
            contact = self._contacts.get(sender)
            member = None if contact is None else contact.member
            if contact is None or member is None:
                return
            contact.member = None
            self._complained.add(sender)  # its last messages may arrive late
        self._membership.soon(
            self._membership.left, member, f"their process is not understood: {error}"
        )

    def greet_again(self) -> None:
        """Greet processes without an answer, or possibly in another session than this."""
        due = []
        with self._lock:
            for other, contact in self._contacts.items():
                if contact.member is None:
                    due.append((other, contact.nonce, b"", b""))
                elif contact.doubt:
                    tag = contact.member.sealing.tag
                    due.append((other, contact.nonce, contact.doubt, tag))
                contact.doubt = b""
        for greeting in due:
            self._greet_one(*greeting)

    def _greet(self) -> None:
        while not self._enough.wait(GREET_EVERY):
            self.greet_again()

    def _greet_one(self, other: str, nonce: bytes, seen: bytes = b"", tag: bytes = b"") -> None:
        hello = msgspec.structs.replace(self._membership.hello, nonce=nonce, seen=seen, session=tag)
        seal = hello_seal(self._key, self._session.id, other)
        with contextlib.suppress(PeerError):  # the session is closed
            self._session.send(other, seal.seal_message(0, encode(hello)), b"")

    def _contact(self, other: str) -> Contact | None:
        if other not in self._contacts:
            if sum(c.member is None for c in self._contacts.values()) >= STRANGERS:
                return None
            self._contacts[other] = Contact()
        return self._contacts[other]


def shared_settings(config: Config) -> dict[str, Any]:
    """Return the settings common to all processes: no network, log, stall, or file folders."""
    table: dict[str, Any] = to_builtins(config)
    types = [spec.node.config_type for spec in config.nodes]
    table["nodes"] = [file_names(*pair) for pair in zip(table["nodes"], types, strict=True)]
    return {
        **{key: value for key, value in table.items() if key != "network"},
        "run": {key: value for key, value in table["run"].items() if key not in {"log", "stall"}},
    }


def check_fits(local: Hello, remote: Hello, nodes: Sequence[str]) -> None:
    """Raise `PeerError` if a process has another file or nodes of ours, or excludes us."""
    if place := _difference(local.config, remote.config):
        setting, local_value, remote_value = place
        raise PeerError(
            f"expected the process at {remote.place} to run the same file, found {setting} = "
            f"{remote_value} there, {local_value} here"
        )
    if not remote.nodes or not set(remote.nodes) <= set(nodes):
        raise PeerError(
            f"expected the process at {remote.place} to run some of {', '.join(nodes)}, found "
            f"{', '.join(remote.nodes) or 'none'}"
        )
    if twice := set(local.nodes) & set(remote.nodes):
        raise PeerError(
            f"expected each node to run in one process, found {_in_order(twice, nodes)} at "
            f"{remote.place}, too"
        )
    if excluded := set(local.nodes) & set(remote.left_out):
        raise PeerError(
            f"expected a run that waits for us, found that it goes on without "
            f"{_in_order(excluded, nodes)}"
        )


def _in_order(members: set[str], nodes: Sequence[str]) -> str:
    return ", ".join(node for node in nodes if node in members)


def _difference(local: Any, remote: Any, path: str = "") -> tuple[str, str, str] | None:
    """Return the first place where two tables differ, and both values there."""
    if isinstance(local, Mapping) and isinstance(remote, Mapping):
        for key in dict.fromkeys([*local, *remote]):
            if key not in local or key not in remote:
                inside = f"{path}.{key}".strip(".")
                return inside, *(show(t[key]) if key in t else "nothing" for t in (local, remote))  # type: ignore[return-value]
            if difference := _difference(local[key], remote[key], f"{path}.{key}".strip(".")):
                return difference
        return None
    if isinstance(local, list | tuple) and isinstance(remote, list | tuple):
        if len(local) != len(remote):
            return path, f"{len(local)} entries", f"{len(remote)} entries"
        for index, pair in enumerate(zip(local, remote, strict=True)):
            if difference := _difference(*pair, f"{path}[{index}]"):
                return difference
        return None
    return None if local == remote else (path, show(local), show(remote))
