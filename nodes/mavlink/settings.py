"""Settings of the door, without MAVLink's library, which may not be there."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

import msgspec

from runtime import Duration, NodeConfig


class MavlinkConfig(NodeConfig):
    """Settings of the door.

    Attributes:
        vehicle: Vehicle to fly; may be left out if there is only one.
        endpoints: ``udp://HOST:PORT`` sends to who listens there; ``tcp://HOST:PORT`` listens.
            Whoever reaches one flies the vehicle.
        system_id: MAVLink's number of the vehicle: another one for each of a run.
        telemetry: Source of the pose in the telemetry: empty for the true one, or an estimator.
        gps: Whether the telemetry has a global position.
        vision: Whether poses come from outside (``ODOMETRY``, ``VISION_POSITION_ESTIMATE``); they
            are judged as this node's estimates.
        link_loss: What a flying vehicle does when nobody is heard any more.
        link_timeout: Real time after which that is so.
        signing_key: Secret of 64 hexadecimal digits, without which nobody is heard; empty for
            none.
    """

    vehicle: str = ""
    endpoints: tuple[str, ...] = ("udp://127.0.0.1:14540", "udp://127.0.0.1:14550")
    system_id: Annotated[int, msgspec.Meta(ge=1, le=254)] = 1
    telemetry: str = ""
    gps: bool = True
    vision: bool = False
    link_loss: Literal["nothing", "hold", "land"] = "hold"
    link_timeout: Duration = Duration(3.0)  # immutable
    signing_key: str = ""

    def __post_init__(self) -> None:
        for link in self.endpoints:
            address_of(link)
        key_of(self.signing_key)


def address_of(link: str) -> tuple[str, str, int]:
    """Return the protocol, host and port of ``udp://HOST:PORT`` or ``tcp://HOST:PORT``.

    Raises:
        ValueError: It is none.
    """
    try:
        parts = urlsplit(link)
        if parts.scheme in {"udp", "tcp"} and parts.hostname and parts.port is not None:
            return parts.scheme, parts.hostname, parts.port
    except ValueError:
        pass
    raise ValueError(f"endpoints: expected udp://HOST:PORT or tcp://HOST:PORT, found {link!r}")


def key_of(text: str) -> bytes:
    """Return a signing key of 64 hexadecimal digits, or none.

    Raises:
        ValueError: It is no such key.
    """
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b"?"
    if len(key) not in {0, 32}:
        raise ValueError("signing_key: expected 64 hexadecimal digits, or nothing")
    return key


class Px4Config(NodeConfig):
    """Settings of PX4 in the loop.

    Attributes:
        vehicle: Vehicle whose motors it drives; may be left out if there is only one.
        host: Address to listen on.
        port: Port to listen on, where PX4 looks for its simulator.
        start: Real time in which PX4 must have connected.
        answer: Real time in which it must have answered; simulated time waits for it.
    """

    vehicle: str = ""
    host: str = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 4560
    start: Duration = Duration(60.0)  # immutable
    answer: Duration = Duration(10.0)
