"""Serves ROS 2: requests come as Zenoh's queries, and are answered beside the run.

What a service does is not for this module; see `services`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
import time
from collections.abc import Awaitable, Callable
from typing import Any

from nodes.ros2_bridge.attachment import Attachment, Message, pack
from nodes.ros2_bridge.complaints import Complaints
from nodes.ros2_bridge.session import Answer, Session
from nodes.ros2_bridge.settings import Ros2BridgeConfig
from nodes.ros_messages.topics import Topic, topic_name
from nodes.ros_messages.typestore import MessageError, TypeStore
from runtime import Node
from runtime.errors import VisnavError

Serve = Callable[[Any], Awaitable[dict[str, Any]]]
"""Given a request, returns the fields of the response; a `VisnavError` becomes an error reply."""

WAITING = 64
"""Requests that wait to be answered, at most."""


class ServiceServer:
    """Answers requests for one bridge.

    Args:
        node: The bridge, whose tasks answer requests.
        session: Where requests come from.
        store: Of the types.
        complaints: Notes what is wrong.

    Attributes:
        answered: How many requests got a response.
        closed: Whether requests are taken no more.
    """

    def __init__(
        self,
        node: Node[Ros2BridgeConfig],
        session: Session,
        store: TypeStore,
        complaints: Complaints,
    ) -> None:
        self.answered = 0
        self.closed = False
        self._node = node
        self._session = session
        self._store = store
        self._complaints = complaints
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._waiting = 0
        # Not `Node.offload`: while time stands, what is awaited of it does not come.
        self._out = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="answers")

    def make(self, type_: str, **fields: Any) -> Any:
        """Return a message, for a field of a response."""
        return self._store.message(type_)(**fields)

    def declare(self, name: str, type_: str, serve: Serve) -> None:
        """Declare a service; called in any thread.

        Args:
            name: Relative to the namespace, or with a leading slash.
            type_: ``std_srvs/srv/Trigger``.
            serve: Answers; called on the loop as a task of the node.
        """
        for part in ("_Request", "_Response"):  # the first of each takes milliseconds
            written = self._store.serialize(self._store.zero(type_ + part))
            self._store.deserialize(bytes(written), type_ + part)
        full = topic_name(self._node.config.namespace, name)

        def take(message: Message, answer: Answer) -> None:
            self._take(full, type_, serve, message, answer)

        service = Topic(name=full, type=type_, hash=self._store.hash(type_))
        self._session.serve(service, take)

    def close(self) -> None:
        """Wait until all answers are sent; called in a thread, once requests are taken no more."""
        self._out.shutdown()

    def _take(self, name: str, type_: str, serve: Serve, message: Message, answer: Answer) -> None:
        """Read a request, in a thread of Zenoh's, and hand it to the loop."""
        wrong, request, attachment = "", None, message.attachment
        most = self._node.config.max_message_size
        with self._lock:
            self._waiting += 1
            waiting = self._waiting
        if waiting > WAITING:
            wrong = f"expected {WAITING} requests that wait or fewer"
        elif attachment is None:
            wrong = "expected an attachment with a number and a GID"
        elif message.size > most:
            wrong = f"expected {most} bytes or less, found {message.size}"
        else:
            try:
                request = self._store.deserialize(message.read(), f"{type_}_Request")
            except MessageError as error:
                wrong = f"expected a {type_}_Request: {error}"
        if wrong:
            self._done(name, answer, wrong)
            return
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            self._loop.call_soon_threadsafe(
                self._begin, name, type_, serve, request, attachment, answer
            )

    def _begin(self, name: str, *request: Any) -> None:
        if not self.closed:
            self._node.start(self._answer(name, *request))

    async def _answer(
        self,
        name: str,
        type_: str,
        serve: Serve,
        request: Any,
        attachment: Attachment,
        answer: Answer,
    ) -> None:
        reply: bytearray | str = "the run has ended"
        try:
            response = self._store.message(f"{type_}_Response")(**await serve(request))
            reply = self._store.serialize(response)
            self.answered += 1
        except VisnavError as error:
            reply = str(error)
        except Exception as error:  # what comes from outside must not end the run
            reply = f"{type(error).__name__}: {error}"
        finally:  # cancelled, too: whoever asked must not wait for ever
            self._done(name, answer, reply, pack(attachment._replace(stamp=time.time_ns())))

    def _done(
        self, name: str, answer: Answer, reply: bytearray | str, attachment: bytes = b""
    ) -> None:
        if isinstance(reply, str):
            self._complaints.add(name, "request refused", reply)
        with self._lock:
            self._waiting -= 1
        with contextlib.suppress(RuntimeError):  # closed, and with it soon the session
            self._out.submit(answer, reply, attachment)
