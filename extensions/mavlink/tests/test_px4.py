"""PX4 in the loop, against a counterpart of its side: it starts, answers, dawdles, and goes."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pymavlink.dialects.v20 import common as mav

import visnav
from events import Odometry
from runtime import Node, on
from runtime.errors import VisnavError
from visnav_mavlink.links import Wire

HOVER = 0.62
"""Of full thrust at which the vehicle climbs, straight up: there is no wind."""


class Counterpart(threading.Thread):
    """As PX4's simulator client: silent for some samples, then one answer for each.

    Args:
        silent: Samples before its first answer.
        goes: Answers after which it is gone; never if 0.
    """

    def __init__(self, port: int, silent: int = 20, goes: int = 0) -> None:
        super().__init__(daemon=True)
        self._port, self._silent, self._goes = port, silent, goes
        self.heard: list[Any] = []
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self._serve()
        except OSError as error:  # the run has ended
            self.error = error

    def _serve(self) -> None:
        parser = mav.MAVLink(None, 1, 1)
        while True:
            try:
                end = socket.create_connection(("127.0.0.1", self._port))
                break
            except ConnectionRefusedError:
                time.sleep(0.05)
        answers = 0
        with end:
            while data := end.recv(65536):
                for message in parser.parse_buffer(data) or ():
                    self.heard.append(message)
                    if message.get_type() != "HIL_SENSOR" or len(self.heard) < self._silent:
                        continue
                    if answers % 100 == 99:
                        time.sleep(0.02)  # longer than a period: time has to wait
                    armed = 128 if answers > 50 else 0
                    controls = [HOVER] * 4 + [0.0] * 12
                    answer = mav.MAVLink_hil_actuator_controls_message(
                        message.time_usec, controls, armed, 1
                    )
                    end.sendall(answer.pack(parser))
                    answers += 1
                    if answers == self._goes:
                        return


class Heights(Node):
    """Notes how high the vehicle is, metres."""

    heights: ClassVar[list[float]] = []

    @on(Odometry)
    def odometry(self, event: Odometry) -> None:
        self.heights.append(-event.position[2])


@pytest.fixture
def flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Flies with a counterpart; returns it, and the run."""
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

    def fly(goes: int = 0) -> tuple[Counterpart, visnav.Run]:
        table = {
            "run": {"name": "px4", "duration": "2s"},
            "nodes": [
                {
                    "name": "drone", "type": "Multirotor", "world": "hall", "imu_rate": 250,
                    "barometer": {}, "magnetometer": {}, "gnss": {},
                },
                {"name": "heights", "type": Heights},
                {"name": "px4", "type": "Px4", "port": port, "start": "20s", "answer": "5s"},
            ],
        }  # fmt: skip
        counterpart = Counterpart(port, goes=goes)
        counterpart.start()
        return counterpart, visnav.run(table, quiet=True)

    return fly


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_its_motors_lift_the_vehicle_and_no_sample_is_missed(flown: Callable[..., Any]) -> None:
    Heights.heights.clear()
    px4, run = flown()
    stamps = [message.time_usec for message in px4.heard if message.get_type() == "HIL_SENSOR"]
    assert {b - a for a, b in itertools.pairwise(stamps)} == {4000}
    assert len(stamps) >= 498
    assert "px4" in run.summary["not_deterministic"]
    assert Heights.heights[-1] > Heights.heights[0] + 0.3
    measured = next(message for message in px4.heard if message.fields_updated & 0b1000000000)
    assert measured.zacc == pytest.approx(-9.81, abs=0.5)
    assert 900 < measured.abs_pressure < 1100
    fixes = {message.fix_type for message in px4.heard if message.get_type() == "HIL_GPS"}
    assert fixes == {1}  # no fix yet, two seconds after the start


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_one_that_goes_ends_the_run_with_a_reason(flown: Callable[..., Any]) -> None:
    with pytest.raises(VisnavError, match="PX4 has gone after 100 answers"):
        flown(goes=100)


def test_one_that_never_comes_is_named() -> None:
    wire = Wire("127.0.0.1", 0)
    with pytest.raises(TimeoutError, match=r"expected PX4 to connect, waited 0 s"):
        wire.accept(0.0)
    wire.close()
