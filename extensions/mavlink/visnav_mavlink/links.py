"""Sockets to MAVLink's programs, whose messages are parsed, counted and bounded; and to PX4.

PX4 in the loop is as of its simulator interface (docs.px4.io, "Simulator MAVLink API"): it connects
by TCP, is free to be silent while it starts, and from its first answer on gives one for each
``HIL_SENSOR``.
"""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import urlsplit

from pymavlink.dialects.v20 import common

from events import FluidPressure, Imu, MagneticField, NavSatFix
from runtime.logs import NodeLogger

mav: Any = common
"""MAVLink's common dialect: messages and constants."""

BURST = 400  # messages of all peers that are read in a period; the kernel drops the rest
MOST_PEERS = 8  # programs on one TCP port
LONGEST_QUEUE = 1 << 20  # bytes not yet taken by a program, beyond which it is hung up on
MOST_ERRORS = 10  # tracebacks in the log
_EPOCH_2015 = 1_420_070_400  # signatures' time begins there (mavlink.io, message signing)

SLICE = 0.2  # real seconds between two looks at whether the run has ended
STARTING = 0.004  # real seconds that PX4's answer may take before the first one has come
_IMU, _MAGNETOMETER, _BAROMETER = 0b111111, 0b111000000, 0b1101000000000
_TEMPERATURE = 0b1000000000000
MOTORS = 4

Sender = tuple[int, int]
"""System and component."""

Receive = Callable[["Peer", Sender, Any], None]
"""Called with the link's peer, the message's sender, and the message."""


class Peer:
    """A program at the other end of a socket, with its own parser and numbering."""

    def __init__(self, end: socket.socket, name: str, ids: tuple[int, int], key: bytes) -> None:
        end.setblocking(False)
        self.end, self.name = end, name
        self.is_stream = end.type == socket.SOCK_STREAM
        self.unsent = bytearray()  # of a stream
        self.received_at = -math.inf
        self.parser = mav.MAVLink(None, *ids)
        self.parser.robust_parsing = True
        if key:
            signing = self.parser.signing
            signing.secret_key, signing.sign_outgoing = key, True
            signing.timestamp = int((time.time() - _EPOCH_2015) * 1e5)

    def pack(self, message: Any) -> bytes:
        """Return a message's bytes, with the link's next sequence number and signature."""
        return _packed(message, self.parser)

    def read_ardupilot(self, message: Any) -> Any:
        """Return a message of ArduPilot's dialect, whose bytes `parser` has left as they are.

        Returns:
            `None` if it is broken, or not signed as all others must be.
        """
        dialect = ardupilot_dialect()
        reader = dialect.MAVLink(None)
        reader.signing = self.parser.signing
        try:
            return reader.decode(bytearray(message.get_msgbuf()))
        except dialect.MAVError:
            return None

    def messages(self, data: bytes) -> list[Any]:
        """Return the messages in some bytes; a datagram starts with a new message."""
        if not self.is_stream:
            self.parser.buf, self.parser.buf_index = bytearray(), 0
            self.parser.expected_length = mav.HEADER_LEN_V1 + 2
        return self.parser.parse_buffer(data) or []


