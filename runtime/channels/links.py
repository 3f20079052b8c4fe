"""Imperfect links: events delayed, lost or thinned out, in the run's own time.

Settings of node and port::

    [nodes.links.frames]
    delay = "80ms"
    jitter = "5ms"
    loss = 0.02
    rate = 10

Any input, handler, bundle, or field of a bundle may have one. Its effect depends on the run's
seed and the names of node and port only.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
import numpy as np

from runtime.time.clock import SECOND, Clock, Once
from runtime.units import Latency


class LinkConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Imperfections of a link to a port.

    Attributes:
        delay: Delay of every event.
        jitter: Most additional delay, at random; the order is kept.
        loss: Share of events lost, at random.
        rate: Most events a second, by their stamps; 0 for all.
    """

    delay: Latency = Latency(0)  # immutable
    jitter: Latency = Latency(0)
    loss: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    rate: Annotated[float, msgspec.Meta(ge=0)] = 0.0


class Link:
    """Link before a port; delivers each event later, or not at all.

    A handler behind a link with a delay cannot end a delivery: when it is called, the nodes after
    it have had the event.

    Args:
        before: Replaced link, whose figures are carried on.
    """

    def __init__(
        self, name: str, config: LinkConfig, clock: Clock, seed: int, before: Link | None = None
    ) -> None:
        self.name = name
        self.lost: int = before.lost if before else 0
        self.thinned: int = before.thinned if before else 0
        self._config = config
        self._clock = clock
        self._rng = np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(b"link")])
        self._deliver: Callable[[Any], Any] | None = None
        self._fault: Callable[[BaseException], None] = _raise_again
        self._last_period: dict[str, int] = {}  # by source
        self._last_due = 0

    def to(
        self, deliver: Callable[[Any], Any], fault: Callable[[BaseException], None] | None = None
    ) -> Callable[[Any], Any]:
        """Connect the far end to a receiver; return the function to call at this end."""
        self._deliver = deliver
        self._fault = fault or _raise_again
        return self.offer

    def close(self) -> None:
        """Stop delivering events: the receiver is gone."""
        self._deliver = None

    def offer(self, event: Any) -> bool:
        """Take an event (or a tuple of events, whose first has the stamp)."""
        config = self._config
        if config.rate and self._is_too_soon(event[0] if isinstance(event, tuple) else event):
            self.thinned += 1
            return False
        if config.loss and self._rng.random() < config.loss:
            self.lost += 1
            return False
        delay = float(config.delay)
        if config.jitter:
            delay += float(config.jitter) * self._rng.random()
        if not delay:
            return bool(self._deliver and self._deliver(event))
        due = max(self._clock.now() + round(delay * SECOND), self._last_due)
        self._last_due = due
        self._clock.schedule.add(due, Once(lambda: self._arrive(event)))
        return False

    def _arrive(self, event: Any) -> None:
        try:
            if self._deliver is not None:
                self._deliver(event)
        except BaseException as error:
            self._fault(error)

    def _is_too_soon(self, event: Any) -> bool:
        """Return whether a source already had an event in this period of the rate."""
        period = int(event.stamp * self._config.rate // SECOND)
        if self._last_period.get(event.source) == period:
            return True
        self._last_period[event.source] = period
        return False


def _raise_again(error: BaseException) -> None:
    raise error
