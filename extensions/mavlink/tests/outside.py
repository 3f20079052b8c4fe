"""A program at the other end of an endpoint's link, without a network's or a run's time."""

from __future__ import annotations

import math
import socket
from typing import Any

from pymavlink.dialects.v20 import common as mav

from events import Odometry
from runtime.logs import NodeLogger
from visnav_mavlink.endpoint import MavlinkEndpoint
from visnav_mavlink.settings import RATE, MavlinkConfig

SECOND = 1_000_000_000
ORIGIN = (47.0, 8.0, 400.0)
GROUND = (1.0, 2.0, -0.1)


class Program:
    """A program with a UDP link of its own to an endpoint; by its address and its numbers."""

    endpoint: MavlinkEndpoint

    def __init__(self, system: int = 245, component: int = 190) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.link = f"udp://127.0.0.1:{self._socket.getsockname()[1]}"
        self.parser = mav.MAVLink(None, system, component)

    def say(self, *messages: Any) -> list[Any]:
        """Let the endpoint hear messages; return what it answers at once."""
        self.hear()
        for message in messages:
            self.hand_in(message if isinstance(message, bytes) else message.pack(self.parser))
        return self.hear()

    def hand_in(self, data: bytes) -> None:
        links = self.endpoint._links
        (peer,) = (peer for peer in links.peers if peer.name == self.link)
        self._socket.sendto(data, peer.end.getsockname())
        links.read(peer)

    def hear(self) -> list[Any]:
        messages: list[Any] = []
        while True:
            try:
                data = self._socket.recv(65535)
            except BlockingIOError:
                return messages
            messages += self.parser.parse_buffer(data) or []

    def close(self) -> None:
        self._socket.close()


class Outside(Program):
    """A program at the other end of an endpoint's link, and the vehicle behind it."""

    def __init__(self, *others: Program, **changes: Any) -> None:
        super().__init__()
        self.now = SECOND
        self.acts: list[Any] = []
        self.seen: list[dict[str, Any]] = []
        config = MavlinkConfig(endpoints=(self.link, *(other.link for other in others)), **changes)
        self.endpoint = MavlinkEndpoint(
            config, ORIGIN, self._act, self._see, lambda: self.now, NodeLogger("mavlink")
        )
        self.endpoint.open()
        for other in others:
            other.endpoint = self.endpoint
        if config.signing_key:
            self.parser.signing.secret_key = bytes.fromhex(config.signing_key)
            self.parser.signing.sign_outgoing = True
            (peer,) = self.endpoint._links.peers
            self.parser.signing.timestamp = peer.parser.signing.timestamp
        self.at(GROUND)

    def _act(self, kind: Any, **fields: Any) -> None:
        self.acts.append(kind(stamp=self.now, source="mavlink", **fields))

    def _see(self, **fields: Any) -> None:
        self.seen.append(fields)

    def at(self, position: Any) -> None:
        """Put the vehicle somewhere, level."""
        still = (0.0, 0.0, 0.0)
        self.endpoint.vehicle.set_pose(
            Odometry(
                stamp=self.now, source="drone", position=position, orientation=(1, 0, 0, 0),
                linear_velocity=still, angular_velocity=still,
            )
        )  # fmt: skip

    def flies(self) -> None:
        """Arm and put it into the air."""
        self.say(arm(1))
        self.at((1.0, 2.0, -2.0))
        self.acts.clear()

    def passes(self, seconds: float, heartbeat: bool = True) -> list[Any]:
        """Let time pass, as the node does; return what is sent."""
        heard: list[Any] = []
        for step in range(round(seconds * RATE)):
            if heartbeat and step % RATE == 0:
                self.hand_in(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(self.parser))
            self.now += round(SECOND / RATE)
            self.endpoint.update(self.now, self.now / SECOND)
            heard += self.hear()
        return heard

    def close(self) -> None:
        self.endpoint.close()
        super().close()


def command(number: int, *params: float) -> Any:
    numbers = [*params, *[math.nan] * (7 - len(params))]
    return mav.MAVLink_command_long_message(1, 1, number, 0, *numbers)


def arm(number: int, force: float = 0) -> Any:
    return command(mav.MAV_CMD_COMPONENT_ARM_DISARM, number, force)


def mode(main: int, sub: int) -> Any:
    return command(mav.MAV_CMD_DO_SET_MODE, 1, main, sub)


def target(mask: int, x: float = 0, vx: float = 0, frame: int = 1) -> Any:
    return mav.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, mask, x, 0, -2, vx, 0, 0, 0, 0, 0, 0.5, 0.0
    )


def item(seq: int, number: int, z: float = 2.0, frame: int = 6, p1: float = 0) -> Any:
    return mav.MAVLink_mission_item_int_message(
        1, 1, seq, frame, number, 0, 1, p1, 0, 0, math.nan, 470000000, 80000000, z, 0
    )


def of(kind: str, messages: list[Any]) -> list[Any]:
    return [message for message in messages if message.get_type() == kind]


def texts(messages: list[Any]) -> list[str]:
    """Return the sentences of ``STATUSTEXT``, which come in pieces of 50 characters."""
    joined: dict[int, str] = {}
    single = 0
    for message in of("STATUSTEXT", messages):
        single -= 1
        key = message.id or single
        joined[key] = joined.get(key, "") + message.text
    return [*joined.values()]


def results(answers: list[Any]) -> list[int]:
    return [message.result for message in of("COMMAND_ACK", answers)]
