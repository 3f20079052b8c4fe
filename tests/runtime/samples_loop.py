"""A small closed loop, and a run of nodes that somebody looks at while it goes."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np

from events import Event, Image, ParameterChanged, PoseEstimate, VelocitySetpoint
from runtime import Duration, Input, Node, NodeConfig, Output, Tick, every, on
from runtime.changeable import Changeable
from runtime.channels.sender import Sender
from runtime.channels.wire import Digest
from runtime.config.model import Config, NodeSpec, RunConfig
from runtime.node import senders
from runtime.run import event_loop as task_factory
from runtime.run.execute import make_clock, make_loop
from runtime.run.supervisor import Supervisor

MS = 1_000_000


class Camera(Node):
    """Sends an image ten times a second, 20 ms after its exposure."""

    images = Output(Image)

    def __init__(self) -> None:
        self.data = np.zeros((2, 2), np.uint8)

    @every(hz=10)
    def expose(self, tick: Tick) -> None:
        self.start(self.deliver(tick.stamp))

    async def deliver(self, stamp: int) -> None:
        await self.clock.sleep(0.02)
        self.images.send(
            Image(stamp=stamp, source=f"{self.name}/front", frame_id="front", data=self.data)
        )


class Estimator(Node):
    """Says for each image, 10 ms after it, where the vehicle was."""

    images = Input(Image, keep="latest")
    estimates = Output(PoseEstimate)

    async def run(self) -> None:
        async for image in self.images:
            mean = await self.offload_for(0.01, np.mean, image.data)
            self.estimates.send(
                PoseEstimate(
                    stamp=image.stamp,
                    source=self.name,
                    frame_id="odom",
                    child_frame_id="base_link",
                    position=(float(mean), 0.0, 0.0),
                    orientation=(1.0, 0.0, 0.0, 0.0),
                )
            )


class PilotConfig(NodeConfig):
    """Settings of a pilot."""

    gain: Changeable[float] = 1.0
    height: float = 2.0


class Pilot(Node[PilotConfig]):
    """Answers each estimate at once with a set-point, and will not have a gain of 13."""

    setpoints = Output(VelocitySetpoint)

    def on_change(self, before: PilotConfig) -> None:
        if self.config.gain == 13:
            raise ValueError("expected a gain that brings no bad luck")

    @on(PoseEstimate)
    def fly(self, estimate: PoseEstimate) -> None:
        self.setpoints.send(
            VelocitySetpoint(
                stamp=self.clock.now(),
                source=self.name,
                frame_id="map",
                velocity=(self.config.gain, 0.0, 0.0),
            )
        )


class SteadyPilot(Pilot):
    """Sends set-points at a rate of its own, if it has heard where it is."""

    seen: PoseEstimate | None = None

    def fly(self, estimate: PoseEstimate) -> None: ...

    @on(PoseEstimate)
    def see(self, estimate: PoseEstimate) -> None:
        self.seen = estimate

    @every(hz=20)
    def tell(self, _: Tick) -> None:
        if self.seen is not None:
            super().fly(self.seen)


class Listener(Node):
    """Hears of changes of settings."""

    changes = Input(ParameterChanged)

    def __init__(self) -> None:
        self.heard: list[str] = []

    async def run(self) -> None:
        async for change in self.changes:
            self.heard.append(f"{change.source}.{change.key}={change.value}")


class Looked:
    """A run that is over."""

    def __init__(self, supervisor: Supervisor, sent: list[Event], digest: str) -> None:
        self.supervisor = supervisor
        self.sent = sent
        self.digest = digest


async def until_sent(supervisor: Supervisor, name: str, more: int) -> None:
    """Wait until a node has sent some more events, however slow the machine is."""

    def count() -> int:
        node = supervisor.state.runners[name].node
        return (
            0 if node is None else sum(sender.sent().total() for sender in senders(node).values())
        )

    begin = count()
    while count() < begin + more:
        await supervisor.state.clock.sleep(0.01)


Body = Callable[[Supervisor], Coroutine[Any, Any, None]]


async def after_start(supervisor: Supervisor, body: Body) -> None:
    """Await a body once the nodes have started; they take a few turns of the loop each."""
    for _ in range(100):
        if supervisor.state.first_update is not None:
            break
        await asyncio.sleep(0)
    await body(supervisor)


def look(
    nodes: list[NodeSpec],
    body: Body | None = None,
    *,
    duration: float = 1.0,
    clock: Any = "lockstep",
    watch: Callable[[Supervisor], contextlib.AbstractContextManager[Any]] | None = None,
) -> Looked:
    """Run nodes to their end, a coroutine beside them, and raise what went wrong."""
    config = Config(run=RunConfig(duration=Duration(duration), clock=clock), nodes=tuple(nodes))
    loop = make_loop(config.run)
    sent: list[Event] = []
    digest = Digest()

    def tap(sender: Sender[Any] | None, event: Event) -> None:
        sent.append(event)
        digest(sender, event)

    async def main() -> None:
        task_factory.install(loop)
        supervisor = Supervisor(config, make_clock(config.run, loop), [tap])
        beside = loop.create_task(after_start(supervisor, body)) if body else None
        with watch(supervisor) if watch else contextlib.nullcontext():
            await supervisor.main()
        if beside:
            await beside
        supervisor.state.clock.close()
        done.append(supervisor)

    done: list[Supervisor] = []
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(main())
    if done[0].state.error is not None:
        raise done[0].state.error
    return Looked(done[0], sent, digest.hexdigest())
