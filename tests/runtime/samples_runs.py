"""Running a supervisor to its end on any clock, for tests."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from events import Event
from runtime import Duration
from runtime.channels.sender import Sender
from runtime.config.model import Config, NodeSpec, RunConfig
from runtime.node import Node
from runtime.run import event_loop as task_factory
from runtime.run.execute import make_clock, make_loop
from runtime.run.supervisor import Supervisor


class Outcome:
    """A supervisor whose run is over, and every event of that run."""

    def __init__(self, supervisor: Supervisor, sent: list[Event], seconds: float) -> None:
        self.supervisor = supervisor
        self.reason = supervisor.state.reason
        self.error = supervisor.state.error
        self.sent = sent
        self.seconds = seconds


def supervisor_of(node: Node[Any]) -> Supervisor:
    """Return the supervisor of a node's run, which a monitor is given and a node is not."""
    services: Any = node._host
    supervisor = services._fault.__self__
    assert isinstance(supervisor, Supervisor)
    return supervisor


def supervise(
    nodes: Iterable[NodeSpec], *, duration: float = 1.0, out: Path | None = None, **run: Any
) -> Outcome:
    """Run nodes to their end; keywords are settings of the run."""
    durations = {"stall", "startup_limit", "shutdown_limit"}
    run = {key: Duration(v) if key in durations else v for key, v in run.items()}
    config = Config(run=RunConfig(duration=Duration(duration), **run), nodes=tuple(nodes))
    loop = make_loop(config.run)
    sent: list[Event] = []

    def tap(_: Sender[Any] | None, event: Event) -> None:
        sent.append(event)

    async def main() -> Outcome:
        task_factory.install(loop)
        clock = make_clock(config.run, loop)
        supervisor = Supervisor(config, clock, [tap], out)
        try:
            await supervisor.main()
        finally:
            clock.close()
        return Outcome(supervisor, sent, clock.now() / 1e9)

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main())
