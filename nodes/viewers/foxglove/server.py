"""The library and its server: the only module that imports foxglove, and not before it is asked to.

The server has threads of its own. To make and log a small message takes about 4 µs where nobody
looks, and 30 µs where somebody does (most of it to wake such a thread): done on the loop.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from nodes.viewers.foxglove.gate import Gate, hidden_host
from nodes.viewers.foxglove.settings import FoxgloveConfig
from runtime.errors import MissingDependencyError, VisnavError
from runtime.extras import install_command

Make = Callable[[], Any]
"""Returns a message."""

_CLOSING = 2.0
"""Real seconds that viewers have to go."""


class Server:
    """A WebSocket server (``foxglove.sdk.v1``) and its topics.

    Args:
        config: Where to listen.
        name: As viewers show it.
        refused: Called, in a thread, with why somebody was not let in.

    Raises:
        MissingDependencyError: foxglove is not installed.
        VisnavError: It cannot listen there.
    """

    def __init__(
        self, config: FoxgloveConfig, name: str, refused: Callable[[str], None] = lambda _: None
    ) -> None:
        try:
            import foxglove
            import foxglove.channels
            import foxglove.messages
            import foxglove.websocket
        except ImportError as error:
            raise MissingDependencyError(
                f"the server needs foxglove ({error}): {install_command('foxglove')}"
            ) from error
        self.types: Any = foxglove.messages
        self._channel, self._schema = foxglove.Channel, foxglove.Schema
        self._typed = foxglove.channels
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._latched: dict[str, tuple[Make, int]] = {}
        self._lock = threading.Lock()
        inner = hidden_host()
        listener: Any = _Listener(self._subscribed)
        try:
            self._server = foxglove.start_server(
                name=name,
                host=inner,
                port=0,
                capabilities=[foxglove.websocket.Capability.Time],
                server_listener=listener,
                message_backlog_size=config.backlog,
                context=self._context,
            )
        except Exception as error:  # the library's own type is not public
            raise VisnavError(f"expected the library to listen here, found: {error}") from error
        try:
            inside = inner, self._server.port
            self._gate = Gate(config.host, config.port, inside, config.origins, refused)
        except OSError as error:
            self._server.stop()
            raise VisnavError(
                f"port: expected to listen on {config.host}:{config.port}, found: {error.strerror}"
            ) from error
        host = f"[{config.host}]" if ":" in config.host else config.host
        self.address = f"ws://{host}:{self._gate.port}"

    def declare(self, topic: str, kind: str) -> None:
        """Declare a topic of one of Foxglove's own types: ``CompressedImage``."""
        if topic not in self._channels:
            channel = getattr(self._typed, f"{kind}Channel")
            self._channels[topic] = channel(topic, context=self._context)

    def declare_ros(self, topic: str, type_: str, definition: str) -> None:
        """Declare a topic of ROS's messages, with their type and its definition."""
        schema = self._schema(name=type_, encoding="ros2msg", data=definition.encode())
        self._channels[topic] = self._channel(
            topic, schema=schema, message_encoding="cdr", context=self._context
        )

    def wanted(self, topic: str) -> bool:
        """Tell whether anybody looks at a topic."""
        return bool(self._channels[topic].has_sinks())

    def log(self, topic: str, message: Any, stamp: int) -> None:
        """Send a message to those who look; in any thread."""
        self._channels[topic].log(message, log_time=stamp)

    def latch(self, topic: str, make: Make, stamp: int) -> None:
        """Send what `make` returns now, and to whoever looks at the topic from now on."""
        with self._lock:
            self._latched[topic] = make, stamp
        if self.wanted(topic):
            self.log(topic, make(), stamp)

    def send_time(self, now: int) -> None:
        """Send the run's time (ns)."""
        self._server.broadcast_time(now)

    def close(self) -> None:
        """End the server; may take a moment.

        The library waits without end for whoever has connected and never sent a request, such as a
        browser that connects in advance: we do not.
        """
        stopping = threading.Thread(target=self._server.stop, name="foxglove stops", daemon=True)
        stopping.start()
        stopping.join(_CLOSING)
        self._gate.close()

    def _subscribed(self, topic: str) -> None:
        with self._lock:
            make, stamp = self._latched.get(topic, (None, 0))
        if make is not None:
            self.log(topic, make(), stamp)


class _Listener:
    """Gets subscriptions, in the server's threads."""

    def __init__(self, subscribed: Callable[[str], None]) -> None:
        self._subscribed = subscribed

    def on_subscribe(self, _: Any, channel: Any) -> None:
        """Send the topic's newest message to a viewer that has subscribed."""
        self._subscribed(channel.topic)

    def on_unsubscribe(self, _: Any, channel: Any) -> None:
        """Do nothing: the library counts."""
