"""The phases of nodes up to the first update, the same in a run and in a check of its file.

construct → on_startup, in file order
announce → on_announcement, check
on_ready, in file order
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection
from typing import Literal

from events import Announcement
from runtime.channels.sender import Voices
from runtime.errors import ChannelSourceError, NodeError
from runtime.run.node_runner import NodeRunner, wrap

Phase = Literal["on_startup", "announce", "check", "on_ready"]

Announced = dict[str, list[Announcement]]
"""What nodes announced, by the node's name."""

Step = Callable[[NodeRunner], Awaitable[None]]


async def start_up(
    runners: Collection[NodeRunner],
    *,
    start: Step,
    exchange: Callable[[Announced], Awaitable[list[Announcement]]],
    ready: Step | None = None,
    failed: Callable[[Phase, NodeRunner, NodeError], None],
    voices: Voices,
    give_up: Callable[[], bool] = lambda: False,
) -> None:
    """Take nodes through their phases up to the first update.

    Args:
        runners: In file order.
        start: Constructs a node and runs its `on_startup`.
        exchange: Given what the nodes here announce, returns what all nodes of the run announce.
        ready: Runs a node's `on_ready`; without it, that phase is left out.
        failed: Called when a node fails; if it returns, the next node follows.
        voices: Takes in who speaks for whom.
        give_up: Asked, once all nodes had their `on_startup`, whether to leave out what follows.
    """
    announced: Announced = {}
    for runner in runners:
        try:
            await start(runner)
        except NodeError as error:
            failed("on_startup", runner, error)
    if give_up():
        return
    for runner in runners:
        try:
            announced[runner.spec.name] = found = runner.announcements()
            for announcement in found:
                try:
                    voices.announce(runner.spec.name, announcement)
                except ChannelSourceError as error:
                    raise wrap(runner.spec.name, error) from error
        except NodeError as error:
            failed("announce", runner, error)
    everything = await exchange(announced)
    for runner in runners:
        try:
            runner.receive_announcements(everything)
        except NodeError as error:
            failed("check", runner, error)
    if ready is None:
        return
    for runner in runners:
        try:
            await ready(runner)
        except NodeError as error:
            failed("on_ready", runner, error)
