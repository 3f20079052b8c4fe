"""Endpoint of a vehicle's links: dispatches received messages, and sends periodic ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from events.frames import Geodetic, from_rpy
from runtime.logs import NodeLogger
from visnav_mavlink.flight import Flight
from visnav_mavlink.links import Links, Peer, mav
from visnav_mavlink.settings import MavlinkConfig
from visnav_mavlink.vehicle import SECOND, Missions, Parameters, Telemetry, Vehicle

OLDEST = 10 * SECOND  # age of a vision stamp beyond which its clock is not ours
MOST_SAID = 100  # sentences that the log has once each, lest messages of any kind fill it
_COVARIANCE = np.triu_indices(6)


class MavlinkEndpoint:
    """A vehicle's links with all that answers on them.

    Args:
        act: Sends a command or a set-point of these fields to the vehicle.
        see: Publishes a pose from outside: its stamp and fields.
    """

    def __init__(
        self,
        config: MavlinkConfig,
        origin: Geodetic,
        act: Callable[..., None],
        see: Callable[..., None],
        now: Callable[[], int],
        log: NodeLogger,
    ) -> None:
        self._config, self._see_pose, self._now, self._log = config, see, now, log
        self._said: set[str] = set()
        self._told = 0
        self._is_lost = True  # until the first is heard
        ids = config.system_id, int(mav.MAV_COMP_ID_AUTOPILOT1)
        self._links = Links(ids, bytes.fromhex(config.signing_key), self._hear, log)
        self._send = send = self._links.send
        self.vehicle = vehicle = Vehicle(origin, config.gps)
        self._telemetry = Telemetry(vehicle, self._links, self._tell)
        self._parameters = Parameters(send, self._tell)
        self._missions = Missions(send, lambda item: self.flight.refused(item), self._tell)
        parts = self._missions, self._parameters
        self.flight = Flight(vehicle, *parts, act, self._tell, self._once)

    def open(self) -> None:
        """Open the links; a `ValueError` if one cannot be."""
        for link in self._config.endpoints:
            try:
                self._links.open(link)
            except OSError as error:
                self._links.close()
                raise ValueError(f"endpoints: {link}: {error.strerror or error}") from None
        log = self._log.info
        log("system %d on %s", self._config.system_id, ", ".join(self._config.endpoints))

    def update(self, now: int, wall: float) -> None:
        """Send what is due, steer, and miss who is not heard; `wall` is in real seconds."""
        config = self._config
        self._links.refill(wall)
        self._telemetry.update(now)
        self._missions.update(now)
        self.flight.update(now)
        is_lost = self._links.quiet_for(wall) > config.link_timeout
        if is_lost and not self._is_lost and config.link_loss != "nothing":
            self.flight.lost(config.link_loss, now)
        self._is_lost = is_lost

    def close(self) -> None:
        """Close the links."""
        self._links.close()

    def _hear(self, peer: Peer, sender: tuple[int, int], message: Any) -> None:
        """Give a message to whom it is for."""
        target = getattr(message, "target_system", 0)
        part = getattr(message, "target_component", 0)
        if target not in {0, self._config.system_id} or part not in {0, 1}:
            return
        now, kind = self._now(), message.get_type()
        if kind in {"COMMAND_LONG", "COMMAND_INT"}:
            result = self._telemetry.command(peer, message, now)
            if result is None:
                result = self.flight.command(message, now)
            self._send(mav.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))
        elif kind.startswith("SET_POSITION_TARGET") or kind == "SET_ATTITUDE_TARGET":
            self.flight.offboard(message, now)
        elif kind == "SET_MODE":
            mode = message.custom_mode
            self.flight.set_px4_mode(mode >> 16 & 255, mode >> 24 & 255, now)
        elif kind.startswith("MISSION_"):
            self._missions.hear(sender, message, now)
        elif kind.startswith("PARAM_"):
            self._parameters.hear(message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mav.MAVLink_timesync_message(now, message.ts1))
        elif kind == "PING" and target == 0:
            self._send(mav.MAVLink_ping_message(message.time_usec, message.seq, *sender))
        elif kind in {"ODOMETRY", "VISION_POSITION_ESTIMATE"}:
            self._see(message, now)

    def _see(self, message: Any, now: int) -> None:
        """Publish a pose from outside as an estimate."""
        if not self._config.vision:
            self._once("poses from outside come, and are not judged: vision is false")
            return
        if message.get_type() == "ODOMETRY":
            frame = message.frame_id
            if frame not in {mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_FRD}:
                self._once(f"ODOMETRY: expected frame_id LOCAL_NED or LOCAL_FRD, found {frame}")
                return
            stamp, covariance, q = message.time_usec, message.pose_covariance, message.q
            size = math.hypot(*q)
            orientation = tuple(value / size for value in q) if 0.5 < size < 2.0 else ()
        else:
            stamp, covariance = message.usec, message.covariance
            angles = message.roll, message.pitch, message.yaw
            orientation = from_rpy(*angles) if all(map(math.isfinite, angles)) else ()
        position = message.x, message.y, message.z
        if not orientation or not all(map(math.isfinite, position)):
            self._once("a pose from outside with numbers that are none: not taken")
            return
        stamp *= 1000
        if not now - OLDEST < stamp <= now:
            self._once(
                "poses from outside have stamps of another clock, where those of TIMESYNC's were "
                "expected: their arrival counts"
            )
            stamp = now
        frame = f"odom_{message.reset_counter}" if message.reset_counter else "odom"
        full: tuple[float, ...] = ()
        if np.isfinite(covariance).all() and np.any(covariance):
            matrix = np.zeros((6, 6))
            matrix[_COVARIANCE] = covariance
            full = tuple((matrix + np.triu(matrix, 1).T).ravel().tolist())
        self._see_pose(
            stamp=stamp,
            frame_id=frame,
            position=position,
            orientation=orientation,
            covariance=full,
        )

    def _once(self, words: str) -> None:
        if words not in self._said and len(self._said) < MOST_SAID:
            self._said.add(words)
            self._log.warning("%s", words)

    def _tell(self, text: str) -> None:
        self._log.warning("%s", text)
        data = text.encode("ascii", "replace")
        parts = [data[begin : begin + 50] for begin in range(0, len(data), 50)]
        self._told = self._told % 65535 + 1
        number = self._told if len(parts) > 1 else 0
        for index, part in enumerate(parts):
            level = mav.MAV_SEVERITY_WARNING
            self._send(mav.MAVLink_statustext_message(level, part, number, index))
