"""Instruments of a run: what measures calls, tasks, tickers and workers while they are attached.

Attaching one connects the run anew and replaces the functions that tickers and coroutines call;
detaching restores them. A run without instruments does not even ask for them. For instruments see
`runtime.tools.tracing` and `runtime.tools.monitor`. The idea is trio's
(https://trio.readthedocs.io, Instrument API).
"""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from runtime.channels.sender import Deliver, Tap
from runtime.channels.tasks import ResumableCoroutine
from runtime.run.node_runner import NodeRunner
from runtime.time.clock import Ticker

if TYPE_CHECKING:
    from runtime.workers.worker import Worker


Call = Callable[[Any], Any]


class Instrument:
    """Base of all instruments; override the hooks you need.

    Attributes:
        event_sent: Called with each event and its sender, before the event's listeners are.
    """

    event_sent: Tap | None = None

    def wrap_call(self, node: str, what: str, call: Call) -> Call:  # noqa: ARG002
        """Return the function to call instead of `call`, the loop's entry into a node.

        Args:
            call: Takes an event, a `Tick`, or what a coroutine is sent.
        """
        return call

    def wrap_offload(
        self,
        node: str,  # noqa: ARG002
        call: Callable[[], Any],
        name: str,  # noqa: ARG002
    ) -> Callable[[], Any]:
        """Return the function for a thread to call instead of the offloaded `call`."""
        return call

    def worker_called(
        self, process: str, method: str, answer: concurrent.futures.Future[Any]
    ) -> None:
        """Note a method call in a worker's process, and the future of its answer."""


class Instruments:
    """The instruments of a run."""

    def __init__(self, runners: Mapping[str, NodeRunner], reconnect: Callable[[], None]) -> None:
        self._runners = runners
        self._reconnect = reconnect
        self._attached: tuple[Instrument, ...] = ()

    def attach(self, instrument: Instrument) -> None:
        """Attach an instrument; call on the loop, or before the loop runs."""
        self._attached += (instrument,)
        self._renew()

    def detach(self, instrument: Instrument) -> None:
        """Detach an instrument."""
        self._attached = tuple(other for other in self._attached if other is not instrument)
        self._renew()

    @property
    def attached(self) -> tuple[Instrument, ...]:
        """The attached instruments."""
        return self._attached

    # What the run asks while it connects senders and starts things.

    @property
    def taps(self) -> tuple[Tap, ...]:
        """Taps of the instruments, called with every event before its listeners."""
        taps = (instrument.event_sent for instrument in self._attached)
        return tuple(tap for tap in taps if tap is not None)

    def listener(self, node: str, deliver: Deliver) -> Deliver:
        """Return a handler, or the far end of a link, wrapped by all instruments."""
        if not self._attached:
            return deliver
        name = getattr(getattr(deliver, "__func__", None), "__name__", "handler")
        wrapped = self._wrapped(node, name, deliver)
        if wrapped is not deliver:  # the supervisor tells by this whose error a listener raised
            wrapped.__self__ = getattr(deliver, "__self__", None)  # type: ignore[attr-defined]
        return wrapped

    def on_ticker(self, ticker: Ticker) -> None:
        """Look at a ticker from now on."""
        node, _, what = ticker.name.partition(".")
        ticker.wrap_call(lambda call: self._wrapped(node, what, call))

    def on_task(self, node: str, task: asyncio.Task[Any]) -> None:
        """Look at a task of a node from now on, if streams can resume its coroutine."""
        coro = task.get_coro()
        if isinstance(coro, ResumableCoroutine):
            what = coro.__name__.rpartition(".")[2]
            coro.wrap_step(lambda step: self._wrapped(node, what, step))

    def on_worker(self, worker: Worker[Any]) -> None:
        """Look at the calls of a worker from now on."""
        worker.called = self._worker_called if self._attached else None

    def offloaded(self, node: str, call: Any) -> Callable[[], Any]:
        """Return a node's offloaded `functools.partial`, wrapped by all instruments."""
        name = getattr(call.func, "__qualname__", type(call.func).__name__)
        for instrument in self._attached:
            call = instrument.wrap_offload(node, call, name)
        return call  # type: ignore[no-any-return]

    def _renew(self) -> None:
        for name, runner in self._runners.items():
            for ticker in runner.tickers:
                self.on_ticker(ticker)
            for task in runner.tasks:
                self.on_task(name, task)
            for worker in runner.workers:
                self.on_worker(worker)
        self._reconnect()

    def _wrapped(self, node: str, what: str, call: Call) -> Call:
        for instrument in self._attached:
            call = instrument.wrap_call(node, what, call)
        return call

    def _worker_called(
        self, process: str, method: str, answer: concurrent.futures.Future[Any]
    ) -> None:
        for instrument in self._attached:
            instrument.worker_called(process, method, answer)
