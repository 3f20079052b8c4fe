"""ROS 1, from Debian 12's own packages: roscpp, nodelets and rospy.

Every measurement has a graph of its own, a master on a free port and nodes, on the loopback and
with its files in a temporary directory; it ends with the block that opened it or with this process,
and fails if a node has not heard every ping. Queues are unbounded and TCP has no delay. In
``large`` a fresh copy of the array is made for each ping; between processes it is serialised as
well, and ``large-shared`` only leaves the first copy out. Within a process ``large-shared`` copies
nothing: the payload of the message, adapted by hand (``cpp/ros1_messages.hpp``), is a shared
pointer.

Freed memory is kept in all of them (`compiled.KEEP_MEMORY`): with glibc's defaults, roscpp and
rospy between processes take several times longer for large messages, in page faults.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.system import ALL_CASES, Case, Samples, System, free_port, in_processes
from bench.systems.children import Crew
from bench.systems.compiled import (
    KEEP_MEMORY,
    arguments,
    build,
    deadline_for,
    guarded,
    missing_compiler,
    read,
)

MASTER = Path("/usr/bin/rosmaster")

CLOSING = 10.0  # seconds for the other nodes to end after node 1


class Graph(Crew):
    """A master and its nodes. Made by `graph`."""

    def __init__(self, directory: Path) -> None:
        super().__init__()
        self.directory = directory
        self._port = free_port()
        self._uri = f"http://127.0.0.1:{self._port}"

    def start_master(self) -> None:
        """Start the master, and wait for its answer."""
        self.start([MASTER, "--core", "-p", str(self._port)])
        begin = time.perf_counter_ns()
        while True:
            self.check(begin, "answer of the master")
            with contextlib.suppress(OSError), xmlrpc.client.ServerProxy(self._uri) as master:
                master.getPid("/bench")
                return
            time.sleep(0.05)

    def start(self, command: Sequence[str | Path]) -> subprocess.Popen[bytes]:
        """Start a node, ended at the latest with the graph."""
        environment = {
            # Of this Python's packages Debian's is to see nothing.
            **{k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "ROS_"))},
            **KEEP_MEMORY,
            "ROS_MASTER_URI": self._uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_HOME": str(self.directory),
            "ROS_LOG_DIR": str(self.directory),
            "TMPDIR": str(self.directory),
        }
        words = guarded(command)
        return self.add(shlex.join(words), words, env=environment, stdin=subprocess.DEVNULL)

    def finish(
        self,
        first: subprocess.Popen[bytes],
        others: Sequence[subprocess.Popen[bytes]],
        deadline: float,
    ) -> None:
        """Wait for node 1, then for the others; raise `PeerError` if one fails or is late."""
        until = time.monotonic() + deadline
        while first.poll() is None:
            for process in others:
                # A listener that has heard all leaves a moment before node 1 does.
                if process.poll():
                    raise self.failure(process, f"ended with {process.returncode}")
            if time.monotonic() > until:
                raise self.failure(first, f"expected to end within {deadline:g} s")
            with contextlib.suppress(subprocess.TimeoutExpired):
                first.wait(0.05)
        until = time.monotonic() + CLOSING
        for process in (first, *others):
            try:
                code = process.wait(max(0.01, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                raise self.failure(process, "expected to end after the last ping") from None
            if code:
                raise self.failure(process, f"ended with {code}")


@contextlib.contextmanager
def graph() -> Iterator[Graph]:
    """Run a master, which ends with all nodes with the block; else raise `PeerError`."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as directory,
        Graph(Path(directory)) as made,
    ):
        made.start_master()
        yield made


PYTHON = Path("/usr/bin/python3")
PACKAGES = Path("/usr/lib/python3/dist-packages")
INCLUDE = Path("/usr/include")
LIBRARIES = ("roscpp", "rosconsole", "roscpp_serialization", "rostime", "boost_thread")


