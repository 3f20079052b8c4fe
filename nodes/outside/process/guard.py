"""Guard between the run and a program, to end the program with all its processes.

    python -I -S guard.py SOCKET GRACE PROCESSORS WORD…

The exit code of the program goes to the socket, a line. When the run closes its end, or is gone
however it went, the program gets SIGTERM; what is left after GRACE seconds is killed, wherever it
went, for orphans become children of this process. PROCESSORS are the numbers of those that may be
used, as in ``0,2``; all if empty. It imports nothing of ours.
"""

import contextlib
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""prctl(2) options: signal on the parent's death; adoption of orphaned processes."""


def main(control: socket.socket, grace: float, command: list[str]) -> None:
    """Run a command until its end, or until `control` is closed; then end all other processes."""
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_CHILD_SUBREAPER, 1)
    try:
        child = subprocess.Popen(  # noqa: S603  # what the user's file says
            command,
            process_group=0,
            preexec_fn=lambda: prctl(PR_SET_PDEATHSIG, signal.SIGKILL),
        )
    except OSError as error:
        control.sendall(f"cannot be started: {error.strerror}\n".encode())
        return
    program = child.pid  # `child` stays to the end: without it, Python would wait for the program
    ends = select.poll()
    ends.register(os.pidfd_open(program), select.POLLIN)
    ends.register(control, select.POLLIN)
    ends.poll()
    try:  # its number is not reused yet, as it was not waited for
        os.killpg(program, signal.SIGTERM)
    except OSError:  # it has gone into another group
        os.kill(program, signal.SIGTERM)
    end_orphans(signal.SIGTERM, program)
    until = time.monotonic() + grace
    while True:
        try:
            ended, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if ended == program:
            with contextlib.suppress(OSError):  # the run is gone
                control.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
        elif not ended:
            if time.monotonic() >= until:
                end_orphans(signal.SIGKILL)
            time.sleep(0.01)


def end_orphans(number: int, but: int = 0) -> None:
    """Send a signal to the children of this process."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_bytes().rpartition(b")")[2].split()[1])
            if parent == os.getpid() and stat.parent.name != str(but):
                os.kill(int(stat.parent.name), number)


if __name__ == "__main__":
    number, seconds, processors, *words = sys.argv[1:]
    if processors:
        os.sched_setaffinity(0, map(int, processors.split(",")))
    os.set_inheritable(int(number), False)
    main(socket.socket(fileno=int(number)), float(seconds), words)
