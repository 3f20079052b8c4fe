"""For tests of nodes: simulated time, scripted inputs, collected outputs.

    result = run_node(Brightness, inputs=[image(stamp=0), image(stamp=10_000_000)], duration=0.1)
    assert [score.value for score in result.of(Score)] == [0.0, 255.0]

Nothing here sleeps: a test of an hour's flight takes as long as its computing does.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from events import Announcement, Event
from runtime.channels.answers import Answers
from runtime.channels.links import LinkConfig
from runtime.channels.ports import Output
from runtime.channels.sender import Sender
from runtime.config.model import Config, NodeSpec, OnError, RunConfig
from runtime.config.reading import convert
from runtime.node import Node
from runtime.run import event_loop
from runtime.run.summarise import count_drops, tick_summaries
from runtime.run.supervisor import Supervisor
from runtime.summary import StreamSummary, TickSummary
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.units import Duration

R = TypeVar("R")
E = TypeVar("E", bound=Event)
N = TypeVar("N", bound=Node[Any])

__all__ = ["NodeResult", "any_source", "run_in_lockstep", "run_node", "run_nodes", "spec"]


class NodeResult(msgspec.Struct, frozen=True):
    """Result of a run of nodes under test.

    Attributes:
        sent: Every event that the nodes under test sent, in order; announcements first.
        seconds: On the simulated clock.
        outside: What became of the frames for systems outside the process, by their names.
    """

    sent: list[Event]
    reason: str
    drops: dict[str, StreamSummary]
    ticks: dict[str, TickSummary]
    seconds: float
    outside: dict[str, Answers]

    def of(self, event: type[E]) -> list[E]:
        """Return the sent events of a type."""
        return [e for e in self.sent if isinstance(e, event)]


def run_in_lockstep(main: Coroutine[Any, Any, R]) -> R:
    """Run a coroutine on a jumping loop: `asyncio.sleep` and time-outs take no real time."""
    results: list[R] = []

    async def prepared() -> None:
        loop = asyncio.get_running_loop()
        event_loop.install(loop)
        results.append(await loop.create_task(main))

    # The runner's own task has no result: `signal.signal` formats it, all events of a run.
    with asyncio.Runner(loop_factory=LockstepLoop) as runner:
        runner.run(prepared())
    return results[0]


def run_node(
    node: type[Node[Any]],
    *,
    inputs: Iterable[Event] = (),
    config: Mapping[str, Any] | None = None,
    duration: float = 1.0,
    name: str = "node",
    seed: int = 0,
    out: Path | None = None,
) -> NodeResult:
    """Run a single node on the lockstep clock.

    Args:
        inputs: Events to send to it, each at its own stamp; announcements before all.
        duration: Seconds until the run ends, if nothing ends it before.

    Raises:
        ConfigError: The settings are wrong.
        NodeError: The node failed.
    """
    return run_nodes(
        [spec(node, name, config)], inputs=inputs, duration=duration, seed=seed, out=out
    )


def run_nodes(
    nodes: Iterable[NodeSpec],
    *,
    inputs: Iterable[Event] = (),
    duration: float = 1.0,
    seed: int = 0,
    out: Path | None = None,
) -> NodeResult:
    """Run several nodes together; see `run_node`."""
    inputs, nodes = list(inputs), list(nodes)
    script = spec(_script(inputs), "script")
    run = RunConfig(duration=Duration(duration), seed=seed)
    settings = Config(run=run, nodes=(script, *nodes))
    sent: list[Event] = []

    def collect(sender: Sender[Any] | None, event: Event) -> None:
        scripted = sender.name.startswith("script.") if sender else id(event) in from_script
        if not scripted:
            sent.append(event)

    from_script = {id(e) for e in inputs}

    async def main() -> NodeResult:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        scripted = ["script", *(spec.name for spec in nodes if spec.node in _SCRIPTED)]
        supervisor = Supervisor(settings, LockstepClock(loop), [collect], out, scripted=scripted)
        await supervisor.main()
        if supervisor.state.error is not None:
            raise supervisor.state.error
        return NodeResult(
            sent,
            supervisor.state.reason,
            count_drops(supervisor.state),
            tick_summaries(supervisor.state),
            loop.now / 1e9,
            supervisor.state.outside,
        )

    # A test that expects an error reads it from the exception, not from the terminal.
    runtime_log = logging.getLogger("visnav.runtime")
    before, runtime_log.disabled = runtime_log.disabled, True
    try:
        return run_in_lockstep(main())
    finally:
        runtime_log.disabled = before


def spec(
    node: type[Node[Any]],
    name: str,
    config: Mapping[str, Any] | None = None,
    on_error: OnError = "stop",
    inputs: Mapping[str, str] | None = None,
    links: Mapping[str, Mapping[str, Any]] | None = None,
) -> NodeSpec:
    """Return a node's specification, as read from its table in a file."""
    return NodeSpec(
        name=name,
        type_name=f"{node.__module__}:{node.__name__}",
        on_error=on_error,
        inputs=dict(inputs or {}),
        links={
            port: convert(dict(link), LinkConfig, f"{name}.links.{port}")
            for port, link in (links or {}).items()
        },
        node=node,
        config=convert(dict(config or {}), node.config_type, name),
    )


_SCRIPTED: set[type[Node[Any]]] = set()


def any_source(node: type[N]) -> type[N]:
    """Let nodes of a class send under any source in `run_nodes`: a decorator for tests."""
    _SCRIPTED.add(node)
    return node


def _script(inputs: list[Event]) -> type[Node[Any]]:
    class Script(Node):
        script = Output(Event)

        def announce(self) -> Iterable[Announcement]:
            return [e for e in inputs if isinstance(e, Announcement)]

        async def run(self) -> None:
            for event in inputs:
                if not isinstance(event, Announcement):
                    if event.stamp > self.clock.now():
                        await self.clock.sleep_until(event.stamp)
                    self.script.send(event)

    return Script
