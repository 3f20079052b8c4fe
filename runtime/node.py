"""Interface for authors of nodes: a class with ports, and the phases needed.

    construct → on_startup → announce, on_announcement → check → on_ready → run, handlers, ticks
    → on_end → on_shutdown

Every phase is optional. All that a node may use is there before its ``__init__`` (which takes no
arguments and need not call ``super().__init__``).
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    Literal,
    ParamSpec,
    dataclass_transform,
    get_args,
)

import msgspec
import numpy as np

from events import Announcement, Event
from runtime.channels.bundles import Matcher
from runtime.channels.declarations import Declared, read_declarations
from runtime.channels.ports import MAX_HZ
from runtime.channels.sender import Listener, Sender
from runtime.channels.streams import Stream
from runtime.errors import DeclarationError, expect_known
from runtime.host import Host, RunEnd, Sibling
from runtime.json_values import plain
from runtime.logs import NodeLogger
from runtime.time.clock import SECOND, Clock, Tick, Ticker
from runtime.typed import TypeVar

P = ParamSpec("P")
if TYPE_CHECKING:
    from runtime.channels.hold import Hold, HoldConfig
    from runtime.time.stepping import Stepping
    from runtime.workers.worker import Worker

R = TypeVar("R")
W = TypeVar("W")


class _ConfigMeta(msgspec.StructMeta):
    """Makes every subclass frozen, keyword-only, and strict about unknown keys."""

    def __new__(
        cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any
    ) -> _ConfigMeta:
        options = {"frozen": True, "kw_only": True, "forbid_unknown_fields": True} | options
        return super().__new__(cls, name, bases, namespace, **options)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(msgspec.field,))
class NodeConfig(msgspec.Struct, metaclass=_ConfigMeta, frozen=True, kw_only=True):
    """Base of a node's settings, given in the file beside its name and type."""


C = TypeVar("C", bound=NodeConfig, default=NodeConfig)


class CommandLine(msgspec.Struct, frozen=True, kw_only=True):
    """Command line of a program that a node starts, as its settings give it.

    Attributes:
        words: Program and arguments; variables such as ``$VISNAV_FOLDER`` are not replaced yet.
        folder: Working folder; if empty, that of the run.
        environment: Names and values of variables beside those of the run.
        build: Command that makes the program from sources.
    """

    words: tuple[str, ...]
    folder: str = ""
    environment: tuple[tuple[str, str], ...] = ()
    build: tuple[str, ...] = ()

    def texts(self) -> Iterable[str]:
        """Return all texts in it."""
        return (*self.words, self.folder, *(value for _, value in self.environment), *self.build)


