"""Endpoint of a vehicle's links: dispatches received messages, and sends periodic ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from events.frames import Geodetic
from runtime.logs import NodeLogger
from visnav_mavlink.answers import ANSWERS
from visnav_mavlink.clocks import Clocks
from visnav_mavlink.flight import Flight
from visnav_mavlink.links import Links, Peer, Sender, ardupilot_dialect, mav
from visnav_mavlink.messages import OF_ARDUPILOT, TREATMENTS
from visnav_mavlink.missions import Guided, Missions
from visnav_mavlink.settings import MavlinkConfig
from visnav_mavlink.vehicle import SECOND, Parameters, Telemetry, Vehicle
from visnav_mavlink.vision import Vision

MOST_SAID = 100  # different sentences in the log, once each; bounds a flood of messages

Handler = Callable[[Peer, Sender, Any, int], None]
"""Takes the link's peer, the sender, the message and the time (ns)."""


class MavlinkEndpoint:
    """A vehicle's links with all that answers on them.

    Args:
        act: Sends a command or a set-point of these fields to the vehicle.
        publish_pose: Publishes a pose from outside: its stamp and fields.
    """

    def __init__(
        self,
        config: MavlinkConfig,
        origin: Geodetic,
        act: Callable[..., None],
        publish_pose: Callable[..., None],
        now: Callable[[], int],
        log: NodeLogger,
    ) -> None:
        self._config, self._now, self._log = config, now, log
        self._sentences: set[str] = set()
        self._text_number = 0
        self._is_lost = True  # until the first message
        ids = config.system_id, int(mav.MAV_COMP_ID_AUTOPILOT1)
        self._links = Links(ids, bytes.fromhex(config.signing_key), self._handle, log)
        self._send = send = self._links.send
        self.vehicle = vehicle = Vehicle(origin, config.gps, config.autopilot == "ardupilot")
        self._clocks = Clocks(round(config.delay * SECOND), send, self._report_once)
        self._vision = Vision(self._clocks, publish_pose, self._refuse, self._report_once)
        self._telemetry = Telemetry(vehicle, self._links, self._report)
        self._parameters = Parameters(send, self._report)
        self._missions = Missions(
            vehicle,
            send,
            lambda item: self.flight.refusal(item),
            self._report,
            lambda: self.flight.drop_item(),
            Guided(vehicle, lambda item, now: self.flight.fly_to(item, now))
            if vehicle.is_copter
            else None,
        )
        vehicle.progress = lambda: self._missions.progress
        parts = self._missions, self._parameters
        self.flight = Flight(vehicle, *parts, act, self._report, self._warn_once)
        by_handler: dict[Handler, str] = {
            self._command: "COMMAND_LONG COMMAND_INT",
            self._set_mode: "SET_MODE",
            self._offboard: "SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT "
            "SET_ATTITUDE_TARGET",
            self._sticks: "MANUAL_CONTROL",
            self._mission: "MISSION_COUNT MISSION_ITEM MISSION_ITEM_INT MISSION_ACK "
            "MISSION_CLEAR_ALL MISSION_SET_CURRENT MISSION_REQUEST_LIST MISSION_REQUEST "
            "MISSION_REQUEST_INT",
            self._parameter: "PARAM_REQUEST_LIST PARAM_REQUEST_READ PARAM_SET",
            self._set_rates: "REQUEST_DATA_STREAM",
            self._timesync: "TIMESYNC",
            self._handle_pose: "ODOMETRY VISION_POSITION_ESTIMATE VICON_POSITION_ESTIMATE "
            "ATT_POS_MOCAP GLOBAL_VISION_POSITION_ESTIMATE VISION_SPEED_ESTIMATE "
            "VISION_POSITION_DELTA",
        }
        self._handlers = {
            kind: handle for handle, kinds in by_handler.items() for kind in kinds.split()
        }

    def open(self) -> None:
        """Open the links; a `ValueError` if one cannot be."""
        if self._config.vision:
            ardupilot_dialect()  # 0.2 s, which the first message that needs it must not take
        for link in self._config.endpoints:
            try:
                self._links.open(link)
            except OSError as error:
                self._links.close()
                raise ValueError(f"endpoints: {link}: {error.strerror or error}") from None
        log = self._log.info
        log("system %d on %s", self._config.system_id, ", ".join(self._config.endpoints))

    def update(self, now: int, wall: float) -> None:
        """Send due messages, steer, and react to a lost link; `wall` is in real seconds."""
        config = self._config
        self._links.refill(wall)
        self._telemetry.update(now)
        self._missions.update(now)
        if config.vision:
            self._clocks.update(now)
            self._vision.update(now)
        self.flight.update(now)
        is_lost = self._links.quiet_for(wall) > config.link_timeout
        if is_lost and not self._is_lost and config.link_loss != "nothing":
            self.flight.lost(config.link_loss, now)
        self._is_lost = is_lost

    def finish(self) -> str:
        """Publish the last pose from outside; report and return how many there were.

        Returns:
            Sentence; empty without `vision`.
        """
        if not self._config.vision:
            return ""
        text = self._vision.summary()
        self._send_text(text, mav.MAV_SEVERITY_INFO)
        (self._log.warning if self._vision.refused else self._log.info)("%s", text)
        return text

    def close(self) -> None:
        """Close the links."""
        self._links.close()

    def _handle(self, peer: Peer, sender: Sender, message: Any) -> None:
        """Handle a message by its row in the table of messages."""
        target = getattr(message, "target_system", getattr(message, "target", 0))
        part = getattr(message, "target_component", 0)
        if target not in {0, self._config.system_id} or part not in {0, 1}:
            return
        now, kind = self._now(), message.get_type()
        kind = OF_ARDUPILOT.get(kind, kind)
        is_vehicle = not target and sender[1] == mav.MAV_COMP_ID_AUTOPILOT1
        row = TREATMENTS.get(kind)
        if row is None:
            self._refuse(kind, sender, "it is not known here")
        elif row.treatment == "refused" and not is_vehicle:
            self._refuse(kind, sender, row.words)
        elif is_vehicle and row.treatment == "judged":
            self._vision.refused["another vehicle"] += self._config.vision
            self._warn_once(
                "{} of system {}, component {} is another vehicle's".format(kind, *sender)
            )
        elif kind in self._handlers:
            self._handlers[kind](peer, sender, message, now)
        if answer := kind in ANSWERS and ANSWERS[kind](message, sender, now, self.vehicle):
            self._links.send_to(peer, answer)

    def _command(self, peer: Peer, sender: Sender, message: Any, now: int) -> None:
        result = self._telemetry.command(peer, message, now)
        if result is None:
            result = self.flight.command(message, now)
        self._send(mav.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def _offboard(self, _: Peer, sender: Sender, message: Any, now: int) -> None:
        try:
            self.flight.offboard(message, now)
        except ValueError as error:
            self._refuse(message.get_type(), sender, str(error))

    def _sticks(self, _: Peer, sender: Sender, message: Any, now: int) -> None:  # noqa: ARG002
        if reason := self.flight.move_sticks(message):
            self._refuse(message.get_type(), sender, reason)

    def _mission(self, _: Peer, sender: Sender, message: Any, now: int) -> None:
        if reason := self._missions.handle(sender, message, now):
            self._refuse(message.get_type(), sender, reason)

    def _parameter(self, _: Peer, sender: Sender, message: Any, now: int) -> None:  # noqa: ARG002
        if (warning := self._parameters.handle(message, sender)) is not None:
            self._refuse(message.get_type(), sender, warning)

    def _set_mode(self, _: Peer, sender: Sender, message: Any, now: int) -> None:
        mode = message.custom_mode
        if self.flight.set_custom_mode(mode, now) == mav.MAV_RESULT_UNSUPPORTED:
            self._refuse("SET_MODE", sender, f"custom_mode {mode:#x} is not supported")

    def _timesync(self, _: Peer, sender: Sender, message: Any, now: int) -> None:
        self._clocks.handle(sender, message, now)

    def _set_rates(self, peer: Peer, sender: Sender, message: Any, _: int) -> None:
        rate = message.req_message_rate if message.start_stop else 0
        if not self._telemetry.set_stream(peer, message.req_stream_id, rate):
            reason = f"stream {message.req_stream_id} has no messages here"
            self._refuse("REQUEST_DATA_STREAM", sender, reason)

    def _handle_pose(self, peer: Peer, sender: Sender, message: Any, now: int) -> None:
        """Publish a pose from outside as an estimate."""
        kind = message.get_type()
        if not self._config.vision:
            self._refuse(OF_ARDUPILOT.get(kind, kind), sender, "vision is false")
            return
        if kind in OF_ARDUPILOT and (message := peer.read_ardupilot(message)) is None:
            self._links.counts["pieces of garbage"] += 1
            return
        self._vision.handle(sender, message, now)

    def _refuse(self, kind: str, sender: Sender, reason: str) -> None:
        """Report why messages have no effect, once for each kind, sender and reason."""
        self._report_once("{} of {}/{} has no effect: {}".format(kind, *sender, reason))

    def _report_once(self, text: str) -> None:
        if self._is_new(text):
            self._report(text)

    def _is_new(self, text: str) -> bool:
        if text in self._sentences or len(self._sentences) >= MOST_SAID:
            return False
        self._sentences.add(text)
        return True

    def _warn_once(self, text: str) -> None:
        if self._is_new(text):
            self._log.warning("%s", text)

    def _report(self, text: str) -> None:
        self._log.warning("%s", text)
        self._send_text(text, mav.MAV_SEVERITY_WARNING)

    def _send_text(self, text: str, level: int) -> None:
        data = text.encode("ascii", "replace")
        parts = [data[start : start + 50] for start in range(0, len(data), 50)]
        self._text_number = self._text_number % 65535 + 1
        number = self._text_number if len(parts) > 1 else 0
        for index, part in enumerate(parts):
            self._send(mav.MAVLink_statustext_message(level, part, number, index))
