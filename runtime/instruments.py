"""Looking at the steps of a run's nodes while it runs, at no cost to those who do not look.

A *probe* is put around every call by which the loop gets into a node: a handler, a tick, a step
of a coroutine. All three take one argument, so one function serves for them. Attaching a probe
connects the run anew and exchanges what tickers and tasks call; detaching puts back what was
there. What a probe does with what it sees is its own business (`runtime.tools.tracing`,
`runtime.tools.monitor`).
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Protocol

from runtime.links import Link
from runtime.node import Node, senders
from runtime.schedule import Ticker
from runtime.sender import Deliver, Listener, Sender, Tap
from runtime.tasks import Steps
from runtime.workers.worker import Worker, _Process

if TYPE_CHECKING:
    from runtime.supervisor import Supervisor

Call = Callable[[Any], Any]


class Probe(Protocol):
    """What wants to look."""

    @property
    def tap(self) -> Tap | None:
        """What is to see every event before its listeners do."""

    def around(self, node: str, what: str, call: Call) -> Call:
        """Return a function that calls `call` with its argument, and looks on.

        Args:
            node: The node's name.
            what: The handler, the tick or the coroutine.
            call: Takes an event, a `Tick`, or what a coroutine is sent.
        """

    def asked(self, process: str, method: str, answer: Future[Any]) -> None:
        """Be told that a worker's process was asked to run a method, and of the answer to come."""


class Probes:
    """The probes of one run.

    Args:
        supervisor: Whose nodes they look at.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._probes: tuple[Probe, ...] = ()
        self._ticks: dict[Ticker, Call] = {}
        """What tickers call when nobody looks."""
        self._looked_at: dict[int, Listener] = {}
        """Listeners that are looked at, by the `id` of those they stand for and by their own."""

    def attach(self, probe: Probe) -> None:
        """Let a probe look from now on; on the loop, or before it runs."""
        self._probes += (probe,)
        self._renew()

    def detach(self, probe: Probe) -> None:
        """Let it look no more."""
        self._probes = tuple(p for p in self._probes if p is not probe)
        self._renew()

    # What the supervisor tells.

    def on_task(self, node: str, task: asyncio.Task[Any]) -> None:
        """Look at a task of a node, if its coroutine is one that streams can step."""
        steps = task.get_coro()
        if self._probes and isinstance(steps, Steps):
            steps._step = self._around(node, _short(steps.__name__), steps._coro.send)

    def on_ticker(self, ticker: Ticker) -> None:
        """Look at a ticker."""
        if self._probes:
            node, _, what = ticker.name.partition(".")
            ticker._call = self._around(node, what, self._ticks.setdefault(ticker, ticker._call))

    def on_worker(self, worker: Worker[Any]) -> None:
        """Look at the calls of a worker from now on."""
        if self._probes:
            for process in worker._processes:
                process.request = functools.partial(self._request, process)  # type: ignore[method-assign]

    def looking(self, listeners: list[Listener]) -> list[Listener]:
        """Return the listeners of nodes that are just being connected as those that are looked at.

        To be followed by `on_connected`.
        """
        self._looked_at.clear()
        return [self._listener(each) for each in listeners] if self._probes else listeners

    def on_connected(self, nodes: Iterable[Node[Any]], own: Iterable[Sender[Any]]) -> None:
        """Look at what nodes send that have just been connected, and at those who hear it.

        Args:
            nodes: All that are.
            own: Senders of the run itself.
        """
        if not self._probes:
            return
        taps = tuple(tap for probe in self._probes if (tap := probe.tap) is not None)
        for sender in [*(s for node in nodes for s in senders(node).values()), *own]:
            sender.connect(
                [self._listener(each) for each in sender._candidates],
                (*sender._taps, *taps),
                sender._fault,
            )

    def _renew(self) -> None:
        """Put the probes around all that is there."""
        for ticker, call in self._ticks.items():
            ticker._call = call
        self._ticks.clear()
        for name, life in self._supervisor._lives.items():
            for ticker in life.tickers:
                self.on_ticker(ticker)
            for task in life.tasks:
                steps = task.get_coro()
                if isinstance(steps, Steps):
                    steps._step = steps._coro.send
                self.on_task(name, task)
            for worker in life.workers:
                self.on_worker(worker)
        if self._supervisor._running:  # before, nodes must not be able to send
            self._supervisor.connect()

    def _request(self, process: _Process, message: Any) -> Future[Any]:
        answer = _Process.request(process, message)
        if isinstance(message[0], str):
            for probe in self._probes:
                probe.asked(process._name, message[0], answer)
        return answer

    def _around(self, node: str, what: str, call: Call) -> Call:
        for probe in self._probes:
            call = probe.around(node, what, call)
        return call

    def _listener(self, listener: Listener) -> Listener:
        """Return a listener that is looked at; a stream's reader is so already, by its task."""
        if listener.stream is not None or listener.node not in self._supervisor._lives:
            return listener
        if id(listener) not in self._looked_at:
            found = self._handler(listener)
            self._looked_at[id(listener)] = self._looked_at[id(found)] = found
        return self._looked_at[id(listener)]

    def _handler(self, listener: Listener) -> Listener:
        deliver = listener.deliver
        owner = getattr(deliver, "__self__", None)
        if isinstance(owner, Link):
            if owner._deliver is not None:
                owner._deliver = self._deliver(listener.node, owner._deliver)
            return listener
        return Listener(
            listener.node,
            self._deliver(listener.node, deliver),
            listener.events,
            listener.source,
        )

    def _deliver(self, node: str, deliver: Deliver) -> Deliver:
        name = getattr(getattr(deliver, "__func__", None), "__name__", "handler")
        looking = self._around(node, name, deliver)
        # By which the supervisor tells whose error it is that a listener raised.
        looking.__self__ = getattr(deliver, "__self__", None)  # type: ignore[attr-defined]
        return looking


def _short(name: str) -> str:
    """Return a coroutine's name without its class."""
    return name.rpartition(".")[2]
