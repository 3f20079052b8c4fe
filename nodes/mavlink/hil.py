"""The wire to PX4 in the loop: sensors go out, and motor commands are waited for.

As of PX4's simulator interface (docs.px4.io, "Simulator MAVLink API"): PX4 connects by TCP, is free
to be silent while it starts, and from its first answer on gives one for each ``HIL_SENSOR``.
"""

from __future__ import annotations

import socket
import time
from typing import Any

from events import FluidPressure, Imu, MagneticField, NavSatFix
from nodes.mavlink.links import mav

SLICE = 0.2  # real seconds between two looks at whether the run has ended
STARTING = 0.004  # real seconds that an answer may take before the first one has come
_IMU, _MAGNETOMETER, _BAROMETER = 0b111111, 0b111000000, 0b1101000000000
MOTORS = 4


class Wire:
    """PX4's connection; its methods block, and are called beside the loop.

    Raises:
        OSError: Nobody can listen on this address.
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
        """Send what was measured, and return the answer; `None` while PX4 starts, or at the end.

        Raises:
            ConnectionError: PX4 has gone.
            TimeoutError: It has not answered in time.
        """
        if self._peer is None:
            return None
        self._peer.settimeout(patience)
        try:
            self._peer.sendall(b"".join(each.pack(self._parser) for each in messages))
        except TimeoutError:
            raise
        except OSError as error:
            raise ConnectionError(f"PX4 has gone after {self.answers} answers: {error}") from None
        end = time.monotonic() + (patience if self.answers else STARTING)
        while not self._closed:
            left = end - time.monotonic()
            if left <= 0:
                if self.answers:
                    raise TimeoutError(f"expected PX4's next answer, waited {patience:g} s")
                return None
            self._peer.settimeout(min(left, SLICE))
            try:
                data = self._peer.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                data = b""
            if not data and not self._closed:
                raise ConnectionError(f"PX4 has gone after {self.answers} answers")
            for found in self._parser.parse_buffer(data) or ():
                if found.get_type() == "HIL_ACTUATOR_CONTROLS":
                    self.answers += 1
                    return found
        return None

    def close(self) -> None:
        """Hang up, and end what waits."""
        self._closed = True
        self._listener.close()
        if self._peer is not None:
            self._peer.close()


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


def satellites(fix: NavSatFix) -> Any:
    """Return a ``HIL_GPS`` of a fix."""
    north, east, down = (round(100 * each) for each in fix.velocity)
    place = round(1e7 * fix.latitude), round(1e7 * fix.longitude), round(1e3 * fix.altitude)
    speed = round((north**2 + east**2) ** 0.5)
    kind = mav.GPS_FIX_TYPE_3D_FIX if fix.status >= 0 else mav.GPS_FIX_TYPE_NO_FIX
    return mav.MAVLink_hil_gps_message(
        fix.stamp // 1000, kind, *place, 90, 120, speed, north, east, down, 65535, 12
    )


def motors(answer: Any) -> tuple[bool, tuple[float, ...]]:
    """Return whether PX4 has armed, and its first motors' commands, 0 to 1 of full thrust."""
    armed = bool(answer.mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
    values = (each if each == each else 0.0 for each in answer.controls[:MOTORS])
    return armed, tuple(min(max(each, 0.0), 1.0) for each in values)
