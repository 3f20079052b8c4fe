"""Checks of a run before its begin, by its file, its nodes, and rules that packages offer.

`of_file` looks at classes and settings only, and is quick enough for every run. `of_nodes` also
goes through all phases before the first update, and then through the last one:

    construct → on_startup → announce → on_announcement → check → on_shutdown

Meanwhile no worker is started, no file is written, and `Node.checking` tells the nodes to leave
alone what is outside the process. A package names its rules in its ``pyproject.toml``:

    [project.entry-points."visnav.lint"]
    my_package = "my_package.rules:RULES"       # a list of functions

A rule is a function of the settings and of what the nodes announced, which yields a `Finding` for
each thing that is odd; its name, with hyphens, is the rule's, and its docstring says why it is one.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import logging
import posixpath
from collections.abc import Callable, Collection, Coroutine, Iterable, Iterator, Sequence
from types import CodeType
from typing import Any, NoReturn

import msgspec

from events import Announcement, EstimatorAnnouncement, Shutdown, WindowClosed
from runtime.channels.hold import Hold, HoldConfig
from runtime.channels.sender import Listener
from runtime.channels.sources import SourceOwners
from runtime.config.model import Config, NodeSpec
from runtime.errors import NodeError, UncheckableError, VisnavError, suggest
from runtime.extras import offers
from runtime.host import Host
from runtime.node import Node
from runtime.paths import written
from runtime.run import event_loop
from runtime.run.execute import make_clock, make_loop
from runtime.run.graph import circles, edges_of, input_types, unconnected
from runtime.run.node_runner import Announced, NodeRunner, Phase, start_up
from runtime.run.node_services import siblings
from runtime.time.clock import Clock, Tick, Ticker
from runtime.time.stepping import Stepping

RUN_FILES = ("config.toml", "log.txt", "summary.json")
"""Files written by the run itself into its folder."""


class Findings(msgspec.Struct, frozen=True):
    """Results of a check.

    Attributes:
        errors: With any of these the run cannot do what the file says: a line each.
        warnings: What is odd, and may be meant.
        facts: What nodes say of what they have read.
    """

    errors: list[str]
    warnings: list[str]
    announcements: tuple[Announcement, ...] = ()
    facts: tuple[str, ...] = ()


def of_file(config: Config, only: Collection[str] = ()) -> Findings:
    """Check the settings of a file, and the classes of its nodes."""
    specs = [spec for spec in config.nodes if not only or spec.name in only]
    warnings = [
        f"{node}.{port}: expects {event}, and no node sends it"
        for node, port, event in unconnected([(spec.name, spec.node) for spec in config.nodes])
    ]
    warnings += [
        f"{spec.name}.{port}: no method of {spec.type_name} reads it"
        for spec in specs
        for port in _unread(spec.node)
    ]
    warnings += [
        f"expected handlers that come to an end, found some that always answer one another: {loop}"
        for loop in circles([(spec.name, spec.node) for spec in config.nodes])
    ]
    return Findings(list(_clashes(specs)), warnings)


def of_nodes(config: Config) -> Findings:
    """Start all nodes, up to their first update, and shut them down again."""
    errors: list[str] = []
    loop = make_loop(config.run)
    with asyncio.Runner(loop_factory=lambda: loop) as runner, _collect_log() as messages:
        warnings, facts = messages[logging.WARNING], messages[logging.INFO]
        announced = runner.run(_rehearse(config, errors, warnings))
    return Findings(errors, warnings, tuple(announced), tuple(facts))


async def _rehearse(config: Config, errors: list[str], warnings: list[str]) -> list[Announcement]:
    loop = asyncio.get_running_loop()
    event_loop.install(loop)
    clock = make_clock(config.run, loop)
    host = _DryHost(config, clock)
    created: set[asyncio.Task[Any]] = set()

    def create(coro: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        task = loop.create_task(coro, name=name)
        created.add(task)
        return task

    runners = [NodeRunner(spec, create) for spec in config.nodes]
    failed_startups: set[str] = set()
    uncertain = False
    announcements: list[Announcement] = []

    async def start(runner: NodeRunner) -> None:
        await runner.start_up(host, config.run.startup_limit)

    async def exchange(announced: Announced) -> list[Announcement]:
        announcements.extend(
            a for node_announcements in announced.values() for a in node_announcements
        )
        (warnings if uncertain else errors).extend(_unknown_sources(config.nodes, announcements))
        return announcements

    def failed(phase: Phase, runner: NodeRunner, error: NodeError) -> None:
        nonlocal uncertain
        if phase == "on_startup":
            failed_startups.add(runner.spec.name)
            if isinstance(error.__cause__, UncheckableError):
                uncertain = True
                warnings.append(f"{runner.spec.name}: {error.__cause__}: not all can be checked")
            elif not isinstance(error.__cause__, _NoWorkerError):
                errors.append(str(error))
        elif phase == "announce":
            if runner.spec.name not in failed_startups:
                errors.append(str(error))
        elif not any(reported.startswith(f"{runner.spec.name}: inputs.") for reported in errors):
            (warnings if uncertain else errors).append(str(error))

    try:
        await start_up(
            runners,
            start=start,
            exchange=exchange,
            failed=failed,
            owners=SourceOwners(spec.name for spec in config.nodes),
            limit=config.run.startup_limit,
            give_up=lambda: bool(errors),  # later errors only follow from these
        )
    finally:
        before = len(warnings)
        for runner in reversed(runners):
            runner.stop_receiving()
            await runner.shut_down(config.run.shutdown_limit)
        del warnings[before:]  # of nodes that received nothing, as expected here
        host.executor.shutdown(wait=False, cancel_futures=True)
        clock.close()
    return announcements


class _NoWorkerError(VisnavError):
    """A node's call of a worker in a check, without any worker started."""


