"""Recorder of a flight while flown: an instrument, and hooks on the loop.

Also the flying nodes of a file, and a flight's key: settings, sources, files, machine.
"""

from __future__ import annotations

import ast
import asyncio
import contextlib
import functools
import importlib.util
import json
import os
import pickle
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import xxhash

from events import Event
from runtime.channels.sender import Sender
from runtime.config.model import Config, NodeSpec, to_builtins
from runtime.node import Node, NodeConfig
from runtime.paths import written
from runtime.run.execute import execute
from runtime.run.graph import edges_of
from runtime.run.instruments import Call, Instrument
from runtime.run.summarise import environment
from runtime.run.supervisor import Supervisor
from runtime.time.lockstep import LockstepLoop
from runtime.time.schedule import Once, Tick, Ticker
from runtime.tools.flights.player import Action, Flight, Flown, Writer, prune

_REST = 10.0
"""Seconds of the clock for a flight to go on without ticks: images on their way still arrive."""


def record(config: Config, path: Path) -> None:
    """Fly, and write the flight into a file, complete on return.

    Raises:
        VisnavError: The flight failed.
        KeyboardInterrupt: A signal ended it.
        OSError: The file cannot be written.
    """
    rest = NodeSpec(
        name="(rest)", type_name="", on_error="stop", inputs={}, links={}, node=_Rest,
        config=NodeConfig(),
    )  # fmt: skip
    run = msgspec.structs.replace(config.run, digest=False, speed=None)
    config = msgspec.structs.replace(config, run=run, nodes=(*config.nodes, rest))
    with path.open("wb", buffering=1 << 20) as file:
        recorder = _Recorder(writer := Writer(file))
        execute(config, watch=recorder.watch)
        writer.end(recorder.flight())


class _Rest(Node):
    async def on_shutdown(self) -> None:
        """Let time go on, the last node in the file being the first to end."""
        await self.clock.sleep(_REST)


