"""Runs whose program is killed at a random frame, and all that must hold then.

``VISNAV_KILL_SEED`` repeats a choice; a test that fails prints it.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

from events import Image
from nodes.data.mcap.mcap_file import contents
from nodes.data.replay.bags import Recorded
from nodes.trajectory_files import read_tum
from runtime import Node, NodeConfig, on
from tests.nodes.outside.process.rig import ROOT
from tests.nodes.outside.process.test_program import gone_soon

SIGNALS = (signal.SIGKILL, signal.SIGSEGV)


class KillerConfig(NodeConfig):
    """Settings of a killer.

    Attributes:
        victim: What the path of the program, or of its library, ends with.
        source: Camera whose images are counted.
        frame: Image on whose arrival the program is killed: 0, 1, 2, …
        signal: That it is sent.
    """

    victim: str
    source: str
    frame: int
    signal: int


class Killer(Node[KillerConfig]):
    """Kills a program of its own run while that is at work."""

    seen = 0

    @on(Image)
    def images(self, event: Image) -> None:
        """Kill it at its frame."""
        if event.source != self.config.source:
            return
        if self.seen == self.config.frame:
            pids = [pid for pid in below(os.getpid()) if runs(pid, self.config.victim)]
            self.log.info("kill %s at frame %d", pids, self.seen)
            os.kill(pids[-1], self.config.signal)  # its guard has its name, too, and is before it
        self.seen += 1


def below(pid: int) -> list[int]:
    """Return a process's descendants, each after its parent."""
    pids = [pid]
    for process in pids:
        for thread in Path(f"/proc/{process}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                pids += map(int, thread.read_text("ascii").split())
    return pids[1:]


def runs(pid: int, victim: str) -> bool:
    """Tell whether a process was started as a program, or has loaded a library."""
    process = Path(f"/proc/{pid}")
    words = (process / "cmdline").read_text().split("\0")
    loaded = f"{victim}\n" in (process / "maps").read_text()
    return loaded or any(word.endswith(victim) for word in words)


def kill(
    text: str, victim: str, node: str, number: signal.Signals, out: Path, *changes: str
) -> None:
    """Fly a configuration, kill a program of it, and check what is left of the run.

    Args:
        text: Its TOML: with a stereo rig ``eye``, or a ``camera``, on a ``drone``.
        victim: What the path of the program, or of its library, ends with.
        node: That the error must name.
        changes: As after ``--set``.
    """
    seed = int(os.environ.get("VISNAV_KILL_SEED", "") or random.SystemRandom().randrange(10**6))
    frame = random.Random(seed).randrange(150)
    print(f"VISNAV_KILL_SEED={seed}: {number.name} at frame {frame}")
    eye = "drone/eye_left" if 'name = "eye"' in text else "drone/camera"
    start, nodes, rest = text.partition("[[nodes]]\n")
    recorder = f'{nodes}name = "recorder"\ntype = "McapRecorder"\n\n'
    killer = (
        f'\n{nodes}name = "killer"\ntype = "{Killer.__module__}:Killer"\nvictim = "{victim}"\n'
        f'source = "{eye}"\nframe = {frame}\nsignal = {number}\n'
    )
    out.mkdir(parents=True)
    path = out / "run.toml"
    path.write_text(start + recorder + nodes + rest + killer)
    words = [sys.executable, "-m", "runtime", "run", str(path), "--out", str(out / "run")]
    changes = ("run.startup_limit=300s", "run.duration=15s", *changes)
    settings = [word for change in changes for word in ("--set", change)]
    done = subprocess.run([*words, *settings], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2, done.stdout + done.stderr

    (line,) = re.findall(r"^error: .*", done.stderr, re.MULTILINE)
    assert line.startswith(f"error: {node}: ")
    assert f"killed by signal {number.value} (" in line
    assert "Traceback" not in done.stdout + done.stderr
    run = out / "run"
    log = (run / "log.txt").read_text()
    (killed,) = re.findall(r"kill \[(.*)\] at frame", log)
    assert all(gone_soon(int(pid)) for pid in killed.split(", "))

    # Nothing is lost: each event that was sent up to then is in the recording, which was closed.
    summary = json.loads((run / "summary.json").read_text())
    assert summary["error"].splitlines()[0] == line.removeprefix("error: ")
    assert not any(summary["drops"].values())
    recording = run / "recording.mcap"
    assert contents(recording).complete
    reader = Recorded(recording)
    recorded = Counter(
        type(timed.event).__name__ for timed in reader.events(0, None, lambda _, __: True)
    )
    assert reader.trouble == []
    assert recorded == summary["events"]
    assert recorded["Odometry"] > 0
    truth = read_tum(run / "trajectories" / "truth.tum")
    assert len(truth.stamps) == recorded["Odometry"]
