"""Links: delay, jitter, loss and rate on the way to a port."""

from __future__ import annotations

import asyncio
from typing import Any, NamedTuple

import pytest

from events import Event
from runtime import Bundle, Input, Node, Output, on
from runtime.channels.links import Link, LinkConfig
from runtime.errors import ConfigError, NodeError
from runtime.testing import run_in_lockstep, run_nodes, spec
from runtime.time.lockstep import LockstepClock
from runtime.units import Latency

MS, SECOND = 1_000_000, 1_000_000_000


class Said(Event):
    """Something to hear."""


class Heard(Event):
    """What came, and when."""

    of: int


class Ear(Node):
    """Tells what came when, by a stream."""

    said = Input(Said)
    heard = Output(Heard)

    def tell(self, event: Said) -> None:
        self.heard.send(Heard(stamp=self.clock.now(), source=self.name, of=event.stamp))

    async def run(self) -> None:
        async for event in self.said:
            self.tell(event)


class Handler(Ear):
    """The same by a handler, which ends the delivery."""

    @on(Said)
    def hear(self, event: Said) -> bool:
        self.tell(event)
        return True


class Single(NamedTuple):
    said: Said


class Bundled(Ear):
    """The same by a bundle."""

    sets = Bundle(Single)

    async def run(self) -> None:
        async for bundle in self.sets:
            self.tell(bundle.said)


EVENTS = [Said(stamp=ms * MS, source="x") for ms in range(0, 1000, 5)]


def listen(node: type[Ear], port: str, seed: int = 0, **link: Any) -> list[tuple[int, int]]:
    result = run_nodes(
        [spec(node, "ear", links={port: link})], inputs=EVENTS, duration=2.0, seed=seed
    )
    return [(event.of, event.stamp) for event in result.of(Heard)]


PORTS = [(Ear, "said"), (Bundled, "sets"), (Bundled, "sets.said")]


@pytest.mark.parametrize(("node", "port"), PORTS)
def test_a_delay_is_exact_and_nothing_is_lost(node: type[Ear], port: str) -> None:
    heard = listen(node, port, delay="80ms")
    assert heard == [(event.stamp, event.stamp + 80 * MS) for event in EVENTS]


@pytest.mark.parametrize(("node", "port"), PORTS)
def test_loss_is_at_random_and_the_same_for_a_seed(node: type[Ear], port: str) -> None:
    heard = listen(node, port, loss=0.3)
    assert 100 < len(heard) < 180
    assert heard == listen(node, port, loss=0.3)
    assert heard != listen(node, port, loss=0.3, seed=1)


@pytest.mark.parametrize(("node", "port"), PORTS)
def test_jitter_keeps_order_and_bounds(node: type[Ear], port: str) -> None:
    heard = listen(node, port, delay="10ms", jitter="20ms")
    assert [of for of, _ in heard] == [event.stamp for event in EVENTS]
    late = [now - of for of, now in heard]
    assert min(late) >= 10 * MS
    assert max(late) <= 30 * MS
    assert len(set(late)) > 50


@pytest.mark.parametrize(("node", "port"), PORTS)
def test_a_rate_thins_evenly(node: type[Ear], port: str) -> None:
    heard = listen(node, port, rate=10)
    assert [of // MS for of, _ in heard] == list(range(0, 1000, 100))


def test_each_source_has_its_own_rate() -> None:
    came: list[str] = []
    clock: Any = None  # which only a delay needs
    link = Link("ear.said", LinkConfig(rate=10), clock, seed=0)
    offer = link.to(lambda event: came.append(event.source))
    for stamp in range(0, 1000 * MS, 50 * MS):
        for source in ("x", "y"):
            offer(Said(stamp=stamp, source=source))
    assert came == ["x", "y"] * 10
    assert link.thinned == 20


def test_a_handler_behind_a_delay_is_called_later() -> None:
    heard = listen(Handler, "hear", delay="3ms")
    handled = [event for event in heard if event[1] - event[0] == 3 * MS]
    assert len(handled) == len(EVENTS)


def test_an_error_behind_a_delay_is_the_nodes() -> None:
    class Bad(Node):
        @on(Said)
        def hear(self, event: Said) -> None:
            raise RuntimeError("no")

    with pytest.raises(NodeError, match="bad: RuntimeError: no"):
        run_nodes([spec(Bad, "bad", links={"hear": {"delay": 0.1}})], inputs=EVENTS[:1])


@pytest.mark.parametrize(
    ("config", "ended"),
    [
        (LinkConfig(), [True, True]),
        (LinkConfig(loss=1.0), [False, False]),
        (LinkConfig(rate=1.0), [True, False]),
        (LinkConfig(delay=Latency(0.5)), [False, False]),
    ],
)
def test_only_an_event_that_was_handled_at_once_ends_a_delivery(
    config: LinkConfig, ended: list[bool]
) -> None:
    async def main() -> None:
        clock = LockstepClock(asyncio.get_running_loop())  # type: ignore[arg-type]
        offer = Link("ear.hear", config, clock, seed=0).to(lambda _: True)
        assert [offer(event) for event in EVENTS[:2]] == ended

    run_in_lockstep(main())


def test_an_error_behind_a_delay_is_raised_if_there_is_nobody_to_report_to() -> None:
    def refuse(_: Said) -> None:
        raise ValueError("no")

    async def main() -> None:
        clock = LockstepClock(asyncio.get_running_loop())  # type: ignore[arg-type]
        link = Link("ear.said", LinkConfig(delay=Latency(0.5)), clock, seed=0)
        faults: list[BaseException] = []
        link.to(refuse, faults.append)(EVENTS[0])
        assert clock.schedule.next_due() == 500 * MS
        clock.schedule.run_first(SECOND)
        assert [repr(fault) for fault in faults] == ["ValueError('no')"]
        link.to(refuse)(EVENTS[0])
        with pytest.raises(ValueError, match="no"):
            clock.schedule.run_first(2 * SECOND)
        link.close()
        link.offer(EVENTS[0])
        clock.schedule.run_first(3 * SECOND)
        assert (link.lost, link.thinned) == (0, 0)

    run_in_lockstep(main())


def test_mistakes_in_the_file() -> None:
    from runtime.config.reading import parse

    def read(links: Any) -> None:
        parse({"nodes": [{"name": "n", "type": f"{__name__}:Ear", "links": links}]}, "c.toml")

    with pytest.raises(ConfigError, match=r'links: expected an input or handler.*"sad"'):
        read({"sad": {"delay": 1}})
    with pytest.raises(ConfigError, match=r"links\.said\.loss: expected a number <= 1, found 2"):
        read({"said": {"loss": 2}})
    with pytest.raises(ConfigError, match=r"unknown key 'dealy' \(did you mean 'delay'"):
        read({"said": {"dealy": 2}})