class _Recorder(Instrument):
    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._occasions: list[list[Action]] = []
        self._events: list[tuple[Event, list[Action]]] = []  # of this occasion
        self._actions: list[Action] = []  # of this occasion
        self._turn = self._begun = 0
        self._inside = False
        self._doing: list[tuple[str, list[Action] | None]] = []  # node, and within which event
        self._ticks: dict[str, dict[int, int]] = {}
        self._starts: dict[str, int] = {}
        self._unfit = ""
        self._supervisor: Supervisor
        self.event_sent = self._sent

    @contextlib.contextmanager
    def watch(self, supervisor: Supervisor) -> Iterator[None]:
        """Look at a run, from within its loop."""
        self._supervisor = supervisor
        supervisor.instruments.attach(self)
        yield

    def flight(self) -> Flight:
        """Return the flight; called after its end."""
        state = self._supervisor.state
        if state.stop_requested:  # whatever was to follow is not wanted either
            raise KeyboardInterrupt
        nodes = {
            name: Flown([], {}, self._starts.get(name))
            for name in state.runners
            if name != "(rest)"
        }
        for each in state.announcements:
            if (node := each.source.partition("/")[0]) in nodes:
                nodes[node].announcements.append(each)
            else:
                self._unfit = f"{each.source} is announced in another's name"
        for name, ticker in state.tickers.items():
            node, _, what = name.partition(".")
            nodes[node].tickers[what] = ticker.hz, self._ticks.get(name, {})
        if state.conclusions or state.flights or state.outside or state.afterwards:
            self._unfit = "a node of the flight concludes, writes or asks something"
        elif len(state.all_nodes) > len(state.runners):
            self._unfit = "a node of the flight was restarted"
        if self._unfit:
            return Flight(self._unfit, {}, [], {})
        prune(self._occasions)
        return Flight("", nodes, self._occasions, dict(state.environment))

    # What nodes do.

    def wrap_call(self, node: str, what: str, call: Call) -> Call:
        """Note the actions of a node in a call."""

        def wrapped(given: Any) -> Any:
            within = None
            ticks = isinstance(given, Tick)
            if ticks:
                self._ticks.setdefault(f"{node}.{what}", {})[given.index] = self._begin(self._new())
            elif isinstance(given, Event):
                within = next((i for each, i in reversed(self._events) if each is given), None)
            elif what == "run" and node not in self._starts:
                self._starts[node] = self._begin(self._new())
            self._inside = self._inside or ticks
            self._doing.append((node, within))
            try:
                result = call(given)
                if result is True and isinstance(given, Event):
                    self._act("handled")
                return result
            finally:
                self._doing.pop()
                self._inside = self._inside and not ticks

        return wrapped

    def _sent(self, sender: Sender[Any] | None, event: Event) -> None:
        if sender is None:
            return
        node = sender.name.partition(".")[0]
        runner = self._supervisor.state.runners[node]
        if runner.shutting_down or runner.phase == "on_end":  # when that is depends on all nodes
            self._unfit = f"{node} sends something at its end"
        try:
            place, sizes = self._writer.event(event)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            self._unfit, place, sizes = f"{sender.name}: {error}", 0, ()
        action = self._act("send", node, text=sender.name, due=place, sizes=sizes)
        self._events.append((event, action.inner))

    def _act(self, kind: Any, node: str = "", **more: Any) -> Action:
        own, within = self._doing[-1] if self._doing else (node, None)
        turn = -1 if self._inside else self._turn - self._begun
        action = Action(kind, node or own, turn, [], **more)
        (self._actions if within is None else within).append(action)
        return action

    # Occasions.

    def _new(self) -> int:
        if not self._occasions:  # what was set before the first is set anew in each run
            self._hook()
        self._occasions.append([])
        return len(self._occasions) - 1

    def _begin(self, occasion: int) -> int:
        self._actions, self._begun = self._occasions[occasion], self._turn
        self._events.clear()
        return occasion

    def _hook(self) -> None:
        loop = asyncio.get_running_loop()
        host: Any = self._supervisor.state
        assert isinstance(loop, LockstepLoop)
        schedule: Any = loop.schedule
        stop, add, hold, call_at = host.stop, schedule.add, loop.hold, loop.call_at
        run_once = loop._run_once  # type: ignore[attr-defined]

        def turned() -> None:
            self._turn += 1
            run_once()

        def stopped(node: Any, reason: str) -> None:
            self._act("stop", text=reason)
            stop(node, reason)

        def added(due: int, entry: Any) -> None:
            if isinstance(entry, Ticker):
                self._unfit = "a node of the flight begins to tick in the middle"
            else:
                fire = functools.partial(self._on, self._later("once", due), entry.fire, due, due)
                entry = Once(fire)
            add(due, entry)

        def held(work: Any, due: int) -> asyncio.Future[Any]:
            future, later = hold(work, due), self._later("held", due)
            future.add_done_callback(lambda f: None if f.cancelled() else self._begin(later))
            return future

        def called(when: float, call: Callable[..., Any], *args: Any, context: Any = None) -> Any:
            return call_at(when, self._on, self._later("timer", when), call, *args, context=context)

        patched: Any = loop
        host.stop, schedule.add, patched.hold, patched.call_at = stopped, added, held, called
        patched._run_once = turned

    def _later(self, kind: str, due: float) -> int:
        occasion = self._new()
        self._act(kind, due=due, later=occasion)
        return occasion

    def _on(self, occasion: int, function: Callable[..., Any], *args: Any) -> Any:
        self._begin(occasion)
        self._inside = True
        try:
            return function(*args)
        finally:
            self._inside = False


_DRIVERS = (
    *("/usr/lib/*/libEGL*", "/usr/lib/*/libgallium*", "/usr/lib/*/libLLVM*", "/usr/lib/*/dri/*"),
    "/proc/driver/nvidia/version",
)
_VARIABLES = re.compile("MUJOCO_|E?GL|_?_?E?GL[VX]?_|LIBGL_|GALLIUM_|MESA_|LP_")
_PARSING = threading.Lock()
"""Lock for Python 3.11's parser: all threads share a depth counter (cpython#106905)."""
_NAMED = re.compile(r'\bfile\w*\s*=\s*"([^"]+)"')
_FOLDERS = re.compile(r'(?:mesh|texture|asset)dir\s*=\s*"([^"]+)"')


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
    return _hashed([json.dumps([run.seed, run.duration, nodes], default=str, sort_keys=True)])


