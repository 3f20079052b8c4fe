"""Whoever can reach the meeting place, but does not know the secret, changes nothing.

Without a Zenoh file it cannot even connect. Where such a file lets it in, it hears all that is
said, and says again what it heard, and whatever else might stop a run, in the name of others.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from extensions.machines.tests.samples import Process, settings
from extensions.machines.tests.test_runs import THREE
from runtime.config.model import Config
from runtime.run.execute import execute
from tests.runtime.ports import free_port
from visnav_machines.messages import (
    NEVER,
    Ack,
    EventMessage,
    FinalSummary,
    FirstUpdate,
    Hello,
    MemoryMapped,
    MemoryOffer,
    Message,
    NodeEnded,
    Ping,
    Pong,
    Ready,
    StateReport,
    Stop,
    Subscription,
    Subscriptions,
    SummaryReceived,
    TimeToken,
    TokenRequest,
    encode,
)
from visnav_machines.session import Seal

MESSAGES: list[Message] = [
    TimeToken(1 << 40, 1 << 60, (1, 1), (NEVER, NEVER), (), ((0, 0), (0, 0))),
    TimeToken(1, 0, (0, 0), (), (9,), ()),
    StateReport(("x",), 1 << 40, 1 << 60, (0, 0), NEVER, (0, 0)),
    TokenRequest(),
    Ack(1 << 60, (0, 4096, 1 << 50)),
    NodeEnded("asker"),
    NodeEnded("one"),
    FinalSummary(b"[" * 100_000),
    FinalSummary(b"{}"),
    Stop("spoofed", "spoofed"),
    Stop("spoofed", apart=True),
    EventMessage("asker.questions"),
    EventMessage("one.answers", 1, (0, 1 << 40)),
    Subscriptions((Subscription(("os:system",), None, latest=False),)),
    Hello(("asker",), {"a": [[[]]]}, "here", 0.0, b"1" * 16, b"2" * 16),
    MemoryOffer("x", "/proc/1/fd/1", b""),
    MemoryMapped(),
    Ready(),
    FirstUpdate(0, 1 << 60),
    SummaryReceived(),
    Ping(1 << 62),
    Pong(-1, 0, 0),
]


def plain(**keys: Any) -> zenoh.Config:
    configuration = zenoh.Config()
    everything = {"scouting/multicast/enabled": False, "listen/endpoints": []} | keys
    for key, value in everything.items():
        configuration.insert_json5(key.replace("__", "/"), json.dumps(value))
    return configuration


class Attacker(threading.Thread):
    """Says things in the name of all that show themselves, until it is stopped."""

    def __init__(self, meet: str) -> None:
        super().__init__(name="attacker", daemon=True)
        self.sent = 0
        self.heard: deque[tuple[str, bytes, bytes]] = deque(maxlen=2000)
        self.ids: set[str] = set()
        self._over = threading.Event()
        self.seen = threading.Event()
        ever = {"connect__timeout_ms": -1, "connect__exit_on_failure": False}
        self.session = zenoh.open(plain(connect__endpoints=[meet], **ever))
        self._kept: list[Any] = [
            self.session.declare_subscriber("visnav/**", self._hear),
            self.session.liveliness().declare_subscriber("visnav/**", self._see, history=True),
        ]
        self.start()

    def run(self) -> None:
        token, number = None, 0
        raw = [encode(sent) for sent in MESSAGES]
        forged = [Seal(b"x" * 32).seal_message(n, data) for data in raw for n in (0, 1, 50)]
        wrong = [b"", b"\xff" * 30, b"\1" + bytes(60), msgspec.msgpack.encode({"type": "Turn"})]
        while not self._over.wait(0.01):
            number += 1
            ids = sorted(self.ids)
            if token is None and ids:  # another one's sign of life, that goes
                key = f"visnav/apart/here/{ids[0]}"
                token = self.session.liveliness().declare_token(key)
            elif token is not None:
                token.undeclare()  # type: ignore[no-untyped-call]
                token = None
            for to in ids:
                for by in [*ids, f"{number:x}"]:
                    for message in [*raw, *forged, *wrong]:
                        self._say(f"visnav/apart/to/{to}/{by}", message, b"")
            for key, message, payload in list(self.heard)[-100:]:
                self._say(key, message, payload)

    def stop(self) -> None:
        self._over.set()
        self.join(10)
        self.session.close()  # type: ignore[no-untyped-call]

    def _say(self, key: str, message: bytes, payload: bytes) -> None:
        self.session.put(key, payload, attachment=message)
        self.sent += 1

    def _hear(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None and self.sent % 7 == 0:
            message = sample.attachment.to_bytes()
            self.heard.append((str(sample.key_expr), message, sample.payload.to_bytes()))

    def _see(self, sample: zenoh.Sample) -> None:
        self.ids.add(str(sample.key_expr).rpartition("/")[2])
        self.seen.set()


@pytest.mark.slow
def test_without_the_secret_nobody_connects() -> None:
    config = settings(*THREE, duration=0.5)
    first = Process(config, "asker").up()
    attacker = Attacker(config.network.meet)
    time.sleep(1.0)  # as long as Zenoh takes many times over
    assert not list(attacker.session.info.peers_zid())
    Process(config, "one,other").ended()
    assert first.ended().digest == execute(config).digest
    assert not list(attacker.session.info.peers_zid())
    attacker.stop()
    assert attacker.sent == 0


def open_to_all(config: Config, folder: Path) -> Config:
    """Return a configuration whose Zenoh file lets everybody connect."""
    file = folder / "zenoh.json5"
    meet = config.network.meet
    file.write_text(json.dumps({"mode": "peer", "connect": {"endpoints": [meet]}}))
    network = msgspec.structs.replace(config.network, zenoh=str(file))
    return msgspec.structs.replace(config, network=network)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_what_strangers_say_changes_nothing(
    clock: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    meet = f"tcp/127.0.0.1:{free_port()}"
    config = open_to_all(settings(*THREE, duration=1.0, clock=clock, meet=meet), tmp_path)
    first = Process(config, "asker").up()
    attacker = Attacker(meet)
    assert attacker.seen.wait(10)
    second = Process(config, "one,other")
    one, other = first.ended(), second.ended()
    attacker.stop()
    assert attacker.sent > 1000
    assert attacker.heard
    assert one.outputs == other.outputs
    assert one.reason == other.reason == "duration"
    if clock == "lockstep":
        assert one.digest == other.digest == execute(config).digest
    assert "another seal (network.secret): left out" in caplog.text
