"""However one process of a run ends, all do, soon, and with the reason of the one that failed.

The table of signals, phases, processes and clocks is of processes indeed, and of 2 s of standing
still; the rest are threads.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from extensions.machines.tests.samples import Process, settings
from runtime.errors import VisnavError
from runtime.summary import Summary
from tests.runtime.ports import free_port
from visnav_machines.messages import AnyMessage, FirstUpdate, Message
from visnav_machines.peers import Peers

ROOT = Path(__file__).parents[3]
SOON = 15.0
"""Seconds within which all end, after whatever happened to one."""

FILE = """
[run]
name = "ends"
clock = "{clock}"
duration = "{duration}"
speed = 1.0
startup_limit = "4s"

[network]
meet = "tcp/127.0.0.1:{port}"
wait = "{wait}"

[[nodes]]
name = "asker"
type = "extensions.machines.tests.samples:Slow"
on_error = "{on_error}"

[[nodes]]
name = "one"
type = "extensions.machines.tests.samples:SlowAnswerer"
on_error = "{on_error}"
"""


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("when", ["on_startup", "announce", "on_announcement", "run"])
def test_what_fails_in_one_process_ends_both_with_its_reason(clock: str, when: str) -> None:
    config = settings(("asker", "Asker", {}), ("failer", "Failer", {"when": when}), clock=clock)
    here, there = Process(config, "asker"), Process(config, "failer")
    for process in (there, here):
        assert isinstance(process.done(SOON).error, VisnavError)
        assert f"wrong world in {when}" in str(process.error)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("who", ["asker", "one"])
def test_an_end_between_readiness_and_the_first_update_ends_both(
    clock: str, who: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them is told, or decides, that the run has begun, and ends before it does."""
    begin = Peers.begin

    async def begin_and_end(peers: Peers) -> None:
        if peers._membership.here == (who,):
            peers._stop("enough", ValueError("of this"))
        await begin(peers)

    monkeypatch.setattr(Peers, "begin", begin_and_end)
    config = settings(("asker", "Asker", {}), ("one", "Answerer", {}), clock=clock, duration=60)
    both = {name: Process(config, name) for name in ("asker", "one")}
    for name, process in both.items():
        assert "of this" in str(process.done(SOON).error), name


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_one_that_never_hears_that_the_run_has_begun_ends_all(
    clock: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others have begun, and go on without it in the turns until it has said why."""
    receive = Peers.receive

    def deaf(peers: Peers, member: object, message: AnyMessage, event: None) -> None:
        if isinstance(message, FirstUpdate) and peers._membership.here == ("one",):
            peers._stop("Ctrl-C")
        else:
            receive(peers, member, message, event)  # type: ignore[arg-type]

    monkeypatch.setattr(Peers, "receive", deaf)
    config = settings(
        ("asker", "Asker", {}),
        ("one", "Answerer", {}),
        ("other", "Answerer", {}),
        clock=clock,
        duration=60,
    )
    for process in [Process(config, only) for only in ("asker", "one", "other")]:
        assert process.done(SOON).error is None
        assert process.summary is not None
        assert process.summary.reason == "Ctrl-C"


@pytest.mark.slow
def test_the_end_goes_on_without_one_that_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if its loop stood still, while Zenoh's threads go on."""
    tell = Peers._broadcast_in_order
    monkeypatch.setattr("visnav_machines.joint.SILENCE", 1.0)

    def mute(peers: Peers, message: Message) -> None:
        if peers._membership.here != ("one",):
            tell(peers, message)  # type: ignore[arg-type]

    monkeypatch.setattr(Peers, "_broadcast_in_order", mute)
    config = settings(("asker", "Asker", {}), ("one", "Answerer", {}), clock="real", duration=0.2)
    both = [Process(config, only) for only in ("asker", "one")]
    for process in both:
        assert process.done(SOON).error is None


class Trial:
    """Two processes of one file, and what they print."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def write(self, clock: str, phase: str, on_error: str) -> None:
        duration = "0.3s" if phase == "shut-down" else "60s"
        text = FILE.format(
            clock=clock,
            duration=duration,
            on_error=on_error,
            port=free_port(),
            wait="2s" if phase == "waiting" else "40s",
        )
        (self.folder / "ends.toml").write_text(text, encoding="utf-8")

    def start(self, name: str) -> None:
        out, only = str(self.folder / name), ["--only", name]
        command = [sys.executable, "-m", "runtime", "run", str(self.folder / "ends.toml")]
        with (self.folder / f"{name}.txt").open("wb") as said:
            self.processes[name] = subprocess.Popen(
                [*command, *only, "--out", out, "--quiet", "--log", "debug"],
                cwd=ROOT,
                stdout=said,
                stderr=subprocess.STDOUT,
                env=os.environ | {"COLUMNS": "300"},
            )

    def said(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text(encoding="utf-8", errors="replace")

    def wait_for(self, name: str, text: str) -> None:
        end = time.monotonic() + 40
        while text not in self.said(name):
            assert time.monotonic() < end, self.said(name)
            assert self.processes[name].poll() is None, self.said(name)
            time.sleep(0.01)  # a file cannot be waited for

    def ended(self, name: str, begin: float) -> int:
        try:
            return self.processes[name].wait(max(begin + SOON - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            pytest.fail(f"{name} still runs after {SOON:g} s:\n{self.said(name)[-3000:]}")

    def check(self, name: str, code: int) -> Summary:
        """Check how a process that was not ended at once has ended, and return what is left."""
        said = self.said(name)
        assert code in {0, 2}, said
        assert "Traceback" not in said
        if code == 2:
            assert said.splitlines()[-1].startswith("error: "), said
        data = (self.folder / name / "summary.json").read_bytes()
        return msgspec.json.decode(data, type=Summary)


@pytest.fixture
def trial(tmp_path: Path) -> Iterator[Trial]:
    trial = Trial(tmp_path)
    yield trial
    for process in trial.processes.values():
        process.kill()
        process.wait()


SIGNS = {
    "waiting": "waiting for",
    "start-up": "phase start-up",
    "begin": "phase begin",
    "run": "phase run",
    "shut-down": "phase shut-down",
}
"""What is printed in a phase; in the first, one process alone waits for the other."""

SIGNALS = ["INT", "TERM", "KILL", "STOP", "INT twice"]
TRIALS = [
    (how, phase, who, clock)
    for (i, how), (j, phase) in itertools.product(enumerate(SIGNALS), enumerate(SIGNS))
    for who, clock in zip(
        ["asker", "one"], ["lockstep", "real"] if (i + j) % 2 else ["real", "lockstep"], strict=True
    )
]
"""Each signal in each phase, to either process, on one clock each: all triples are among them."""


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize(("how", "phase", "who", "clock"), TRIALS)
def test_a_signal_to_one_process_ends_all_soon(
    trial: Trial, how: str, phase: str, who: str, clock: str
) -> None:
    other = "one" if who == "asker" else "asker"
    trial.write(clock, phase, "stop")
    trial.start(who)
    if phase != "waiting":
        trial.start(other)
    trial.wait_for(who, SIGNS[phase])
    begin = time.monotonic()
    process = trial.processes[who]
    for _ in range(2 if how == "INT twice" else 1):
        process.send_signal(getattr(signal, f"SIG{how.split()[0]}"))
        time.sleep(0.05)  # two signals at once are one
    if how == "STOP":
        time.sleep(2)  # longer than Zenoh waits for it
        process.send_signal(signal.SIGCONT)
        if phase == "start-up":  # they meet again, and the run begins
            trial.wait_for(who, SIGNS["run"])
        if phase in {"start-up", "begin"}:
            process.send_signal(signal.SIGINT)
    if phase == "waiting":
        if how == "STOP":  # else it may still meet the other one, and they run for a minute
            trial.ended(who, begin)
        trial.start(other)
        trial.wait_for(other, SIGNS[phase])
        begin = time.monotonic()
    code, others = trial.ended(who, begin), trial.ended(other, begin)
    trial.check(other, others)
    if how in {"KILL", "INT twice"}:
        assert code in {0, 2, 130, -signal.SIGINT, -signal.SIGKILL}
    else:
        trial.check(who, code)
    if phase == "waiting":
        return
    if how == "KILL" and phase != "shut-down":
        assert others == 2
        assert f"{who}: their process is gone" in trial.said(other)
        if phase == "start-up":
            text = "expected its return within 4 s (run.startup_limit), found none"
            assert text in trial.said(other)
    if how in {"INT", "TERM"}:
        assert code == others == 0


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["lockstep", "real"])
@pytest.mark.parametrize("who", ["asker", "one"])
def test_who_waits_for_the_return_of_a_killed_process_can_be_ended(
    trial: Trial, who: str, clock: str
) -> None:
    other = "one" if who == "asker" else "asker"
    trial.write(clock, "run", "restart")
    trial.start("asker")
    trial.start("one")
    trial.wait_for("asker", "Answered")
    trial.processes[who].kill()
    trial.wait_for(other, "waiting for its return")
    begin = time.monotonic()
    trial.processes[other].send_signal(signal.SIGINT)
    assert trial.ended(other, begin) == 0
    assert trial.check(other, 0).reason == "Ctrl-C"