def content_key(flight: Config) -> str:
    """Return the key of a flight: its settings, sources, files, libraries, drivers."""
    texts = [settings_key(flight), json.dumps(environment())]
    texts += [f"{k}={v}" for k, v in sorted(os.environ.items()) if _VARIABLES.match(k)]
    for pattern in _DRIVERS:
        for path in sorted(Path("/").glob(pattern[1:])):
            found = path.stat()
            texts.append(f"{path} {found.st_size} {found.st_mtime_ns}")
    files = {*_sources([*(spec.node.__module__ for spec in flight.nodes), __name__])}
    for path in _paths(to_builtins(flight)["nodes"]):
        files |= _read_by(path)
    texts += [f"{path} {_hashed([path.read_bytes()])}" for path in sorted(files)]
    return _hashed(texts)


def _hashed(parts: Iterable[str | bytes]) -> str:
    digest = xxhash.xxh3_128()
    for part in parts:
        digest.update(part.encode() if isinstance(part, str) else part)
        digest.update(b"\0")
    return digest.hexdigest()


def _sources(modules: Iterable[str]) -> Iterator[Path]:
    """Yield the files of modules and their imports, without other installed packages."""
    todo = [*modules, "events"]
    roots = {name.partition(".")[0] for name in todo}
    seen = {""}
    while todo:
        name = todo.pop()
        root = name.partition(".")[0]
        if name in seen or not (root in roots or _is_here(root)):
            continue
        seen.add(name)
        path = _origin(name)
        if path is None:
            continue
        package = path.name == "__init__.py"
        yield from (p for p in path.parent.iterdir() if p.is_file()) if package else [path]
        parent = name.rpartition(".")[0]
        todo.append(parent)
        todo += _imported(path, name if package else parent)


def _imported(path: Path, package: str) -> Iterator[str]:
    """Yield the modules imported anywhere in a package's file, and possible modules."""
    if path.suffix not in {".py", ".pyi"}:
        return
    with contextlib.suppress(SyntaxError, ValueError):
        with _PARSING:
            todo: list[Any] = [ast.parse(path.read_bytes())]
        while todo:  # statements only, which takes a third of the time of `ast.walk`
            node = todo.pop()
            for field in ("body", "orelse", "finalbody", "handlers", "cases"):
                todo += getattr(node, field, ())
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                with contextlib.suppress(ImportError):  # beyond the topmost package
                    one = "." * node.level + (node.module or "")
                    whole = importlib.util.resolve_name(one, package)
                    yield from (whole, *(f"{whole}.{alias.name}" for alias in node.names))


def _origin(name: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(name)
    except Exception:  # a package is imported for what is in it, and may raise anything
        return None
    return Path(spec.origin) if spec and spec.has_location and spec.origin else None


@functools.cache
def _is_here(root: str) -> bool:
    path = None if not root or root in sys.stdlib_module_names else _origin(root)
    return path is not None and not {"site-packages", "dist-packages"} & {*path.parts}


def _paths(value: Any) -> Iterator[Path]:
    """Yield the files named by settings; paths are absolute since the file was read."""
    if isinstance(value, str) and value.startswith("/") and Path(value).exists():
        yield Path(value)
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _paths(each)


def _read_by(path: Path) -> set[Path]:
    """Return a file and all files included by a MuJoCo model, or the files in a folder."""
    if path.is_dir():
        return {each for each in path.rglob("*") if each.is_file()}
    found, todo, folders = {path}, [path], {path.parent}
    while todo:
        if (file := todo.pop()).suffix == ".xml":
            text = file.read_text(encoding="utf-8", errors="replace")
            folders |= {path.parent / name for name in _FOLDERS.findall(text)}
            named = {folder / name for folder in folders for name in _NAMED.findall(text)}
            todo += (new := sorted({each for each in named if each.is_file()} - found))
            found.update(new)
    return found