def measure_roscpp(case: Case) -> Samples:
    """Measure roscpp in a single process, with all callbacks in its only thread."""
    return _in_one_process([_program("roscpp.cpp"), "all"], case)


def measure_nodelets(case: Case) -> Samples:
    """Measure nodelets: each node a nodelet in nodeletlib's pool of worker threads.

    The pool is used directly, since Debian's loader of plug-ins is ROS 2's. A ping goes to a thread
    that hands out work and from there to a worker, a pong likewise: four changes of threads. From
    N = 3 on, workers run listeners side by side, so time does not grow with N as elsewhere.
    """
    return _in_one_process([_program("nodelets.cpp", "nodeletlib")], case)


def measure_roscpp_processes(case: Case) -> Samples:
    """Measure roscpp over TCP; each node is a process, with a thread of its own for its sockets."""
    return _in_processes([_program("roscpp.cpp")], case)


def measure_rospy_processes(case: Case) -> Samples:
    """Measure rospy over TCP, written by the publishing thread; payloads are arrays."""
    return _in_processes([PYTHON, "-P", Path(__file__).with_name("ros1_rospy.py")], case)


def _in_one_process(command: list[str | Path], case: Case) -> Samples:
    with graph() as ros:
        out = ros.directory / "samples"
        ros.finish(ros.start([*command, *arguments(case, out)]), [], deadline_for(case))
        return read(out, case)


def _in_processes(command: list[str | Path], case: Case) -> Samples:
    with graph() as ros:
        out = ros.directory / "samples"
        others = [ros.start([*command, "listen", str(n)]) for n in range(2, case.nodes + 1)]
        first = ros.start([*command, "ping", *arguments(case, out)])
        ros.finish(first, others, deadline_for(case))
        return read(out, case)


def _program(source: str, *libraries: str) -> Path:
    built_for = _version("libroscpp-dev")
    return build(source, (*libraries, *LIBRARIES), built_for)


def _version(package: str) -> str:
    query = ["dpkg-query", "-W", "-f", "${Version}", package]
    if shutil.which(query[0]) is None:
        return "?"
    return subprocess.run(query, capture_output=True, text=True, check=False).stdout or "?"


def _packaged(
    name: str, package: str, files: dict[str, Path], *, compiled: bool = True
) -> dict[str, Any]:
    """Return `missing` and `version` of a `System` made of Debian packages."""

    def missing() -> str | None:
        wanted = {"python3-rosmaster": MASTER, **files}
        absent = [package for package, path in wanted.items() if not path.exists()]
        if absent:
            return f"not installed; `make peers`, or `apt-get install {' '.join(absent)}`"
        return missing_compiler() if compiled else None

    return {"missing": missing, "version": lambda: f"{name} {_version(package)}"}


_ROSCPP = {"libroscpp-dev": INCLUDE / "ros/ros.h"}
_NODELET = {**_ROSCPP, "libnodeletlib-dev": INCLUDE / "nodelet/nodelet.h"}
_ROSPY = {"python3-rospy": PACKAGES / "rospy", "python3-numpy": PACKAGES / "numpy"}
_CPP = _packaged("roscpp", "libroscpp-dev", _ROSCPP)
_NODELETS = _packaged("nodelet", "libnodeletlib-dev", _NODELET)
_PYTHON = _packaged("rospy", "python3-rospy", _ROSPY, compiled=False)

SYSTEMS = (
    System("roscpp, one process", ("handler",), measure_roscpp, 1.5, **_CPP),
    System("ROS 1 nodelets", ("handler",), measure_nodelets, 50, **_NODELETS),
    in_processes(
        "roscpp, processes", ("handler",), measure_roscpp_processes, 100, ALL_CASES, **_CPP
    ),
    in_processes(
        "rospy, processes", ("handler",), measure_rospy_processes, 70, ALL_CASES, **_PYTHON
    ),
)