class _Absent:
    async def call(self, *_: Any, **__: Any) -> NoReturn:
        raise _NoWorkerError("not while the file is only checked")

    call_for = call

    def outstanding(self) -> int:
        return 0


class _DryHost(Host):
    checking = True

    def __init__(self, config: Config, clock: Clock) -> None:
        names = {spec.name for spec in config.nodes}
        super().__init__(clock, config.run.seed, siblings(config, names))
        self.stepping = Stepping(clock)
        self.shutdown_limit = config.run.shutdown_limit
        self.executor = concurrent.futures.ThreadPoolExecutor(
            max_workers=2, thread_name_prefix="offload"
        )

    def offload(
        self,
        node: Node[Any],  # noqa: ARG002
        call: functools.partial[Any],
    ) -> concurrent.futures.Future[Any]:
        return self.executor.submit(call)

    def hold(
        self,
        node: Node[Any],  # noqa: ARG002
        name: str,
        config: HoldConfig,
        latency: float,
    ) -> Hold[Any]:
        return Hold(name, self.clock, config, latency)

    def start(self, node: Node[Any], coro: Coroutine[Any, Any, None]) -> None:  # noqa: ARG002
        coro.close()

    def every(self, node: Node[Any], hz: float, call: Callable[[Tick], Any], name: str) -> Ticker:
        return Ticker(f"{node.name}.{name}", hz, call, lambda _: None)

    async def worker(self, *_: Any, **options: Any) -> Any:
        if "more" in options:
            await options["more"]()
        return _Absent()


@contextlib.contextmanager
def _collect_log() -> Iterator[dict[int, list[str]]]:
    """Collect the messages of nodes by level: information and warnings."""
    messages: dict[int, list[str]] = {logging.INFO: [], logging.WARNING: []}

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.levelno in messages:
                name = record.name.removeprefix("visnav.")
                messages[record.levelno].append(f"{name}: {record.getMessage()}")

    logger, handler = logging.getLogger("visnav"), Collect()
    settings_before = logger.propagate, logger.level
    logger.propagate = False
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield messages
    finally:
        logger.removeHandler(handler)
        logger.propagate = settings_before[0]
        logger.setLevel(settings_before[1])


def _clashes(nodes: Iterable[NodeSpec]) -> Iterator[str]:
    writers = dict.fromkeys(RUN_FILES, "the run itself")
    for spec in nodes:
        files = dict.fromkeys(
            posixpath.normpath(file) for file in (*spec.node.files, *written(spec.config))
        )
        for file in files:
            if file.startswith(("/", "..")):
                yield f"{spec.name}: expected a file in the run's folder, found {file}"
            if file in writers:
                yield (
                    f"{spec.name}: expected files of its own in the run's folder, found {file}, "
                    f"which {writers[file]} writes, too"
                )
            writers.setdefault(file, spec.name)


def _unread(cls: type[Node[Any]]) -> list[str]:
    mentioned = mentioned_in(cls)
    return [port for port in (*cls.declared.inputs, *cls.declared.bundles) if port not in mentioned]


def mentioned_in(cls: type[Node[Any]]) -> set[Any]:
    """Return the names and texts in the methods of a class."""
    mentioned: set[Any] = set()

    def add_names(code: CodeType) -> None:
        mentioned.update(code.co_names)
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                add_names(constant)
            else:
                mentioned.add(constant if isinstance(constant, str) else "")

    for base in cls.__mro__[: cls.__mro__.index(Node)]:
        for value in vars(base).values():
            function = getattr(value, "fget", None) or getattr(value, "__func__", value)
            if isinstance(code := getattr(function, "__code__", None), CodeType):
                add_names(code)
    return mentioned


