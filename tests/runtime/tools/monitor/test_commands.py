"""The command line's end of the monitor, with runs in processes of their own."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.runtime.tools.samples_cli import ROOT, command_here, config_file, results, start, summary

pytestmark = pytest.mark.timeout(240)
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
LOOP = """
[[nodes]]
name = "drone"
type = "tests.runtime.samples_loop:Camera"
[[nodes]]
name = "vo"
type = "tests.runtime.samples_loop:Estimator"
[[nodes]]
name = "pilot"
type = "tests.runtime.samples_loop:Pilot"
"""


@contextmanager
def running(folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run a small loop at real speed until it is told to end."""
    path = config_file(folder, run="speed = 1.0", settings=LOOP)
    with start(["run", path, "-q", *options], folder) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)


@pytest.mark.slow
def test_a_parameter_is_set_from_another_terminal(tmp_path: Path, sockets: Path) -> None:
    with running(tmp_path) as process:
        _wait_for(sockets, process)
        done = command_here("set", "pilot.gain=2", folder=tmp_path)
        while "does not just now" in done.stderr:  # it listens before its nodes run
            done = command_here("set", "pilot.gain=2", folder=tmp_path)
        assert (done.returncode, done.stdout) == (0, "run sample: gain = 2.0\n"), done.stderr
        refused = command_here("set", "pilot.height=3", "--run", "sample", folder=tmp_path)
        assert refused.returncode == 2
        assert "error: pilot.height: cannot change while the run goes on" in refused.stderr
    log = (results(tmp_path) / "log.txt").read_text()
    assert "pilot.gain is now 2.0" in log
    assert summary(results(tmp_path))["reason"] == "Ctrl-C"
    assert list(sockets.iterdir()) == []
    gone = command_here("set", "pilot.gain=2", folder=tmp_path)
    assert gone.returncode == 2
    assert "error: expected a run to look at, found none" in gone.stderr


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_shows_a_run_in_a_browser(tmp_path: Path, sockets: Path) -> None:
    assert BROWSER is not None
    with running(tmp_path, "--web", "0", "--set", "run.duration=15") as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        shown = subprocess.run(
            [
                BROWSER,
                "--headless",
                "--no-sandbox",
                "--virtual-time-budget=2000",
                "--dump-dom",
                url,
            ],
            capture_output=True,
            text=True,
            timeout=100,
            check=True,
        ).stdout
    # The browser's virtual time waits for the stream, which ends with the run.
    assert re.search(
        r"<h1[^>]*>the run is over: duration \(last seen: sample   1[0-5]\.\d+ of", shown
    )
    assert re.search(r"<td[^>]*>drone.images</td><td[^>]*>Image</td><td[^>]*>\d+</td>", shown)
    assert 'value="pilot.gain=1.0"' in shown
    assert '<option value="drone.images: drone/front">' in shown
    image = re.search(r'<img [^>]*id="image"[^>]*>', shown)
    assert image is not None
    assert 'src="/image?token=' in image[0]  # and is not hidden, so it was loaded
    assert "hidden" not in image[0]


@pytest.mark.slow
def test_the_screen_and_the_run_share_a_terminal(tmp_path: Path, sockets: Path) -> None:
    path = config_file(tmp_path, run="speed = 1.0", settings=LOOP)
    terminal, inside = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 140, 0, 0))
    silent = termios.tcgetattr(inside)
    silent[3] &= ~termios.ECHO  # else keys that come too late stand amid the table
    termios.tcsetattr(inside, termios.TCSANOW, silent)
    shown = b""
    # Workers of tests have a size in their environment, which would count before the terminal's.
    environment = {k: v for k, v in os.environ.items() if k not in {"COLUMNS", "LINES"}}
    with subprocess.Popen(
        [sys.executable, "-m", "runtime", "run", str(path), "--top"],
        cwd=tmp_path,
        env=environment | {"PYTHONPATH": str(ROOT)},
        stdin=inside,
        stdout=inside,
        stderr=inside,
        start_new_session=True,
    ) as process:
        os.close(inside)
        try:
            while True:
                # A key that comes while the terminal changes its mode is lost, and a screen on
                # which nothing changes writes nothing: so keys come in any case.
                if select.select([terminal], [], [], 0.5)[0]:
                    if not (piece := os.read(terminal, 65536)):
                        break
                    shown += piece
                if b"drone" in shown and b"\x1b[?1049l" not in shown:
                    os.write(terminal, b"x")  # twice at least, and no harm in more
        except OSError:  # how a terminal says that nobody is there any more
            pass
        except BaseException:  # this took too long
            process.kill()
            raise
    os.close(terminal)
    assert process.returncode == 0
    assert b"ended by: stopped by hand" in b" ".join(shown.split())  # wherever lines end
    assert summary(results(tmp_path))["reason"] == "stopped by hand"


@pytest.mark.slow
def test_a_trace_is_written_and_read(tmp_path: Path, sockets: Path) -> None:
    path = config_file(tmp_path, run="duration = 1", settings=LOOP)
    done = command_here("run", path, "-q", "--trace", "t.json.gz", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    told = command_here("trace", "t.json.gz", folder=tmp_path)
    assert "path 1: drone/front Image → vo PoseEstimate → pilot VelocitySetpoint" in told.stdout
    assert re.search(r"│ 1 +│ +10 │ +30.00 │ +30.00 │ +30.00 │", told.stdout)
    refused = command_here("trace", path, folder=tmp_path)
    assert refused.returncode == 2
    assert "sample.toml: expected a trace, found:" in refused.stderr


def _wait_for(sockets: Path, process: subprocess.Popen[str]) -> None:
    for _ in range(1000):
        if sockets.exists() and list(sockets.glob("*.sock")):
            return
        assert process.poll() is None
        time.sleep(0.05)  # another process is starting
    raise AssertionError("expected a run that listens")


@pytest.mark.slow
def test_a_screen_needs_a_terminal_that_can_show_it(tmp_path: Path, sockets: Path) -> None:
    with running(tmp_path) as process:
        _wait_for(sockets, process)
        done = command_here("top", folder=tmp_path)
        assert done.returncode == 2
        assert "error: expected a terminal, found none" in done.stderr
        terminal, inside = pty.openpty()
        try:
            refused = subprocess.run(
                [sys.executable, "-m", "runtime", "top"],
                cwd=tmp_path,
                env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "latin-1"},
                stdin=inside,
                stdout=inside,
                stderr=inside,
                start_new_session=True,
                timeout=60,
                check=False,
            )
            assert refused.returncode == 2
            assert b"expected a terminal in UTF-8, found " in os.read(terminal, 65536)
        finally:
            os.close(terminal)
            os.close(inside)