class Node(Generic[C]):
    """Base of all nodes: declare ports, handlers and ticks on the class.

    ::

        class Brightness(Node):
            images = Input(Image, keep="latest")
            scores = Output(Score)

            async def run(self) -> None:
                async for image in self.images:
                    mean = await self.offload(np.mean, image.data)
                    self.scores.send(Score(stamp=image.stamp, source=self.name, …))

    ``Node[MyConfig]`` gives `config` its type; its fields are the node's settings in the file.

    Attributes:
        name: As in the file.
        clock: The run's clock; the only time that a node should know.
        log: The node's logger (trace, debug, info, warning, error, fatal).
        rng: Random numbers that depend on the run's seed and the node's name only.
        seed: The run's, for random numbers that nodes share.
        out: Folder for files, or `None` if the run writes none.
        sources: Ports narrowed to a source, by the file or by `narrow`.
        restarts: How often this node was brought up before in this run, in this process or in one
            that was lost; 0 the first time.
        checking: Whether ``python -m runtime check`` only looks whether the file is right: then
            `on_startup` must leave alone what is outside the process (devices, ports, networks).
    """

    deterministic: ClassVar[bool] = True
    """Whether equal inputs give equal outputs; if not, runs with this node promise no digest."""
    flies: ClassVar[bool] = False
    """Whether the node is a part of the flight itself (a simulator, a pilot). A sweep records once
    what its workers answer, for all runs with the same flight, if nothing else affects that.
    """
    ends_run: ClassVar[Literal["", "plan", "hand"]] = ""
    """Meaning of the node ending the run: its ``plan`` is over (a pilot, a replay; the default of
    nodes that fly), or a person acted by ``hand`` (a window, keys). Of any other node, the run ends
    early.
    """
    starts_programs: ClassVar[bool] = False
    """Whether the node starts programs under judgement: files of other nodes are then not in the
    run's folder before its end (`runtime.run.private_results`).
    """
    reads_truth: ClassVar[str] = ""
    """Purpose of receiving true poses, if not flying or estimating: ``judging``, ``recording``,
    ``showing``. All others that do are named in the summary, and every estimator.
    """
    relays_estimates: ClassVar[bool] = False
    """Whether the estimates that it sends are made by others: by programs behind a bridge, or in a
    recording. Any other node that announces an estimator, or sends estimates, is one, whatever its
    `flies`, `ends_run` and `reads_truth` say. Of nodes outside of this project it is ignored.
    """
    doing: str = ""
    """Slow work of the moment, in words, such as "building the world hall". A node that sets it
    tells whoever waits for the run, and sets it to "" when it is done.
    """
    files: ClassVar[tuple[str, ...]] = ()
    """Files written into the run's folder, besides those in settings of type `OutputPath`."""
    declared: ClassVar[Declared]
    config_type: ClassVar[type[NodeConfig]] = NodeConfig

    name: str
    config: C
    clock: Clock
    stepping: Stepping
    log: NodeLogger
    rng: np.random.Generator
    seed: int
    out: Path | None
    sources: dict[str, str]
    restarts: int
    checking: bool
    _host: Host
    _outside: set[Any]

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for base in vars(cls).get("__orig_bases__", ()):
            for argument in get_args(base):
                argument = getattr(argument, "__bound__", argument)  # of a base for several nodes
                if isinstance(argument, type) and issubclass(argument, NodeConfig):
                    cls.config_type = argument
        cls.declared = read_declarations(cls, Node)

    @classmethod
    def made_from(cls, config: C) -> Iterable[Path | CommandLine]:  # noqa: ARG003
        """Return files that the node reads, and programs that it starts, beside code and settings.

        A finished run of a sweep is run again when one of them has changed. The node's code, with
        what it imports, and files and folders that its settings name count without a word here.
        """
        return ()

    # Phases, in order. Override those you need.

    async def on_startup(self) -> None:
        """Get ready: open files and devices, start workers. Nothing may be sent yet."""

    def announce(self) -> Iterable[Announcement]:
        """Return this node's announcements; called once, after every node's `on_startup`."""
        return ()

    def on_announcement(self, announcement: Announcement) -> None:
        """Receive an announcement of any node; called before the first event.

        Raises:
            ValueError: This node cannot work with it; the message says why, and the run ends.
        """

    def check(self) -> Iterable[str]:
        """Return the unmet needs of this node, a sentence each; called after all announcements.

        With any, the run does not begin. For what may be meant, use `log.warning`.
        """
        return ()

    async def on_ready(self) -> None:
        """Prepare from the announcements, such as a worker from a camera's calibration.

        Called once all announcements are received. The first event waits for every node's, so that
        in real time, too, none is missed meanwhile. Nothing may be sent yet.
        """

    def narrow(self, port: str, source: str) -> None:
        """Receive a single source on a port (or on a bundle, or on ``bundle.field``).

        For nodes that choose among what is announced: call it in `on_announcement`. What the file
        says of the port holds nevertheless.

        Raises:
            DeclarationError: The node's class declares no such port.
        """
        ports = [*self.declared.listening, *self.declared.bundle_fields()]
        listed = ", ".join(ports) or "no ports"
        message = f"narrow: expected one of {listed}, found {port!r}"
        expect_known(port, ports, message, DeclarationError)
        self.sources.setdefault(port, source)

    def on_change(self, before: C) -> None:
        """React to a new `config`: a setting was changed during the run.

        Called between two steps. Only settings marked as `runtime.Changeable` change.

        Raises:
            ValueError: The node cannot do with it; the message says why, and `before` holds again.
        """

    async def run(self) -> None:
        """Run the node's work; returning is allowed. Cancelled when the run ends."""

    async def on_end(self) -> None:
        """Send last words; called in file order when the run is to end, before any node shuts down.

        Unlike what is sent in `on_shutdown`, they reach all nodes, those after this one in the
        file, too (in a run of several processes: those of this one). Ticks have stopped.
        """

    async def on_shutdown(self) -> None:
        """Flush and close. Events sent here still reach nodes before this in the file.

        The node receives nothing any more, also in what it does beside the loop; its streams still
        have what came before.
        """

    # What a node can ask for.

    def siblings(self, cls: type[Any]) -> tuple[Sibling, ...]:
        """Return the run's nodes of a class in file order, with this node and those elsewhere."""
        return tuple(sibling for sibling in self._host.siblings if issubclass(sibling.node, cls))

    def senders_of(self, *events: type[Event]) -> list[str]:
        """Return the names of the other nodes with outputs for some types of event."""
        listener = Listener(self.name, lambda _: None, events)
        return [
            sibling.name
            for sibling in self.siblings(Node)
            if sibling.name != self.name
            and any(listener.may_receive(o.event) for o in sibling.node.declared.outputs.values())
        ]

    def share(self, name: str, make: Callable[[], R]) -> R:
        """Return the object shared in this process under a name, made by the first caller.

        It outlives restarts, and is forgotten with the run.
        """
        shared = self._host.shared
        if name not in shared:
            shared[name] = make()
        value: R = shared[name]
        return value

    async def offload(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run a slow function in a thread, and await its result; the loop goes on meanwhile.

        In lockstep, simulated time waits for it; `offload_for` gives it time of its own. The
        function must not send: it returns what is to be sent.
        """
        return await self.offload_for(0.0, fn, *args, **kwargs)

    async def offload_for(
        self, latency: float, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a slow function in a thread; its result comes `latency` seconds of the clock later.

        In lockstep it comes exactly then, however long this machine takes; in real time not
        before then.
        """
        call = functools.partial(fn, *args, **kwargs)
        self._outside.add(call)
        for sender in senders(self).values():
            sender.watch()  # lest `call` sends something
        work = self._host.offload(self, call)
        work.add_done_callback(lambda _: self._outside.discard(call))
        return await self.clock.beside(work, round(latency * SECOND))

    async def worker(self, factory: Callable[..., W], *args: Any, **options: Any) -> Worker[W]:
        """Start an object in a process of its own, ended with this node.

        Args:
            factory: A class of an importable module.
            options: `more`, `processes`, `latency`, `timeout`, `env`, `niceness`; see `Worker`.

        Raises:
            WorkerError: The process died or hung; or whatever making the object raised.
        """
        return await self._host.worker(self, factory, args, **options)

    def hold(self, name: str, config: HoldConfig, latency: float) -> Hold[Any]:
        """Hold simulated time for the answers of a system outside the process; see `Hold`.

        Raises:
            ConfigError: There are no latencies in the file that `config` names.
        """
        return self._host.hold(self, name, config, latency)

    def start(self, coro: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine beside `run`, as part of this node, and cancelled with `run`."""
        self._host.start(self, coro)

    def every(self, hz: float, call: Callable[[Tick], Any], name: str = "") -> Ticker:
        """Call a function at a rate from the first update on, as `@every` does; for `on_startup`.

        Raises:
            DeclarationError: The rate is not above 0, or above `MAX_HZ`.
        """
        if not 0 < hz <= MAX_HZ:
            raise DeclarationError(f"every: expected a rate above 0, up to {MAX_HZ} Hz, found {hz}")
        return self._host.every(self, hz, call, name or getattr(call, "__name__", "tick"))

    def stop(self, reason: str) -> None:
        """End the run in order, as Ctrl-C would."""
        self._host.stop(self, reason)

    @property
    def run_end(self) -> RunEnd | None:
        """How the run ended, for `on_end` and `on_shutdown`; `None` before."""
        return self._host.run_end

    @property
    def shutdown_limit(self) -> float:
        """Real seconds that `on_end` and `on_shutdown` may take, each; a long run gives more."""
        return self._host.shutdown_limit

    def conclude(
        self,
        subject: str,
        figures: Mapping[str, Any],
        *,
        passed: bool | None = True,
        flight: bool = False,
    ) -> None:
        """Put a verdict about something into the run's summary.

        If any verdict of a run is not passed, the command line ends with exit code 1.

        Args:
            subject: What was judged: the source of an estimator; of a `flight`, the vehicle.
            passed: Whether it met its thresholds; `None` if nothing was asked of it.

        Raises:
            TypeError: A figure is nothing that JSON knows (numpy's numbers and arrays are made into
                such), or `passed` is neither a bool nor `None`.
        """
        where = f"conclude({subject!r})"
        if not isinstance(passed, bool | np.bool_ | None):
            raise TypeError(
                f"{where}: passed: expected True, False or None, "
                f"found {passed!r:.80} ({type(passed).__name__})"
            )
        values = {str(name): plain(value, f"{where}: {name}") for name, value in figures.items()}
        known = None if passed is None else bool(passed)
        self._host.conclude(str(subject), values, known, flight)

    def note_environment(self, name: str, value: str) -> None:
        """Record a machine property relevant to figures, beside the summary's versions."""
        self._host.note_environment(name, value)

    def note_truth(self, subject: str, facts: Mapping[str, Any]) -> None:
        """Record what no node and no program may know during the run, for its summary alone."""
        self._host.note_truth(subject, facts)

    def after_run(self, call: Callable[[Path], Any]) -> None:
        """Have a function called with the run's folder, if any, once its summary is written."""
        self._host.after_run(call)


N = TypeVar("N", bound=Node[Any])


def make_node(
    cls: type[N],
    name: str,
    config: NodeConfig,
    host: Host,
    sources: Mapping[str, str] | None = None,
    restarts: int = 0,
) -> N:
    """Make a node with its ports in place."""
    node = cls.__new__(cls)
    node.name = name
    node.config = config
    node.clock = host.clock
    node.stepping = host.stepping
    node.log = NodeLogger(name)
    node.rng = np.random.default_rng([host.seed, zlib.crc32(name.encode())])
    node.seed = host.seed
    node.out = host.out_of_programs if cls.starts_programs else host.out
    node.sources = dict(sources or {})
    node.restarts = restarts
    node.checking = host.checking
    node._host = host
    node._outside = set()
    for port, declared in cls.declared.inputs.items():
        setattr(node, port, declared.make(name))
    for port, bundle in cls.declared.bundles.items():
        setattr(node, port, bundle.make(name))
    for port, output in cls.declared.outputs.items():
        setattr(node, port, Sender(f"{name}.{port}", output.event, node._outside))
    node.__init__()  # type: ignore[misc]  # now that what it may use is there
    return node


def streams(node: Node[Any]) -> dict[str, Stream[Any]]:
    """Return a node's streams by port."""
    by_port = {port: getattr(node, port) for port in node.declared.inputs}
    return by_port | {port: matcher.stream for port, matcher in matchers(node).items()}


def matchers(node: Node[Any]) -> dict[str, Matcher[Any]]:
    """Return a node's matchers by port."""
    return {port: getattr(node, port) for port in node.declared.bundles}


def senders(node: Node[Any]) -> dict[str, Sender[Any]]:
    """Return a node's senders by port."""
    return {port: getattr(node, port) for port in node.declared.outputs}
