"""The other side's own meters: pymavlink counts what is lost; MAVProxy shows all it knows."""

from __future__ import annotations

import contextlib
import math
import queue
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink import mavutil

from extensions.mavlink.tests.flights import calling, flown, free_udp_port, running
from tests.runtime.tools.samples_cli import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

MAVPROXY = ROOT / ".venv-mavproxy" / "bin" / "mavproxy.py"


def receive(address: str) -> None:
    """Listen for 1000 messages, of which one comes as often as any can; print the losses."""
    link = mavutil.mavlink_connection(address, dialect="common")
    link.wait_heartbeat(timeout=60)
    mav = mavutil.mavlink
    odometry, zeros = mav.MAVLINK_MSG_ID_ODOMETRY, (0, 0, 0, 0, 0)
    link.mav.command_long_send(1, 1, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, odometry, 10_000, *zeros)
    kinds: dict[str, int] = {}
    while sum(kinds.values()) < 1000:
        message = link.recv_match(blocking=True, timeout=10)
        assert message is not None
        kinds[message.get_type()] = kinds.get(message.get_type(), 0) + 1
    print(f"{link.mav_loss} lost of {link.mav_count}, {kinds['ODOMETRY']} of ODOMETRY")
    link.close()


def test_pymavlinks_meter_shows_no_losses(tmp_path: Path) -> None:
    port = free_udp_port()
    script = calling("test_meters", "receive", f"udpin:127.0.0.1:{port}", plain=True)
    printed, _ = flown(tmp_path, port, *script)
    lost, heard, odometry = map(int, re.findall(r"\d+", printed))
    assert lost <= 0.001 * heard
    assert odometry > 300


MISSION = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.397742\t8.545594\t488.0\t1
1\t0\t3\t22\t0\t0\t0\t0\t47.397742\t8.545594\t5.0\t1
2\t0\t3\t16\t0\t0\t0\t0\t47.397802\t8.545594\t5.0\t1
"""


class Station:
    """MAVProxy, by what one types, and by what it prints."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)

    def type(self, words: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()

    def wait_for(self, pattern: str, *, again: str = "", seconds: float = 60.0) -> re.Match[str]:
        """Return the match in the next line that has one; type words each second until then."""
        end, printed, typed = time.monotonic() + seconds, "", -math.inf
        while time.monotonic() < end:
            if again and time.monotonic() - typed > 1.0:
                typed = time.monotonic()
                self.type(again)
            with contextlib.suppress(queue.Empty):
                line = self._lines.get(timeout=0.5)
                printed += line
                if match := re.search(pattern, line):
                    return match
        raise AssertionError(f"expected {pattern!r}, found {printed}")


@contextlib.contextmanager
def station(folder: Path, port: int) -> Iterator[Station]:
    words = [
        str(MAVPROXY),
        f"--master=udpin:127.0.0.1:{port}",
        f"--state-basedir={folder}",
        "--default-modules=link,param,wp,fence,mode,arm",
    ]
    with subprocess.Popen(
        words,
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
        env={"PYTHONUNBUFFERED": "1", "HOME": str(folder), "PATH": "/usr/bin:/bin"},
    ) as process:
        try:
            yield Station(process)
        finally:
            process.kill()


@pytest.mark.skipif(not MAVPROXY.exists(), reason="needs MAVProxy: make mavproxy")
def test_mavproxy_has_parameters_missions_fences_and_a_whole_link(tmp_path: Path) -> None:
    port, folder = free_udp_port(), tmp_path / "station"
    folder.mkdir()
    (folder / "mission.txt").write_text(MISSION, encoding="utf-8")
    with running(tmp_path / "run", port), station(folder, port) as shell:
        shell.wait_for(r"Detected vehicle 1:1")
        shell.wait_for(r"Received 3 parameters")
        shell.type("param show MPC_XY_CRUISE")
        shell.wait_for(r"MPC_XY_CRUISE +2\.0")
        shell.type("param set MPC_XY_CRUISE 3")
        shell.wait_for(r"MPC_XY_CRUISE +3\.0", again="param show MPC_XY_CRUISE")
        shell.type("wp load mission.txt")
        shell.wait_for(r"TYPE_MISSION: ACCEPTED")
        shell.type("wp list")
        shell.wait_for(r"^16 3 47\.397802\d* 8\.545594\d* 5\.0")
        shell.type("fence list")
        shell.wait_for(r"Requesting 0 fence items")
        shell.type("arm throttle")
        shell.wait_for(r"COMPONENT_ARM_DISARM: ACCEPTED")
        loss = shell.wait_for(r"link 1 OK \((\d{4,}) packets.* (\d+) lost", again="link")
        assert int(loss[2]) <= 0.001 * int(loss[1])