class Links:
    """All links of a vehicle.

    UDP links exchange datagrams with one address; TCP links listen. No call waits for a peer.
    """

    def __init__(self, ids: tuple[int, int], key: bytes, receive: Receive, log: NodeLogger) -> None:
        self._ids, self._key, self._receive, self._log = ids, key, receive, log
        self._loop = asyncio.get_running_loop()
        self.peers: list[Peer] = []
        self._listeners: list[socket.socket] = []
        self._now, self._budget = 0.0, BURST
        self._muted: list[Peer] = []
        self.counts: Counter[str] = Counter()

    def open(self, link: str) -> None:
        """Open a link.

        Raises:
            OSError: It cannot be opened.
        """
        parts = urlsplit(link)
        address = parts.hostname, parts.port
        if parts.scheme == "udp":
            end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            end.connect(address)
            self._adopt(end, link)
        else:
            end = socket.create_server(address, backlog=MOST_PEERS)
            end.setblocking(False)
            self._listeners.append(end)
            self._loop.add_reader(end, self._accept, end)

    def send(self, message: Any) -> None:
        """Send a message to every peer."""
        for peer in [*self.peers]:
            self.send_to(peer, message)

    def send_to(self, peer: Peer, message: Any) -> None:
        """Send a message to a peer."""
        data = peer.pack(message)
        if peer.is_stream:
            self._send_on(peer, data)
            return
        try:
            peer.end.send(data)
        except OSError:  # the port is closed, or its buffer full: datagrams may get lost
            self.counts["datagrams not taken"] += 1

    def quiet_for(self, now: float) -> float:
        """Return the seconds since the last message of any peer; infinite if there was none."""
        return now - max((peer.received_at for peer in self.peers), default=-math.inf)

    def refill(self, now: float) -> None:
        """Start a period: peers that were paused are read again."""
        self._now, self._budget = now, BURST
        muted, self._muted = self._muted, []
        for peer in muted:
            if peer in self.peers:
                self._loop.add_reader(peer.end, self.read, peer)

    def read(self, peer: Peer) -> None:
        """Read a peer's data; disconnect a stream that has ended."""
        try:
            data = peer.end.recv(4096 if peer.is_stream else 65535)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:  # of datagrams: the port is not open yet
            data = b""
        if data:
            self._handle_data(peer, data)
        elif peer.is_stream:
            self._disconnect(peer)

    def close(self) -> None:
        """Close all sockets; log the counts of unusual messages."""
        for peer in [*self.peers]:
            self._disconnect(peer)
        for end in self._listeners:
            self._loop.remove_reader(end)
            end.close()
        odd = ", ".join(f"{n} {name}" for name, n in self.counts.items() if name != "messages")
        self._log.info("%d messages heard%s", self.counts["messages"], odd and f"; {odd}")

    def _adopt(self, end: socket.socket, name: str) -> None:
        self.peers.append(peer := Peer(end, name, self._ids, self._key))
        self._loop.add_reader(end, self.read, peer)

    def _accept(self, listener: socket.socket) -> None:
        try:
            end, (host, port, *_) = listener.accept()
        except OSError:
            return
        if sum(peer.is_stream for peer in self.peers) >= MOST_PEERS:
            self.counts["connections refused"] += 1
            end.close()
            return
        self._adopt(end, f"tcp://{host}:{port}")

    def _handle_data(self, peer: Peer, data: bytes) -> None:
        for message in peer.messages(data):
            if message.get_type() == "BAD_DATA":
                self.counts["pieces of garbage"] += 1
            elif _sender(message) == self._ids:
                self.counts["messages in our own name"] += 1
            else:
                self.counts["messages"] += 1
                peer.received_at = self._now
                self._deliver(peer, message)
            self._budget -= 1
        if self._budget <= 0 and peer in self.peers:
            self.counts["pauses in a flood"] += 1
            self._loop.remove_reader(peer.end)
            self._muted.append(peer)

    def _deliver(self, peer: Peer, message: Any) -> None:
        """Pass a message on; an error in its handler must not lose those read with it."""
        sender = _sender(message)
        try:
            self._receive(peer, sender, message)
        except Exception:
            self.counts["errors"] += 1
            if self.counts["errors"] <= MOST_ERRORS:
                kind = message.get_type()
                self._log.exception("%s of system %d, component %d: not handled", kind, *sender)

    def _send_on(self, peer: Peer, data: bytes) -> None:
        peer.unsent += data
        if len(peer.unsent) > LONGEST_QUEUE:
            self._log.warning("%s takes nothing: hung up", peer.name)
            self._disconnect(peer)
        elif len(peer.unsent) == len(data):
            self._flush(peer)

    def _flush(self, peer: Peer) -> None:
        try:
            del peer.unsent[: peer.end.send(peer.unsent)]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError:
            self._disconnect(peer)
            return
        if peer.unsent:
            self._loop.add_writer(peer.end, self._flush, peer)
        else:
            self._loop.remove_writer(peer.end)

    def _disconnect(self, peer: Peer) -> None:
        self._loop.remove_reader(peer.end)
        self._loop.remove_writer(peer.end)
        self.peers = [other for other in self.peers if other is not peer]
        peer.end.close()


