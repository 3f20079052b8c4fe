"""Estimators in ROS 2 with an answer owed to each image: messages and answers.

They get all messages of the node, complete and in order: an image after the IMU and the ``/clock``
of its arrival. Answers are read in the thread that takes them, and given to a `Hold`. Real time
decides nothing here.
"""

from __future__ import annotations

import concurrent.futures
import functools
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from events import Event
from nodes.ros2.bridge.incoming_topic import IncomingTopic
from nodes.ros2.bridge.keys import Message, Token
from nodes.ros2.bridge.session import Publisher, Session
from nodes.ros2.bridge.settings import Ros2BridgeConfig
from nodes.ros2.messages.mappings import PUBLISHED, publication
from nodes.ros2.messages.topics import Topic, topic_name
from nodes.ros2.messages.typestore import Stamps
from runtime import Node
from runtime.channels.hold import Hold, Owed
from runtime.errors import MissingAnswerError, suggest

WAITING = 64  # messages waiting to be published in real time; beyond this, images are dropped
SETTLED = 0.3  # real seconds without a new subscription until publishing begins
STORY = 0.5  # real seconds for a program of the run to end with an error of its own
CLOSING = 2.0  # real seconds for the remaining messages at the end of the run
_LOOK = 0.01  # real seconds between two polls of the subscriptions


class HeldEstimator:
    """An estimator in ROS 2: presence, images owed an answer, answers (estimates and ``done``).

    When its last publisher disappears, the hold is informed after `patience` real seconds.
    """

    def __init__(
        self,
        topics: Sequence[IncomingTopic],
        hold: Hold[Event],
        stamps: Stamps,
        config: Ros2BridgeConfig,
        patience: float,
    ) -> None:
        self.hold = hold
        self._patience = patience
        self.subscription = topics[0].subscription
        self._topics, self._stamps = topics, stamps
        self._max_size = config.max_message_size
        self._needs = [topic_name(config.namespace, need) for need in self.subscription.needs]
        images = [row.kind for row in PUBLISHED if row.image]
        publications = [publication(kind, self.subscription.answers_to, config) for kind in images]
        self._images = [row.name for row in publications if row is not None]
        self._sequences: dict[bytes, int] = {}  # by GID
        self._tokens: dict[str, None] = {}  # tokens of its publishers
        self._was_complete = self._is_gone = False
        self._answerers: set[bytes] = set()  # GIDs

    def follow(self, session: Session) -> None:
        """Subscribe to the answers, and watch the estimator's publishers; may block."""
        callbacks = [(t.topic, functools.partial(self._receive, t)) for t in self._topics]
        session.subscribe_in_order(callbacks)
        session.watch(self._topics[0].topic.name, "MP", self._changed)

    def missing(self, matched: Sequence[str]) -> str:
        """Return the missing publisher or subscriptions in words, given the matched topics."""
        parts = [] if self._tokens else [f"a publisher of {self._topics[0].topic.name}"]
        if unmatched := [name for name in self._needs if name not in matched]:
            parts.append(f"a subscription to {' and '.join(unmatched)}")
        elif not self._needs and not any(name in matched for name in self._images):
            parts.append(f"a subscription to {' or '.join(self._images)}")
        self._was_complete = self._was_complete or not parts
        return " and ".join(parts)

    def owe(self, image: Event, matched: Callable[[], Sequence[str]]) -> Owed[Event] | None:
        """Return the answer owed to an image about to go out, the exposure's first, or `None`."""
        if image.source != self.subscription.answers_to or image.stamp <= self.hold.newest:
            return None
        if self._is_gone and not self.missing(matched()):
            self._is_gone = False
            self._answerers.clear()
            self.hold.back()
        return self.hold.owe(image.stamp)

    def _receive(self, incoming: IncomingTopic, message: Message) -> None:
        try:
            if not self._is_next(incoming, message):
                return
            if message.size > self._max_size:
                expected = f"expected {self._max_size} bytes or less, found {message.size}"
                incoming.complain("message too large", expected)
            elif (answer := incoming.answer(message.read(), self._stamps)) is not None:
                self.hold.answer(*answer)
        except Exception as error:  # reported by the hold, as this thread has no caller
            self.hold.fail(error)

    def _is_next(self, incoming: IncomingTopic, message: Message) -> bool:
        """Return False for a repeated message; raise `MissingAnswerError` after a gap."""
        if (attached := message.attachment) is None:
            return True
        number = attached.sequence
        expected = self._sequences.get(attached.gid, number - 1) + 1
        if number < expected:
            incoming.complain("message repeated", f"number {number} again")
            return False
        self._sequences[attached.gid] = number
        if incoming is self._topics[0]:
            self._answerers.add(attached.gid)
            if len(self._answerers) > 1:
                self.hold.doubt(f"several publishers answer at {incoming.topic.name}")
        if number > expected:
            raise MissingAnswerError(
                f"{self.hold.name}: {incoming.topic.name}: expected message {expected} of its "
                f"publisher, found {number}: messages were lost on the way"
            )
        return True

    def _changed(self, present: bool, token: Token) -> None:
        """Record the presence or absence of a publisher of estimates; called in any thread."""
        if present:
            self._tokens[token.key] = None
            return
        self._tokens.pop(token.key, None)
        if self._was_complete and not self._tokens:
            late = threading.Timer(self._patience, self._report_missing)
            late.daemon = True
            late.start()

    def _report_missing(self) -> None:
        if not self._tokens:
            self.hold.gone(f"nobody publishes {self._topics[0].topic.name} any more")
            self._is_gone = True  # not before: `owe` reports it as back


