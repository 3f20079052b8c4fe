"""Flights flown once and used by many runs: what their nodes' workers have answered.

What a flight costs is rendering and scanning, which its nodes have done by workers. So a flight is
recorded as the answers of these. In a run that uses it, all nodes run as ever, and the workers of
those that fly give the recorded answers, without any process. Simulated time waits for either: the
same events come at the same times in the same order, to the byte.

Flights are kept by their content, in ``~/.cache/visnav-runtime/flights``. ``VISNAV_FLIGHTS_GB``
says how much they may take (20 if it does not); of more, those that were not used for longest are
removed. A flight is written by one process at a time, and as a whole. Its name is made of all that
it depends on: settings, what it is made from (`runtime.run.made_from`), machine. Its file:

    answers      each pickled: the result, or else the error
    calls        by worker, names of methods and places of the answers, in the order of the calls
    u64 LE       where these begin
    16 bytes     XXH3 hash of all before
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import fcntl
import functools
import json
import logging
import mmap
import os
import pickle
import re
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec
import xxhash

from runtime.config.model import Config, NodeSpec, to_builtins
from runtime.errors import VisnavError, WorkerError
from runtime.node import Node, NodeConfig
from runtime.paths import written
from runtime.run.execute import Watch, execute
from runtime.run.graph import edges_of
from runtime.run.instruments import Instrument
from runtime.run.made_from import RUN, key_of, made_from, roots_of
from runtime.run.sources import hashed
from runtime.run.summarise import environment
from runtime.run.supervisor import Supervisor
from runtime.workers.worker import Worker

_LOG = logging.getLogger("visnav.flights")

LIMIT = 20.0  # gigabytes, unless ``VISNAV_FLIGHTS_GB`` says otherwise

Calls = dict[str, list[tuple[str, int]]]
"""By worker, the method and the place of the answer of each call; -1 for an answer that is none."""

_BEGIN = struct.Struct("<Q")
_CHECKSUM = 16
_FINAL_PAUSE = 10.0  # seconds of the clock after a flight's end, without ticks, for pending answers
_DONE: concurrent.futures.Future[None] = concurrent.futures.Future()
_DONE.set_result(None)


class StoredFlight(NamedTuple):
    """A stored flight: its file, size (bytes), and time of last use (s)."""

    path: Path
    size: int
    used: float


def recorded(config: Config, *, record: bool) -> Watch | None:
    """Return a `watch` for `execute` that has a file's flying nodes use their recorded flight.

    It is `None` if the run itself has to fly. With `record`, a flight that is not kept is flown.
    """
    part = flight_of(config)
    if part is None:
        return None
    path = home() / f"{content_key(part)}.flight"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for file in (path, _unfinished(path)):
            if file.exists() and not file.is_file():
                raise OSError(errno.EEXIST, "what is no file", str(file))
        with _locked(path):  # a second process waits for the first one's file
            opened = _read(path)
            if opened is None and record:
                _write(part, path)
                opened = _read(path)
            if opened is None:
                return None
            os.utime(path)
    except OSError as error:
        problem = f"{error.filename or home()}: {error.strerror}"
        _LOG.warning("expected a cache of flights, found %s: the run flies itself", problem)
        return None
    return functools.partial(_replaying, *opened)


def home() -> Path:
    """Return the folder of all flights."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "visnav-runtime" / "flights"


def stored() -> list[StoredFlight]:
    """Return the stored flights, the last used first."""
    flights = []
    for path in home().glob("[!.]*.flight"):
        with contextlib.suppress(OSError):  # removed meanwhile
            if path.is_file():
                flights.append(StoredFlight(path, path.stat().st_size, path.stat().st_mtime))
    return sorted(flights, key=lambda flight: -flight.used)


def remove_beyond(gigabytes: float) -> list[StoredFlight]:
    """Remove the least recently used flights beyond `gigabytes`, and return them.

    What a run has open stays there for it. One that is being flown just now is left alone.
    """
    for unfinished in home().glob(".*.new"):  # left by a process that was killed, unless locked
        if unfinished.is_file():
            _remove(unfinished, unfinished.with_name(unfinished.stem[1:]))
    sizes = 0
    removable = [flight for flight in stored() if (sizes := sizes + flight.size) > gigabytes * 1e9]
    return [flight for flight in removable if _remove(flight.path, flight.path)]


