"""A run as a separate process: started, waited for or interrupted, and read.

What it prints goes to ``output.txt`` in the run's folder.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec

from runtime.channels.wire import combined
from runtime.run.made_from import during, made_from
from runtime.run.results import clear
from runtime.summary import Verdict
from runtime.tools.sweep.plan import Job
from runtime.tools.sweep.tables import Row, crashed

_STOPPED = {"Ctrl-C", "SIGTERM", "SIGHUP"}
"""Reasons of a run ended from outside; see `runtime.run.execute`."""

_LONGEST_ERROR = 300

LIFELINE = "VISNAV_LIFELINE"
"""Environment variable of a run: number of a pipe at whose other end its sweep is."""


class Ended(msgspec.Struct, frozen=True):
    """Fields of a run's ``summary.json`` read by a sweep or a comparison."""

    reason: str
    sim_seconds: float
    wall_seconds: float
    seed: int = 0
    error: str | None = None
    digest: str | None = None
    digests: dict[str, str] = {}
    name: str = ""
    inputs: dict[str, str] = {}
    inputs_digest: str | None = None
    not_deterministic: list[str] = []
    verdict: Verdict | None = None
    workers: dict[str, dict[str, float | None]] = {}


def run_job(job: Job) -> Row:
    """Run a job and wait for its end; may be sent to another process or machine.

    An exception here, KeyboardInterrupt above all, ends the run in order first.
    """
    return Children().run(job)


class Children:
    """Processes of runs, from any number of threads; can be ended together."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a signal may interrupt an interruption
        self._running: set[subprocess.Popen[bytes]] = set()
        self.ending = False  # whether they were interrupted

    def __len__(self) -> int:
        return len(self._running)

    def run(self, job: Job) -> Row:
        """Run a job and wait for its end; note what it was made from, and what of it changed."""
        before = made_from(job.roots)
        row = self._run(job)
        row["parts"], edited = during(before, made_from(job.roots))
        if edited:
            row["edited"] = edited
        return row

    def _run(self, job: Job) -> Row:
        out = Path(job.out)
        clear(out)
        settings = out / "config.toml"
        settings.write_text(job.text, encoding="utf-8")
        command = [sys.executable, "-m", "runtime", "run", str(settings)]
        if job.flight:
            command += ["--flight", "record" if job.record else "use"]
        paths = [os.environ.get("PYTHONPATH", ""), job.folder]
        start = time.monotonic()
        lifeline, own_end = os.pipe()  # whose other end the kernel closes, however we end
        with (
            (out / "output.txt").open("wb") as output,
            os.fdopen(lifeline),
            os.fdopen(own_end, "w"),
        ):
            with self._lock:
                if self.ending:
                    return crashed(job, "not started")
                child = subprocess.Popen(  # noqa: S603
                    [*command, "--out", str(out), "--quiet"],
                    env={
                        **os.environ,
                        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
                        LIFELINE: str(lifeline),
                    },
                    pass_fds=(lifeline,),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    # A terminal's Ctrl-C would reach it as well as us, and twice means at once.
                    start_new_session=True,
                )
                self._running.add(child)
            try:
                code = child.wait(job.limit)
            except subprocess.TimeoutExpired:
                kill_tree(child.pid)
                row = crashed(job, f"timed out after {job.limit:g} s")
                row["exit_code"] = child.wait()
                row["wall_seconds"] = round(time.monotonic() - start, 6)
                return row
            except BaseException:
                child.send_signal(signal.SIGINT)
                child.wait()
                raise
            finally:
                with self._lock:
                    self._running.discard(child)
        return read_results(job, code, time.monotonic() - start)

    def interrupt(self) -> None:
        """Interrupt all running processes, and start no more; called again, kill them."""
        with self._lock:
            for child in self._running:
                if not self.ending:
                    child.send_signal(signal.SIGINT)
                elif child.poll() is None:
                    kill_tree(child.pid)  # a second SIGINT may fall together with the first
            self.ending = True

    def usage(self) -> tuple[int, float]:
        """Return how many processes the runs have, and their own memory (GB)."""
        sessions = {child.pid for child in [*self._running]}
        count, pages = 0, 0
        for number, (_, session) in _processes().items() if sessions else ():
            with contextlib.suppress(OSError):  # it may just have ended
                if session in sessions:
                    statm = Path(f"/proc/{number}/statm").read_text(encoding="ascii")
                    _, resident, shared, *_ = statm.split()
                    count, pages = count + 1, pages + int(resident) - int(shared)
        return count, pages * os.sysconf("SC_PAGE_SIZE") / 1e9


def end_with_the_sweep() -> None:
    """End a sweep's run at once, with all its children, when the sweep is gone."""
    lifeline = os.environ.pop(LIFELINE, None)
    if lifeline is None:
        return
    os.set_inheritable(int(lifeline), False)

    def watch() -> None:
        os.read(int(lifeline), 1)
        kill_tree(os.getpid())

    threading.Thread(target=watch, name="sweep", daemon=True).start()