def held_estimators(
    node: Node[Ros2BridgeConfig], incoming: Sequence[IncomingTopic], stamps: Callable[[], Stamps]
) -> list[HeldEstimator]:
    """Return the estimators of a node's subscriptions with owed answers, each with its hold."""
    estimators = []
    started = any(getattr(sibling.config, "feed", "") == "ros2" for sibling in node.siblings(Node))
    for topic in incoming:
        subscription = topic.subscription
        if subscription.use == "estimate" and subscription.answers_to:
            done_topics = [
                other for other in incoming if subscription.is_completed_by(other.subscription)
            ]
            hold = node.hold(topic.source, subscription.hold, subscription.latency)
            patience = STORY if started else 0.0
            estimators.append(
                HeldEstimator([topic, *done_topics], hold, stamps(), node.config, patience)
            )
    return estimators


class HeldLine:
    """Thread to publish messages in the order of the calls.

    In lockstep nothing is dropped: messages and simulated time wait for the estimators. In real
    time early messages are left out, and images when too many wait.
    """

    def __init__(
        self,
        node: Node[Any],
        session: Session,  # declares the publishers as held
        estimators: Sequence[HeldEstimator],
        deliver: Callable[[Event], None],  # sends an answer's event, at its time
    ) -> None:
        self.dropped = 0  # images left out
        self._node, self._session = node, session
        self._estimators, self._deliver = estimators, deliver
        self._publishers: list[Publisher] = []
        self._early: list[Callable[[], object]] | None = []
        self._waiting: queue.SimpleQueue[tuple[Callable[..., object], object] | None]
        self._waiting = queue.SimpleQueue()
        self._ready: concurrent.futures.Future[str] = concurrent.futures.Future()
        self._ready.set_running_or_notify_cancel()  # a run that ends meanwhile does not cancel it
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="publishes", daemon=True)

    def publisher(self, topic: Topic) -> Publisher:
        """Declare a topic."""
        declared = self._session.publisher(topic, held=True)
        declared.on_put = self._record_sent
        self._publishers.append(declared)
        return declared

    async def begin(self, first: Callable[[], object]) -> None:
        """Wait for the estimators, while time stands, and start publishing.

        Args:
            first: Publishes the messages that are valid for the whole run.

        Raises:
            FatalError: They do not appear in time.
        """
        self._thread.start()
        if missing := await self._node.clock.beside(self._ready):
            self._node.log.fatal("expected %s, found none", missing)
        self._waiting.put((lambda _: first(), None))
        early, self._early = self._early or [], None
        for publish in early:
            publish()

    def publish(self, call: Callable[..., object], value: object) -> None:
        """Call `call` with a value, after all earlier calls."""
        self._when_ready(self._waiting.put, (call, value))

    def publish_image(
        self, image: Event, publish: Callable[[Any], object], clock: Callable[[int], object]
    ) -> None:
        """Publish the time (`clock`, ns), then an image or a point cloud; hold for the answers."""
        self._when_ready(self._publish_image, image, publish, clock)

    async def close(self) -> None:
        """Publish the remaining messages; give up after `CLOSING` if a peer does not read."""
        self._closed.set()
        self._waiting.put(None)
        if self._thread.is_alive():
            await self._node.offload(self._thread.join, CLOSING)

    def _when_ready(self, call: Callable[..., object], *args: object) -> None:
        if self._early is None:
            call(*args)
        elif self._node.clock.kind == "lockstep":
            self._early.append(functools.partial(call, *args))

    def _publish_image(
        self, image: Event, publish: Callable[[Any], object], clock: Callable[[int], object]
    ) -> None:
        node = self._node
        if node.clock.kind == "real" and self._waiting.qsize() >= WAITING:
            self.dropped += 1
            return
        for estimator in self._estimators:
            if (owed := estimator.owe(image, self._matched)) is not None:
                node.start(self._answer(owed))
        self._waiting.put((clock, node.clock.now()))
        self._waiting.put((publish, image))

    async def _answer(self, owed: Owed[Event]) -> None:
        event = await owed
        if event is not None:
            self._deliver(msgspec.structs.replace(event, stamp=owed.stamp))

    # In the thread.

    def _work(self) -> None:
        try:
            for estimator in self._estimators:
                estimator.follow(self._session)
            self._ready.set_result(self._wait_for_estimators())
        except Exception as error:
            self._ready.set_exception(error)
        for call, value in iter(self._waiting.get, None):
            try:
                call(value)
            except Exception as error:  # reported by the holds, as this thread has no caller
                for estimator in self._estimators:
                    estimator.hold.fail(error)

    def _wait_for_estimators(self) -> str:
        """Wait for the estimators and their last subscription; return the missing ones in words."""
        start = unchanged_since = time.monotonic()
        end = start + max(estimator.subscription.timeout for estimator in self._estimators)
        matched: list[str] = []
        while True:
            now, before, matched = time.monotonic(), matched, self._matched()
            unchanged_since = unchanged_since if matched == before else now
            missing = "; ".join(filter(None, (e.missing(matched) for e in self._estimators)))
            if not missing and now > unchanged_since + SETTLED:
                return ""
            if now > end or self._closed.wait(_LOOK):
                return f"{missing or 'no further subscriptions'} within {end - start:g} s"

    def _matched(self) -> list[str]:
        return [publisher.topic.name for publisher in self._publishers if publisher.matched()]

    def _record_sent(self, publisher: Publisher, message: bytearray) -> None:
        """Add a message to the digest of each hold; raise if a subscriber does not read."""
        name = publisher.topic.name
        for estimator in self._estimators:
            estimator.hold.sent(name, message)
        if publisher.failed and not self._closed.is_set():
            raise MissingAnswerError(
                f"{name}: expected subscribers that read, found one that does not"
            )


def why_no_answers(
    config: Ros2BridgeConfig, rates: Mapping[str, float], *, lockstep: bool
) -> Iterator[str]:
    """Yield why estimators could never answer, given the announced rates of cameras and lidars."""
    for subscription in config.subscriptions:
        source, latency = subscription.answers_to, float(subscription.latency)
        if not source or subscription.use == "done":
            continue
        if source not in rates:
            yield (
                f"{subscription.topic}: answers_to: expected a camera or lidar that is announced, "
                f'found "{source}" (there are: {", ".join(rates) or "none"})'
                f"{suggest(source, rates)}"
            )
        elif any(subscription.is_completed_by(other) for other in config.subscriptions):
            continue
        elif (
            (lockstep and subscription.hold.skips == "allowed")
            and not subscription.hold.latencies
            and 0 < rates[source] * latency <= 1
        ):
            yield (
                f'{subscription.topic}: skips = "allowed": expected a latency above the period of '
                f"{source} ({1e3 / rates[source]:.4g} ms), found {latency * 1e3:g} ms: that an "
                "image was skipped is known by the answer to a later one, which is not sent while "
                'time stands for the first; or have a topic say what is done (as = "done")'
            )
