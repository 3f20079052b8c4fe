"""ROS 1, from Debian 12's own packages: roscpp, nodelets and rospy.

Every measurement has a master of its own (`ros1_graph`), and fails if a node has not heard every
ping. Queues are unbounded and TCP has no delay. In ``large`` a fresh copy of the array is made for
each ping; between processes it is serialised as well, and ``large-shared`` only leaves the first
copy out. Within a process ``large-shared`` copies nothing: the payload of the message, adapted by
hand (``cpp/ros1_messages.hpp``), is a shared pointer.

Freed memory is kept in all of them (`compiled.KEEP_MEMORY`): with glibc's defaults, roscpp and
rospy between processes take several times longer for large messages, in page faults.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from bench.system import Case, Samples, System
from bench.systems.compiled import (
    Program,
    arguments,
    build,
    deadline_for,
    missing_compiler,
    read,
)
from bench.systems.ros1_graph import MASTER, graph

PYTHON = Path("/usr/bin/python3")
PACKAGES = Path("/usr/lib/python3/dist-packages")
INCLUDE = Path("/usr/include")
LIBRARIES = ("roscpp", "rosconsole", "roscpp_serialization", "rostime", "boost_thread")


def measure_roscpp(case: Case) -> Samples:
    """Measure roscpp in one process, where its one thread runs all callbacks."""
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
    """Measure rospy over TCP, written to by the thread that publishes; payloads are arrays."""
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
    """Return a compiled program; it is compiled anew for another version of roscpp."""
    built_for = _version("libroscpp-dev")
    return build(Program(source=source, libraries=(*libraries, *LIBRARIES), built_for=built_for))


def _version(package: str) -> str:
    query = ["dpkg-query", "-W", "-f", "${Version}", package]
    if shutil.which(query[0]) is None:
        return "?"
    return subprocess.run(query, capture_output=True, text=True, check=False).stdout or "?"


def _needs(*, compiler: bool, **packages: Path) -> Callable[[], str | None]:
    """Return a `System.missing` that looks for a file of each Debian package."""

    def missing() -> str | None:
        wanted = {"python3-rosmaster": MASTER}
        wanted |= {name.replace("_", "-"): path for name, path in packages.items()}
        absent = [name for name, path in wanted.items() if not path.exists()]
        if absent:
            return f"not installed; `make peers`, or `apt-get install {' '.join(absent)}`"
        return missing_compiler() if compiler else None

    return missing


_ROSCPP = {"libroscpp_dev": INCLUDE / "ros/ros.h"}
_NODELET = {"libnodeletlib_dev": INCLUDE / "nodelet/nodelet.h"}
_ROSPY = {"python3_rospy": PACKAGES / "rospy", "python3_numpy": PACKAGES / "numpy"}

SYSTEMS = (
    System(
        name="roscpp, one process",
        modes=("handler",),
        slowness=1.5,
        missing=_needs(compiler=True, **_ROSCPP),
        version=lambda: f"roscpp {_version('libroscpp-dev')}",
        measure=measure_roscpp,
    ),
    System(
        name="ROS 1 nodelets",
        modes=("handler",),
        slowness=50,
        missing=_needs(compiler=True, **_ROSCPP, **_NODELET),
        version=lambda: f"nodelet {_version('libnodeletlib-dev')}",
        measure=measure_nodelets,
    ),
    System(
        name="roscpp, processes",
        modes=("handler",),
        place="processes",
        max_nodes=16,
        slowness=100,
        missing=_needs(compiler=True, **_ROSCPP),
        version=lambda: f"roscpp {_version('libroscpp-dev')}",
        measure=measure_roscpp_processes,
    ),
    System(
        name="rospy, processes",
        modes=("handler",),
        place="processes",
        max_nodes=16,
        slowness=70,
        missing=_needs(compiler=False, **_ROSPY),
        version=lambda: f"rospy {_version('python3-rospy')}",
        measure=measure_rospy_processes,
    ),
)