class Wire:
    """PX4's connection; its methods block, and are called beside the loop.

    Raises:
        OSError: The address cannot be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port), backlog=1)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._peer: socket.socket | None = None
        self._parser = mav.MAVLink(None, 1, 200)
        self._parser.robust_parsing = True
        self._closed = False
        self.answers = 0

    def accept(self, patience: float) -> None:
        """Wait for PX4; a `TimeoutError` if it does not come."""
        self._listener.settimeout(SLICE)
        end = time.monotonic() + patience
        while not self._closed:
            try:
                self._peer, _ = self._listener.accept()
            except TimeoutError:
                if time.monotonic() > end:
                    raise TimeoutError(f"expected PX4 to connect, waited {patience:g} s") from None
            else:
                self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return

    def exchange(self, messages: list[Any], patience: float) -> Any:
        """Send measurements, and return the answer; `None` while PX4 starts, or at the end.

        Raises:
            ConnectionError: PX4 has gone.
            TimeoutError: It has not answered in time.
        """
        if self._peer is None:
            return None
        self._peer.settimeout(patience)
        try:
            self._peer.sendall(b"".join(_packed(message, self._parser) for message in messages))
        except TimeoutError:
            raise
        except OSError as error:
            raise ConnectionError(f"PX4 has gone after {self.answers} answers: {error}") from None
        end = time.monotonic() + (patience if self.answers else STARTING)
        while not self._closed:
            remaining = end - time.monotonic()
            if remaining <= 0:
                if self.answers:
                    raise TimeoutError(f"expected PX4's next answer, waited {patience:g} s")
                return None
            self._peer.settimeout(min(remaining, SLICE))
            try:
                data = self._peer.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                data = b""
            if not data and not self._closed:
                raise ConnectionError(f"PX4 has gone after {self.answers} answers")
            for message in self._parser.parse_buffer(data) or ():
                if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                    self.answers += 1
                    return message
        return None

    def close(self) -> None:
        """Close the connection, and end waiting calls."""
        self._closed = True
        self._listener.close()
        if self._peer is not None:
            self._peer.close()


def _sender(message: Any) -> Sender:
    """Return the system and component, which pymavlink does not read of kinds it does not know."""
    data = message.get_msgbuf()
    system, component = data[3:5] if data[0] == mav.PROTOCOL_MARKER_V1 else data[5:7]
    return system, component


def _packed(message: Any, parser: Any) -> bytes:
    """Return a message's bytes, and raise the sequence number, which `pack` leaves as it is."""
    data: bytes = message.pack(parser)
    parser.seq = (parser.seq + 1) % 256
    return data


def ardupilot_dialect() -> Any:
    """Return ArduPilot's dialect, imported when needed as that takes a while."""
    from pymavlink.dialects.v20 import ardupilotmega

    return ardupilotmega


def sensors(imu: Imu, field: MagneticField | None, pressure: FluidPressure | None) -> Any:
    """Return a ``HIL_SENSOR`` of an IMU's sample, and of what else is new."""
    gauss = (0.0, 0.0, 0.0)
    updated = _IMU
    if field is not None:
        x, y, z = field.magnetic_field
        gauss, updated = (1e4 * x, 1e4 * y, 1e4 * z), updated | _MAGNETOMETER
    air = (0.0, 0.0, 0.0, 0.0)  # hPa absolute and differential, metres, degrees Celsius
    if pressure is not None:
        pascal = pressure.fluid_pressure
        # The standard atmosphere's altitude (ICAO Doc 7488).
        altitude = 44330.8 * (1.0 - (pascal / 101325.0) ** 0.190263)
        air, updated = (pascal / 100.0, 0.0, altitude, 25.0), updated | _BAROMETER
    measured = *imu.linear_acceleration, *imu.angular_velocity
    return mav.MAVLink_hil_sensor_message(imu.stamp // 1000, *measured, *gauss, *air, updated, 0)


def highres_imu(
    imu: Imu, field: MagneticField | None, pressure: FluidPressure | None, updated: Sequence[bool]
) -> Any:
    """Return a ``HIGHRES_IMU`` of an IMU's sample and of what else was measured last.

    Args:
        updated: Which of the three are new. No sensor here measures a temperature.
    """
    hil = sensors(imu, field, pressure)
    groups = _IMU, _MAGNETOMETER, _BAROMETER & ~_TEMPERATURE
    flags = sum(group for group, is_new in zip(groups, updated, strict=True) if is_new)
    values = (getattr(hil, name) for name in _MEASURED)
    return mav.MAVLink_highres_imu_message(*values, 0.0, flags, 0)


_MEASURED = (
    "time_usec", "xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "xmag", "ymag", "zmag",
    "abs_pressure", "diff_pressure", "pressure_alt",
)  # fmt: skip


def satellites(fix: NavSatFix) -> Any:
    """Return a ``HIL_GPS`` of a fix."""
    north, east, down = (round(100 * speed) for speed in fix.velocity)
    place = round(1e7 * fix.latitude), round(1e7 * fix.longitude), round(1e3 * fix.altitude)
    speed = round((north**2 + east**2) ** 0.5)
    kind = mav.GPS_FIX_TYPE_3D_FIX if fix.status >= 0 else mav.GPS_FIX_TYPE_NO_FIX
    return mav.MAVLink_hil_gps_message(
        fix.stamp // 1000, kind, *place, 90, 120, speed, north, east, down, 65535, 12
    )


def motors(answer: Any) -> tuple[bool, tuple[float, ...]]:
    """Return whether PX4 has armed, and its first motors' commands, 0 to 1 of full thrust."""
    armed = bool(answer.mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    values = (control if control == control else 0.0 for control in answer.controls[:MOTORS])
    return armed, tuple(min(max(value, 0.0), 1.0) for value in values)
