"""What is published for estimators that owe answers: complete, and in the order of its events.

An estimator gets each image after the IMU and the ``/clock`` of the time at which the image
arrived. Nothing here decides by real time what is sent, or when.
"""

from __future__ import annotations

import concurrent.futures
import functools
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec

from events import Event
from nodes.ros2_bridge.held_estimator import HeldEstimator
from nodes.ros2_bridge.publisher import Publisher
from nodes.ros2_bridge.session import Session
from nodes.ros_messages.topics import Topic
from runtime import Node
from runtime.hold import Hold, Owed
from runtime.schedule import SECOND

WAITING = 8
"""Images that may wait to be published in real time; with so many, further ones are dropped."""

SETTLED = 0.3
"""Real seconds without a further subscription, after those that are needed, until it begins."""

CLOSING = 2.0
"""Real seconds that the end of the run waits for what is still to be published."""

_LOOK = 0.01
"""Real seconds between two looks at who has subscribed."""


class HeldPublisher:
    """Puts messages on a topic, and into the digest of what estimators are sent."""

    def __init__(self, publisher: Publisher, holds: Sequence[Hold[Event]]) -> None:
        self.topic: Final = publisher.topic
        self.publisher = publisher
        self._holds = holds

    @property
    def sent(self) -> int:
        """Return how many messages went out."""
        return self.publisher.sent

    def put(self, message: bytearray) -> None:
        """Put a message; its bytes may be overwritten afterwards."""
        for hold in self._holds:
            hold.sent(self.topic.name, message)
        self.publisher.put(message)


class Line:
    """Publishes beside the loop, one message after the other, in the order of asking.

    In lockstep nothing is dropped: what is to be published before the estimators are there waits
    for them, as does simulated time. In real time that is left out, and so are images when too many
    wait.

    Args:
        node: Whose messages these are.
        session: Whose publishers are made complete: reliable, and waiting for who reads slowly.
        estimators: Who is sent it all.
        deliver: Sends the event of an answer, at its time.

    Attributes:
        dropped: Images that were left out.
    """

    def __init__(
        self,
        node: Node[Any],
        session: Session,
        estimators: Sequence[HeldEstimator],
        deliver: Callable[[Event], None],
    ) -> None:
        self.dropped = 0
        self._node = node
        self._session = session
        self._estimators = estimators
        self._deliver = deliver
        self._lockstep = node.clock.kind == "lockstep"
        self._publishers: dict[str, HeldPublisher] = {}
        self._images: list[concurrent.futures.Future[Any]] = []
        """Which wait to be published."""
        self._early: list[Callable[[], object]] | None = []
        self._closed = threading.Event()
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "publishes")

    def publisher(self, topic: Topic) -> HeldPublisher:
        """Declare a topic."""
        holds = [each.hold for each in self._estimators]
        made = HeldPublisher(self._session.publisher(topic, held=True), holds)
        self._publishers[topic.name] = made
        return made

    async def begin(self) -> None:
        """Wait for the estimators, while time stands, and begin to publish.

        Raises:
            FatalError: They are not there in time.
        """
        node = self._node
        for each in self._estimators:
            await node.offload(each.follow, self._session)
        seconds = max(each.subscription.timeout for each in self._estimators)
        if missing := await node.offload(self._wait, seconds):
            node.log.fatal("expected %s within %g s, found none", missing, seconds)
        early, self._early = self._early or [], None
        for publish in early:
            publish()

    def publish(self, put: Callable[..., object], what: object) -> None:
        """Put something in its turn."""
        self._once_open(self._submit, put, what)

    def publish_image(
        self, image: Event, put: Callable[[Any], object], clock: Callable[[int], object]
    ) -> None:
        """Put an image or a point cloud in its turn, the time before it, and hold for its answers.

        Args:
            image: The event, which arrives now.
            put: Puts its messages.
            clock: Puts the time (ns).
        """
        self._once_open(self._publish_image, image, put, clock)

    async def close(self) -> None:
        """Publish what is still to be, unless a peer that does not read keeps it for `CLOSING`."""
        self._closed.set()
        if self._early is None:
            last = self._submit(bool, None)
            await self._node.offload(concurrent.futures.wait, [last], CLOSING)
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _once_open(self, call: Callable[..., object], *args: object) -> None:
        if self._early is None:
            call(*args)
        elif self._lockstep:
            self._early.append(functools.partial(call, *args))

    def _publish_image(
        self, image: Event, put: Callable[[Any], object], clock: Callable[[int], object]
    ) -> None:
        self._images = [each for each in self._images if not each.done()]
        if not self._lockstep and len(self._images) >= WAITING:
            self.dropped += 1
            return
        node = self._node
        for each in self._estimators:
            if (owed := each.owe(image, self._matched)) is not None:
                node.start(self._answer(owed))
        self._submit(clock, node.clock.now())
        self._images.append(self._submit(put, image))
        node.start(self._bound(self._images[-1]))

    async def _answer(self, owed: Owed[Event]) -> None:
        event = await owed
        if event is not None:
            self._deliver(msgspec.structs.replace(event, stamp=owed.stamp))

    async def _bound(self, work: concurrent.futures.Future[Any]) -> None:
        """Let time stand rather than have ever more wait to be published."""
        latency = min(each.subscription.latency for each in self._estimators)
        await self._node.clock.beside(work, round(latency * SECOND))

    def _submit(self, put: Callable[..., object], what: object) -> concurrent.futures.Future[Any]:
        work = self._thread.submit(put, what)
        work.add_done_callback(self._done)
        return work

    def _done(self, work: concurrent.futures.Future[Any]) -> None:
        if not work.cancelled() and (error := work.exception()) is not None:
            for each in self._estimators:
                each.hold.fail(error if isinstance(error, Exception) else RuntimeError(str(error)))

    def _matched(self) -> list[str]:
        """Return the topics that somebody has subscribed to."""
        return [name for name, each in self._publishers.items() if each.publisher.matched()]

    def _wait(self, seconds: float) -> str:
        """Wait until the estimators are there, and no further subscription comes for a while.

        Returns what is missing after so many seconds, in words.
        """
        end = time.monotonic() + seconds
        matched, since = self._matched(), time.monotonic()
        while True:
            now = time.monotonic()
            if (found := self._matched()) != matched:
                matched, since = found, now
            missing = "; ".join(filter(None, (each.missing(found) for each in self._estimators)))
            if (not missing and now > since + SETTLED) or now > end or self._closed.wait(_LOOK):
                return missing
