"""Answers to requests that change nothing: clocks, echoes, and what there is none of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from visnav_mavlink.links import Sender, mav
from visnav_mavlink.vehicle import Vehicle

_FTP_ANSWERS = 128  # opcode from which on it is an answer
_FTP_NAK, _FTP_UNKNOWN_COMMAND = 129, 7  # mavlink.io, File Transfer Protocol


def _timesync(message: Any, sender: Sender, now: int, _: Vehicle) -> Any:  # noqa: ARG001
    return mav.MAVLink_timesync_message(now, message.ts1) if message.tc1 == 0 else None


def _ping(message: Any, sender: Sender, *_: Any) -> Any:
    if message.target_system:
        return None  # an answer itself
    return mav.MAVLink_ping_message(message.time_usec, message.seq, *sender)


def _no_logs(*_: Any) -> Any:
    return mav.MAVLink_log_entry_message(0, 0, 0, 0, 0)


def _no_log_data(message: Any, *_: Any) -> Any:
    return mav.MAVLink_log_data_message(message.id, message.ofs, 0, [0] * 90)


def _no_file(message: Any, sender: Sender, *_: Any) -> Any:
    low, high, session, opcode, *_rest = message.payload
    if opcode >= _FTP_ANSWERS:
        return None
    number = (low | high << 8) + 1 & 0xFFFF
    answer = [number & 255, number >> 8, session, _FTP_NAK, 1, opcode, 0, 0, 0, 0, 0, 0]
    answer.append(_FTP_UNKNOWN_COMMAND)
    return mav.MAVLink_file_transfer_protocol_message(0, *sender, answer + [0] * 238)


def _no_extended_parameter(message: Any, *_: Any) -> Any:
    name, value = message.param_id.encode(), message.param_value.encode()
    kind, failed = message.param_type, mav.PARAM_ACK_FAILED
    return mav.MAVLink_param_ext_ack_message(name, value, kind, failed)


def _no_part(message: Any, sender: Sender, *_: Any) -> Any:
    result = mav.MAV_MISSION_UNSUPPORTED
    return mav.MAVLink_mission_ack_message(*sender, result, message.mission_type)


def _global_origin(_message: Any, _sender: Sender, now: int, vehicle: Vehicle) -> Any:
    place = vehicle.place((0.0, 0.0, 0.0))
    return mav.MAVLink_gps_global_origin_message(*place, now // 1000) if vehicle.gps else None


ANSWERS: dict[str, Callable[[Any, Sender, int, Vehicle], Any]] = {
    "TIMESYNC": _timesync,
    "PING": _ping,
    "LOG_REQUEST_LIST": _no_logs,
    "LOG_REQUEST_DATA": _no_log_data,
    "FILE_TRANSFER_PROTOCOL": _no_file,
    "PARAM_EXT_SET": _no_extended_parameter,
    "MISSION_REQUEST_PARTIAL_LIST": _no_part,
    "MISSION_WRITE_PARTIAL_LIST": _no_part,
    "SET_GPS_GLOBAL_ORIGIN": _global_origin,
}
"""Kind to its answer, from the message, its sender, the time (ns) and the vehicle; or `None`."""