def _remove(file: Path, flight: Path) -> bool:
    """Remove a file of a flight, unless the flight is locked; return whether removed."""
    with contextlib.suppress(OSError), _locked(flight, wait=False):
        file.unlink(missing_ok=True)
        return True
    return False


def _write(part: Config, path: Path) -> None:
    new = _unfinished(path)
    try:
        fly(part, new)
        limit = float(os.environ.get("VISNAV_FLIGHTS_GB", LIMIT))
        remove_beyond(max(limit - new.stat().st_size / 1e9, 0.0))
        new.rename(path)
    except (VisnavError, OSError):  # the run itself reports it
        pass
    finally:
        new.unlink(missing_ok=True)


def _unfinished(path: Path) -> Path:
    return path.with_name(f".{path.name}.new")


@contextlib.contextmanager
def _locked(path: Path, *, wait: bool = True) -> Iterator[None]:
    # The flags prevent waiting at a pipe of this name, and writing through a link.
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    file = os.open(path.with_name(f".{path.name}.lock"), flags, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(file)


# A flight, recorded and played.


def fly(config: Config, path: Path) -> None:
    """Fly, and write the flight into a file, complete on return.

    Raises:
        VisnavError: The flight failed.
        KeyboardInterrupt: A signal ended it.
        OSError: The file cannot be written.
    """
    final_pause = NodeSpec(
        name="(rest)", type_name="", on_error="stop", inputs={}, links={}, node=_FinalPause,
        config=NodeConfig(),
    )  # fmt: skip
    run = msgspec.structs.replace(config.run, digest=False, speed=None)
    config = msgspec.structs.replace(config, run=run, nodes=(*config.nodes, final_pause))
    with path.open("wb", buffering=1 << 20) as file:
        recorder = _Recorder(file)
        execute(config, watch=recorder.watch)
        file.write(_BEGIN.pack(write_object(file, recorder.calls)))
        file.flush()
        file.write(xxhash.xxh3_128_digest(_content(path)))


class _FinalPause(Node):
    async def on_shutdown(self) -> None:
        """Keep the clock running until pending answers arrive; nodes end in reverse order."""
        await self.clock.sleep(_FINAL_PAUSE)


class _Recorder(Instrument):
    def __init__(self, file: IO[bytes]) -> None:
        self.calls: Calls = {}
        self._file = file
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def watch(self, supervisor: Supervisor) -> Iterator[None]:
        supervisor.instruments.attach(self)
        yield
        if supervisor.state.stop_requested:  # by the user, who ends the command, too
            raise KeyboardInterrupt

    def worker_called(
        self, process: str, method: str, answer: concurrent.futures.Future[Any]
    ) -> None:
        calls = self.calls.setdefault(process.partition("[")[0], [])
        number = len(calls)
        calls.append((method, -1))

        def write_answer(answer: concurrent.futures.Future[Any]) -> None:
            error = answer.exception()
            with self._lock:  # each process has a thread of its own
                place = write_object(self._file, (None if error else answer.result(), error))
            calls[number] = method, place

        answer.add_done_callback(write_answer)


def write_object(file: IO[bytes], value: Any) -> int:
    """Write an object that can be pickled; return its place."""
    place = file.tell()
    pickle.dump(value, file, pickle.HIGHEST_PROTOCOL)
    return place


def read_object(content: memoryview, place: int) -> Any:
    """Return the object at a place of a file's content."""
    return pickle.loads(content[place:])  # noqa: S301  # of this user's own cache


def _content(path: Path) -> memoryview:
    with path.open("rb") as file:
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _read(path: Path) -> tuple[memoryview, Calls] | None:
    """Return a file's content and a flight's calls; `None` if missing or not readable."""
    if not path.is_file():  # a pipe would wait for ever
        return None
    try:
        content = _content(path)
        if xxhash.xxh3_128_digest(content[:-_CHECKSUM]) != content[-_CHECKSUM:]:
            return None
        (start,) = _BEGIN.unpack_from(content, len(content) - _CHECKSUM - _BEGIN.size)
        calls: Calls = read_object(content, start)
        for place in {
            place
            for places_by_method in calls.values()
            for place in dict(places_by_method).values()
        } - {-1}:
            read_object(content, place)  # one of each method
    except Exception:  # a file of other code may raise any error
        return None
    return content, calls


@contextlib.contextmanager
def _replaying(content: memoryview, calls: Calls, supervisor: Supervisor) -> Iterator[None]:
    remaining = {name: iter(answers) for name, answers in calls.items()}

    def make(name: str, *args: Any, **options: Any) -> Worker[Any]:
        if name not in remaining:
            return Worker(name, *args, **options)
        supervisor.state.costs.pop(name, None)  # a replayed worker costs nothing
        worker = _ReplayedWorker(name, *args, **options)
        worker.content, worker.remaining = content, remaining[name]
        return worker

    supervisor.services.make_worker = make
    yield


class _ReplayedWorker(Worker[Any]):
    """A worker without a process, to give recorded answers."""

    content: memoryview
    remaining: Iterator[tuple[str, int]]

    def _begin(self) -> list[Any]:
        return []

    def _start(self, begun: Any, args: Any) -> list[concurrent.futures.Future[Any]]:  # noqa: ARG002
        return [_DONE] * len(self._make)

    def _request(
        self,
        method: Callable[..., Any],
        args: Any,  # noqa: ARG002
        kwargs: Any,  # noqa: ARG002
    ) -> concurrent.futures.Future[Any]:
        name, place = next(self.remaining, ("none", -1))
        if place < 0 or name != method.__name__:
            raise WorkerError(
                f"worker {self.name}: expected the calls of the recorded flight, next {name}, "
                f"found {method.__name__}: a sweep with --fly does without it"
            )
        result, error = read_object(self.content, place)
        work: concurrent.futures.Future[Any] = concurrent.futures.Future()
        if error is not None:
            work.set_exception(error)
        else:
            work.set_result(result)
        return work


# What flies, and what a flight depends on.

_DRIVERS = (
    *("/usr/lib/*/libEGL*", "/usr/lib/*/libgallium*", "/usr/lib/*/libLLVM*", "/usr/lib/*/dri/*"),
    "/proc/driver/nvidia/version",
)
_VARIABLES = re.compile("MUJOCO_|E?GL|_?_?E?GL[VX]?_|LIBGL_|GALLIUM_|MESA_|LP_")


def flight_of(config: Config) -> Config | None:
    """Return the flying part of a file; `None` if anything else affects the flight.

    So does a node whose output a port of the flight takes, unless the port is narrowed to a source
    of the flight. Nodes that write files, or give no equal results, have to run themselves.
    """
    flying = {spec.name: spec for spec in config.nodes if spec.node.flies}
    if config.run.clock != "lockstep" or not flying:
        return None
    if any(
        not s.node.deterministic or s.node.files or [*written(s.config)] for s in flying.values()
    ):
        return None
    for sender, _, _, receiver, port in edges_of(config.nodes):
        if receiver in flying and sender not in flying:
            source = _narrowed(flying[receiver], port)
            if source is None or source.partition("/")[0] not in flying:
                return None
    return msgspec.structs.replace(config, nodes=tuple(flying.values()))


def _narrowed(spec: NodeSpec, port: str) -> str | None:
    bundle = port.partition(".")[0]
    declared = spec.node.declared
    ports: dict[str, Any] = {**declared.inputs, **declared.bundles, **declared.handlers}
    source: str | None = spec.inputs.get(port, spec.inputs.get(bundle, ports[bundle].source))
    return source


def settings_key(flight: Config) -> str:
    """Return a key, equal for flights with equal settings."""
    run = flight.run
    nodes = to_builtins(flight)["nodes"]
    return hashed([json.dumps([run.seed, run.duration, nodes], default=str, sort_keys=True)])


def content_key(flight: Config) -> str:
    """Return the key of a flight: its settings, what it is made from, libraries, drivers."""
    texts = [settings_key(flight), json.dumps(environment())]
    texts += [f"{k}={v}" for k, v in sorted(os.environ.items()) if _VARIABLES.match(k)]
    for pattern in _DRIVERS:
        for path in sorted(Path("/").glob(pattern[1:])):
            status = path.stat()
            texts.append(f"{path} {status.st_size} {status.st_mtime_ns}")
    parts = made_from(roots_of(flight, modules=(*RUN, __name__)))
    return hashed([*texts, key_of(parts)])
