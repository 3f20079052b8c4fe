"""Cases, the interface of every measured system, and shared code of the benchmarks.

The exchange is the thesis's: node 1 sends a ping (sender, receiver, number, time) that all N-1
other nodes hear; the last of them is its receiver and replies; the sample is the time at node 1
from just before the send to the arrival of the reply. Pings never overlap.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import socket
from collections.abc import Callable
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from events import Event

CaseName = Literal["small", "large", "large-shared"]
Mode = Literal["handler", "stream", "routed"]
Place = Literal["one process", "processes"]

ALL_CASES: tuple[CaseName, ...] = ("small", "large", "large-shared")
COPIED_CASES: tuple[CaseName, ...] = ("small", "large")  # of systems that pass nothing by reference

LARGE_SHAPE = (1080, 1080)  # of the large message: float32, 4.67 MB


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """Case to measure.

    Attributes:
        case: ``small``: no payload. ``large``: each ping carries a fresh copy of a float32 array of
            `LARGE_SHAPE`, made within the measured time. ``large-shared``: each ping carries the
            same array by reference, or whatever comes nearest in the system.
        mode: ``handler``: receivers are functions that are called. ``stream``: receivers are
            coroutines or threads that wait for the next message. ``routed``: the ping reaches its
            receiver only.
        nodes: N, sender included; at least 2.
    """

    case: CaseName = "small"
    mode: Mode = "handler"
    nodes: int = 2
    samples: int = 10_000
    warm_up: int = 1_000


Samples = npt.NDArray[np.int64]
"""Round trips in nanoseconds, shape (samples,), in order of measurement."""


class System(msgspec.Struct, frozen=True):
    """Messaging system to measure.

    Attributes:
        name: As in tables: ``asyncio.Queue (uvloop)``.
        measure: Measures a case; called in a fresh process of its own.
        slowness: About how many microseconds a round trip takes at N = 2; the driver shortens runs
            of slow systems by it.
        place: Whether its nodes share a process.
        max_nodes: Beyond this it is not measured: too slow, or too many processes for a laptop.
        missing: Returns why it cannot be measured here (with what installs it), or `None`.
        version: Returns what is measured, as ``library 1.2``.
    """

    name: str
    modes: tuple[Mode, ...]
    measure: Callable[[Case], Samples]
    slowness: float = 1.0
    cases: tuple[CaseName, ...] = ALL_CASES
    place: Place = "one process"
    max_nodes: int = 128
    missing: Callable[[], str | None] = lambda: None
    version: Callable[[], str] = lambda: ""


def in_processes(
    name: str,
    modes: tuple[Mode, ...],
    measure: Callable[[Case], Samples],
    slowness: float,
    cases: tuple[CaseName, ...] = COPIED_CASES,
    **options: Any,
) -> System:
    """Return a system whose nodes have processes of their own, by default 16 at most."""
    options = {"max_nodes": 16, **options}
    return System(name, modes, measure, slowness, cases, "processes", **options)


def large_array() -> npt.NDArray[np.float32]:
    """Return the payload array of large pings."""
    return np.arange(np.prod(LARGE_SHAPE), dtype=np.float32).reshape(LARGE_SHAPE)


class Ping(Event):
    """Message from node 1 to all nodes; `receiver` is the number of the node that is to reply."""

    receiver: int
    number: int
    payload: Any = None


class Pong(Event):
    """Reply of the receiver to node 1, with the ping's number."""

    number: int


def packaged(**packages: str) -> dict[str, Any]:
    """Return `missing` and `version` of a `System` made of packages, as for `needs`."""
    return {"missing": needs(**packages), "version": versions(*packages.values())}


def needs(**packages: str) -> Callable[[], str | None]:
    """Return a `System.missing` to ask for absent packages."""

    def missing() -> str | None:
        absent = [package for name, package in packages.items() if not _is_here(name)]
        if not absent:
            return None
        return f"not installed; `make peers`, or `pip install {' '.join(absent)}`"

    return missing


def versions(*packages: str) -> Callable[[], str]:
    """Return a `System.version` with the names and versions of packages."""

    def version() -> str:
        return ", ".join(f"{package} {importlib.metadata.version(package)}" for package in packages)

    return version


def payloads(case: Case) -> Callable[[], Any]:
    """Return a factory of ping payloads: nothing, a fresh copy, or the same array."""
    if case.case == "small":
        return lambda: None
    array = large_array()
    return array.copy if case.case == "large" else lambda: array


def _is_here(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def free_port() -> int:
    """Return a loopback TCP port, free at the time of the call."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def zenoh_session(**endpoints: str) -> Any:
    """Open the session of a Zenoh peer without scouting: only ``listen`` or ``connect``."""
    zenoh: Any = importlib.import_module("zenoh")
    made = zenoh.Config()
    made.insert_json5("mode", '"peer"')
    made.insert_json5("scouting/multicast/enabled", "false")
    made.insert_json5("scouting/gossip/enabled", "false")
    for way in ("listen", "connect"):
        made.insert_json5(f"{way}/endpoints", json.dumps([*filter(None, [endpoints.get(way)])]))
    return zenoh.open(made)


def zenoh_publisher(session: Any, key: str) -> Any:
    """Return an express publisher (no batching), blocking instead of dropping."""
    block = importlib.import_module("zenoh").CongestionControl.BLOCK
    return session.declare_publisher(key, express=True, congestion_control=block)


def zenoh_subscriber(session: Any, key: str, callback: Callable[[Any], None]) -> Any:
    """Return a subscriber whose callback runs where Zenoh delivers, with no thread between."""
    direct = importlib.import_module("zenoh").handlers.Callback(callback, indirect=False)
    return session.declare_subscriber(key, direct)
