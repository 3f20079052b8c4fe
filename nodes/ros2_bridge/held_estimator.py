"""An estimator in ROS 2 that owes an answer to each image: whether it is there, and what it says.

Its answers are read in the thread that takes them, and given to its `Hold`. What it is sent is for
`held_line`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence

from events import Event
from nodes.ros2_bridge.attachment import Message
from nodes.ros2_bridge.incoming_topic import IncomingTopic
from nodes.ros2_bridge.keys import Token
from nodes.ros2_bridge.session import Session
from nodes.ros2_bridge.settings import Ros2BridgeConfig, Subscription
from nodes.ros_messages.publications import TopicKind, publication
from nodes.ros_messages.stamps import Stamps
from nodes.ros_messages.topics import topic_name
from runtime.errors import MissingAnswerError, suggest
from runtime.hold import Hold, Owed

IMAGES: tuple[TopicKind, ...] = (
    "image",
    "mono",
    "compressed",
    "depth",
    "compressed_depth",
    "lidar",
)
"""Topics of which an estimator subscribes to one at least."""


class HeldEstimator:
    """One estimator: which images it answers, whether it is there, and its answers.

    Args:
        topics: Its subscriptions: that to its estimates first, and what says what it is done with.
        hold: Who waits for its answers.
        stamps: How times in messages become stamps.
        config: The node's settings.

    Attributes:
        subscription: To its estimates.
    """

    def __init__(
        self,
        topics: Sequence[IncomingTopic],
        hold: Hold[Event],
        stamps: Stamps,
        config: Ros2BridgeConfig,
    ) -> None:
        self.topics = topics
        self.hold = hold
        self._stamps = stamps
        self._config = config
        self.subscription = topics[0].subscription
        kinds = IMAGES
        possible = (publication(kind, self.subscription.answers_to, config) for kind in kinds)
        self._images = [each.topic for each in possible if each is not None]
        self._owed = -1  # stamp of the newest image
        self._sequences: dict[bytes, int] = {}  # by GID
        self._there: dict[str, None] = {}  # tokens of its publishers
        self._came = self._gone = False

    def follow(self, session: Session) -> None:
        """Take its answers from now on, and note when it comes and goes; may wait."""
        takes = [(each.topic, functools.partial(self._take, each)) for each in self.topics]
        session.subscribe_in_order(takes)
        session.watch(self.topics[0].topic.name, "MP", self._changed)

    def missing(self, matched: Sequence[str]) -> str:
        """Return what is not there of it, in words; empty if all is.

        Args:
            matched: Topics that somebody has subscribed to.
        """
        found = [] if self._there else [f"a publisher of {self.topics[0].topic.name}"]
        needs = [topic_name(self._config.namespace, each) for each in self.subscription.needs]
        if lacking := [each for each in needs if each not in matched]:
            found.append(f"a subscription to {' and '.join(lacking)}")
        elif not needs and not any(each in matched for each in self._images):
            found.append(f"a subscription to {' or '.join(self._images)}")
        self._came = self._came or not found
        return " and ".join(found)

    def owe(self, event: Event, matched: Callable[[], Sequence[str]]) -> Owed[Event] | None:
        """Return the answer that is owed to an image, the first of its stamp; else `None`.

        Args:
            event: The image, which is published now.
            matched: Returns the topics that somebody has subscribed to.
        """
        if event.source != self.subscription.answers_to or event.stamp <= self._owed:
            return None
        self._owed = event.stamp
        if self._gone and not self.missing(matched()):
            self._gone = False
            self.hold.back()
        return self.hold.owe(event.stamp)

    def _take(self, incoming: IncomingTopic, message: Message) -> None:
        """Take a message, in any thread."""
        try:
            if not self._is_next(incoming, message):
                return
            if message.size > (most := self._config.max_message_size):
                expected = f"expected {most} bytes or less, found {message.size}"
                incoming.complain("message too large", expected)
            elif (answer := incoming.answer(message.read(), self._stamps)) is not None:
                self.hold.answer(*answer)
        except Exception as error:  # not in a thread that nobody looks at
            self.hold.fail(error)

    def _changed(self, there: bool, token: Token) -> None:
        """Take note that a publisher of its estimates has come or gone, in any thread."""
        if there:
            self._there[token.key] = None
            return
        self._there.pop(token.key, None)
        if self._came and not self._there:
            self._gone = True
            self.hold.gone(f"nobody publishes {self.topics[0].topic.name} any more")

    def _is_next(self, incoming: IncomingTopic, message: Message) -> bool:
        """Tell whether a message is new; one that is missing before it ends the run."""
        if (attached := message.attachment) is None:
            return True
        before = self._sequences.get(attached.gid, attached.sequence - 1)
        if attached.sequence <= before:
            incoming.complain("message repeated", f"number {attached.sequence} again")
            return False
        self._sequences[attached.gid] = attached.sequence
        if attached.sequence > before + 1:
            self.hold.fail(
                MissingAnswerError(
                    f"{self.hold.name}: {incoming.topic.name}: expected message {before + 1} of "
                    f"its publisher, found {attached.sequence}: messages were lost on the way"
                )
            )
        return True


def why_no_answer(
    subscription: Subscription, rates: Mapping[str, float], *, told: bool
) -> Iterator[str]:
    """Yield why an estimator could never answer as its subscription says.

    Args:
        subscription: To its estimates.
        rates: Of what is announced, by source.
        told: Whether it says, on a topic of its own, what it is done with.
    """
    source, where = subscription.answers_to, f"{subscription.topic}: "
    if source not in rates:
        known = ", ".join(rates) or "none"
        yield (
            f'{where}answers_to: expected a camera or lidar that is announced, found "{source}" '
            f"(there are: {known}){suggest(source, rates)}"
        )
        return
    hold, rate, latency = subscription.hold, rates[source], subscription.latency
    if hold.skips == "allowed" and not told and not hold.latencies and 0 < rate * latency <= 1:
        yield (
            f'{where}skips = "allowed": expected a latency above {1e3 / rate:.4g} ms, the period '
            f"of {source}, found {latency * 1e3:g} ms: an image that was skipped is known by the "
            "answer to a later one, which is not sent while time stands for the first; or have the "
            'estimator say on a topic what it is done with (as = "done")'
        )
