"""Serves ROS 2: requests come as Zenoh's queries, and are answered beside the run.

What a service does is not for this module; see `services`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import functools
import threading
import time
from collections.abc import Awaitable, Callable
from typing import Any

from nodes.ros2.bridge.keys import Attachment, Complaints, Message, pack
from nodes.ros2.bridge.session import Answer, Session
from nodes.ros2.bridge.settings import Ros2BridgeConfig
from nodes.ros2.messages.topics import Qos, Topic, topic_name
from nodes.ros2.messages.typestore import MessageError, TypeStore
from runtime import Node
from runtime.errors import VisnavError

Serve = Callable[[Any], Awaitable[dict[str, Any]]]
"""Given a request, returns the fields of the response; a `VisnavError` becomes an error reply."""

Finish = Callable[[bytearray | str], None]

WAITING = 64
"""Requests that wait to be answered, at most."""


class ServiceServer:
    """Answers requests for one bridge."""

    def __init__(
        self,
        node: Node[Ros2BridgeConfig],
        session: Session,
        store: TypeStore,
        complaints: Complaints,
    ) -> None:
        self.node = node
        self.store = store
        self._session = session
        self._complaints = complaints
        self.loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._waiting = self._answered = 0
        self._closed = False
        # Not `Node.offload`: simulated time need not wait for whoever asked.
        self._out = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="answers")

    def declare(self, name: str, type_: str, serve: Serve) -> None:
        """Declare a service, relative to the namespace; called in any thread.

        Requests are answered by `serve` on the loop, as a task of the node.
        """
        for part in ("_Request", "_Response"):  # the first of each takes milliseconds
            written = self.store.serialize(self.store.zero(type_ + part))
            self.store.deserialize(bytes(written), type_ + part)
        name = topic_name(self.node.config.namespace, name)
        service = Topic(name=name, type=type_, hash=self.store.hash(type_))
        self._session.serve(service, functools.partial(self._take, service, serve))

    def publisher(self, name: str, type_: str, qos: Qos) -> Callable[..., None]:
        """Declare a topic, and return what publishes messages of given fields, in their turn."""
        self.store.serialize(self.store.zero(type_))  # the first takes milliseconds
        name = topic_name(self.node.config.namespace, name)
        topic = Topic(name=name, type=type_, hash=self.store.hash(type_), qos=qos)
        make, put = self.store.message(type_), self._session.publisher(topic).put
        return lambda **fields: self._send(put, self.store.serialize(make(**fields)))

    async def close(self) -> None:
        """Take no more requests, and wait until all answers are sent."""
        self._closed = True
        await self.node.offload(self._out.shutdown)
        self.node.log.info("%d requests answered", self._answered)

    def _take(self, service: Topic, serve: Serve, message: Message, answer: Answer) -> None:
        """Read a request, in a thread of Zenoh's, and hand it to the loop."""
        wrong, request, attachment = "", None, message.attachment
        most = self.node.config.max_message_size
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
                request = self.store.deserialize(message.read(), f"{service.type}_Request")
            except MessageError as error:
                wrong = f"expected a {service.type}_Request: {error}"
        finish = functools.partial(self._finish, service.name, answer, attachment)
        if wrong:
            finish(wrong)
            return
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            self.loop.call_soon_threadsafe(self._begin, service.type, serve, request, finish)

    def _begin(self, *request: Any) -> None:
        if not self._closed:
            self.node.start(self._answer(*request))

    async def _answer(self, type_: str, serve: Serve, request: Any, finish: Finish) -> None:
        reply: bytearray | str = "the run has ended"
        try:
            response = self.store.message(f"{type_}_Response")(**await serve(request))
            reply = self.store.serialize(response)
            self._answered += 1
        except Exception as error:  # what comes from outside must not end the run
            reply = str(error) if isinstance(error, VisnavError) else repr(error)
        finally:  # cancelled, too: whoever asked must not wait for ever
            finish(reply)

    def _finish(
        self, name: str, answer: Answer, request: Attachment | None, reply: bytearray | str
    ) -> None:
        if isinstance(reply, str):
            self._complaints.add(name, "request refused", reply)
        with self._lock:
            self._waiting -= 1
        attachment = b"" if request is None else pack(request._replace(stamp=time.time_ns()))
        self._send(answer, reply, attachment)

    def _send(self, *call: Any) -> None:
        with contextlib.suppress(RuntimeError):  # closed, and with it soon the session
            self._out.submit(*call)