def kill_tree(run: int) -> None:
    """Kill a run, the leader of a session, and its descendants in any process group."""
    with contextlib.suppress(ProcessLookupError):
        if run != os.getpid():
            os.kill(run, signal.SIGSTOP)  # or it might start more
        for _ in range(2):  # again, for what these have started meanwhile
            processes, tree = _processes(), {run}
            while more := {
                number
                for number, (parent, session) in processes.items()
                if (parent in tree or session == run) and number not in tree
            }:
                tree |= more
            for number in tree - {run}:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
        os.kill(run, signal.SIGKILL)


def _processes() -> dict[int, tuple[int, int]]:
    """Return the parent and the session of all processes, by number."""
    processes = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it may just have ended
            _, parent, _, session, *_ = stat.read_bytes().rpartition(b")")[2].split()
            processes[int(stat.parent.name)] = int(parent), int(session)
    return processes


def read_results(job: Job, code: int, wall_seconds: float) -> Row:
    """Return the row of an ended process.

    Args:
        code: Its exit code: 0, or 1 if it missed a threshold; all else is a crash, and so is
            a 1 without a verdict, which is what Python ends with after an exception.
        wall_seconds: How long it took.
    """
    out = Path(job.out)
    row = crashed(job, "")
    row["exit_code"], row["wall_seconds"] = code, round(wall_seconds, 6)
    ended, unread = None, ""
    try:
        ended = msgspec.json.decode((out / "summary.json").read_bytes(), type=Ended)
    except OSError as error:
        unread = f"expected a summary.json, found: {error.strerror}"
    except msgspec.MsgspecError as error:
        unread = f"summary.json: {error}"
    verdict = ended and ended.verdict
    if code < 0:
        row["error"] = f"ended by {signal.Signals(-code).name}"
    elif code and not (code == 1 and verdict and verdict.passed is False):
        text = (out / "output.txt").read_text(encoding="utf-8", errors="replace")
        row["error"] = _same_everywhere(last_error(text), job) or f"exit code {code}"
    else:
        row["error"] = unread
    if ended is not None:
        row["sim_seconds"], row["run_seconds"] = ended.sim_seconds, ended.wall_seconds
        row["workers"] = ended.workers
        add_inputs(row, ended)
        row["digest"] = None if ended.not_deterministic else ended.digest
        if ended.reason in _STOPPED:
            row["error"] = f"interrupted by {ended.reason}"
    if verdict and not row["error"]:
        assert ended is not None
        row["passed"], row["estimators"] = verdict.passed, verdict.estimators
        row["flights"] = verdict.flights
        row["digests"] = {
            name: combined(outputs)
            for name in verdict.estimators
            if (outputs := _outputs_of(name.partition("/")[0], ended.digests))
        }
    return row


def add_inputs(row: Row, ended: Ended) -> None:
    """Add the fingerprints of the estimators' inputs to a row, if known."""
    row["name"] = ended.name
    if ended.inputs_digest is not None:
        row["inputs"] = ended.inputs


def _outputs_of(node: str, digests: dict[str, str]) -> dict[str, str]:
    return {name: digest for name, digest in digests.items() if name.partition(".")[0] == node}


def last_error(output: str) -> str:
    """Return the last error line of a run's output, or else the last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    error = (errors or lines or [""])[-1].removeprefix("error: ")
    return error.removesuffix("; its last output:")  # which follows in lines of its own


def _same_everywhere(error: str, job: Job) -> str:
    error = error.replace(job.out, f"runs/{job.id}")
    return re.sub(r"\b0x[0-9a-f]{6,}", "0x…", error)[:_LONGEST_ERROR]