def _unknown_sources(nodes: Iterable[NodeSpec], announced: Iterable[Announcement]) -> Iterator[str]:
    """Yield errors for `inputs` narrowed to a source without events, of nodes that announce any."""
    specs = {spec.name: spec for spec in nodes}
    sources = dict.fromkeys([*specs, *(announcement.source for announcement in announced)])
    for spec in specs.values():
        for port, source in spec.inputs.items():
            place = f"{spec.name}: inputs.{port}"
            events = _types(spec.node, port)
            owner = source.partition("/")[0]
            below_owner = [known for known in sources if known.startswith(f"{owner}/")]
            if owner in specs and not _may_send(specs[owner].node, events):
                names = " or ".join(event.__name__ for event in events)
                yield f"{place}: expected a source of {names}, found {source}: {owner} sends none"
            elif not (
                source in specs
                or (owner in specs and not below_owner)
                or any(
                    f"{known}/".startswith(f"{source}/")
                    or ("/" in known and source.startswith(f"{known}/"))
                    for known in sources
                )
            ):
                known = ", ".join(below_owner or sources)
                yield (
                    f"{place}: expected one of {known}, found {source}{suggest(source, sources)}"
                )


def _types(cls: type[Node[Any]], port: str) -> tuple[Any, ...]:
    return tuple(
        event
        for name, events in input_types(cls).items()
        if name == port or name.startswith(f"{port}.")
        for event in events
    )


def _may_send(cls: type[Node[Any]], events: tuple[Any, ...]) -> bool:
    listener = Listener("", lambda _: None, events)
    return any(listener.may_receive(output.event) for output in cls.declared.outputs.values())


GROUP = "visnav.lint"


class Finding(msgspec.Struct, frozen=True):
    """Something odd.

    Attributes:
        subject: Source of the sensor, or name of the node.
        change: What to change, if it is not meant.
    """

    subject: str
    found: str
    change: str
    rule: str = ""

    def __str__(self) -> str:
        return f"{self.rule}: {self.subject}: {self.found}: {self.change}"


Rule = Callable[[Config, Sequence[Announcement]], Iterable[Finding]]


def rules() -> dict[str, Rule]:
    """Return all rules by name; raise `CommandError` if one cannot be imported."""
    imported: list[Rule] = [rule for offer in offers(GROUP) for rule in offer.load()]
    return {rule.__name__.replace("_", "-"): rule for rule in imported}


def lint(
    config: Config, announcements: Sequence[Announcement], ignore: Collection[str] = ()
) -> list[Finding]:
    """Return the findings of all rules, except those accepted by the file.

    Args:
        ignore: Names of rules that are left out, or ``rule:subject``.
    """
    rules_by_name = rules()
    accepted = {*config.run.accept, *ignore}
    findings = [
        Finding(
            "run",
            f"accept names no rule: {name}",
            f"take it out{suggest(name, rules_by_name)}",
            "accept",
        )
        for name in sorted(accepted)
        if name.partition(":")[0] not in rules_by_name
    ]
    for name, rule in rules_by_name.items():
        if name not in accepted:
            odd = (msgspec.structs.replace(one, rule=name) for one in rule(config, announcements))
            findings += [one for one in odd if f"{name}:{one.subject}" not in accepted]
    return findings


def no_end(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:  # noqa: ARG001
    """Nothing but Ctrl-C ends a run without a duration, a pilot or a replay."""
    if not config.run.duration and not any(map(_may_end, config.nodes)):
        problem = "it has no duration, and no node that ends it, as a pilot or a replay does"
        yield Finding("run", problem, "give it a duration")


def idle(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:  # noqa: ARG001
    """Without a node to send its orders, a vehicle stands still."""
    receivers = {receiver for *_, receiver, _ in edges_of(config.nodes)}
    for spec in config.nodes:
        handlers = spec.node.declared.handlers
        only = handlers and len(handlers) == len(spec.node.declared.listening)
        if only and spec.name not in receivers and not _may_end(spec):
            events = dict.fromkeys(e.__name__ for h in handlers.values() for e in h.events)
            problem = f"it waits for {' or '.join(events)}, which no node sends"
            yield Finding(spec.name, problem, "add one that does")


def nobody_judged(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:
    """Without an estimator, there is nothing to judge."""
    sent = edges_of(config.nodes)
    judged = {receiver for *_, receiver, port in sent if port == "estimates"}
    for spec in config.nodes:
        if "thresholds" in spec.config.__struct_fields__ and not (
            spec.name in judged or any(isinstance(a, EstimatorAnnouncement) for a in announced)
        ):
            yield Finding(spec.name, "nobody sends estimates that it could judge", "add one")


RULES: list[Rule] = [no_end, idle, nobody_judged]


def _may_end(spec: NodeSpec) -> bool:
    sends = (output.event for output in spec.node.declared.outputs.values())
    ends = "stop" in mentioned_in(spec.node) or any(
        issubclass(event, Shutdown | WindowClosed) for event in sends
    )
    return ends and bool(getattr(spec.config, "end_run", True))
