"""Settings of the node that is a vehicle on MAVLink."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

import msgspec

from nodes.pilots.pilot import VehicleControllerConfig
from runtime import Duration
from runtime.units import Latency

RATE = 100.0
"""Highest rate of telemetry, and of set-points on the way to a place, Hz."""


class MavlinkConfig(VehicleControllerConfig):
    """Settings of the endpoint.

    Attributes:
        vehicle: Vehicle to fly; may be left out if there is only one.
        endpoints: ``udp://HOST:PORT`` sends to who listens there; ``tcp://HOST:PORT`` listens.
            Whoever reaches one flies the vehicle.
        autopilot: Whose modes and conventions programs find: PX4's, or those of ArduPilot's Copter
            (one mode GUIDED, altitudes above home, a mission's first item is home).
        system_id: MAVLink's number of the vehicle: another one for each of a run.
        telemetry: Source of the pose in the telemetry: empty for the true one, or an estimator.
        gps: Whether the telemetry has a global position.
        vision: Whether poses come from outside (``ODOMETRY``, ``VISION_POSITION_ESTIMATE``); they
            are judged as this node's estimates.
        delay: How long before their stamps poses from outside were measured, as PX4's
            ``EKF2_EV_DELAY``: whole latency where stamps are those of another clock that only the
            earliest arrival tells, none where they are synchronized.
        link_loss: What a flying vehicle does when nobody is heard any more.
        link_timeout: Real time after which that is so.
        signing_key: Secret of 64 hexadecimal digits, without which nobody is heard; empty for
            none.
    """

    endpoints: tuple[str, ...] = ("udp://127.0.0.1:14540", "udp://127.0.0.1:14550")
    autopilot: Literal["px4", "ardupilot"] = "px4"
    system_id: Annotated[int, msgspec.Meta(ge=1, le=254)] = 1
    telemetry: str = ""
    gps: bool = True
    vision: bool = False
    delay: Latency = Latency(0.0)  # immutable
    link_loss: Literal["nothing", "hold", "land"] = "hold"
    link_timeout: Duration = Duration(3.0)  # immutable
    signing_key: str = ""

    def __post_init__(self) -> None:
        for link in self.endpoints:
            if not _is_address(link):
                raise ValueError(
                    f"endpoints: expected udp://HOST:PORT or tcp://HOST:PORT, found {link!r}"
                )
        try:
            size = len(bytes.fromhex(self.signing_key))
        except ValueError:
            size = -1
        if size not in {0, 32}:
            raise ValueError("signing_key: expected 64 hexadecimal digits, or nothing")


def _is_address(link: str) -> bool:
    try:
        parts = urlsplit(link)
        return parts.scheme in {"udp", "tcp"} and bool(parts.hostname) and parts.port is not None
    except ValueError:
        return False
