"""Methods that pause and step the run's time, and the time that runs only for waiting clients."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, TypeVar

import msgspec

from runtime.time.schedule import SECOND, Once
from sims.airsim.server.methods import rpc
from sims.computer_vision import FreeCamera
from sims.multirotor import Multirotor

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

R = TypeVar("R")

LONGEST_STEP = 1_000_000_000
"""Seconds, and frames, of a step that a client may ask for."""

FRAMES_WITHOUT_CAMERAS = 60
"""Frames per second if no vehicle has a camera."""


class Time:
    """Pausing and stepping.

    With the server's setting ``time = "awaited"`` time runs while at least one future of a
    vehicle's task is not done (see `owed`) and no client has paused it, and stands otherwise.
    """

    def __init__(self, server: AirsimServer) -> None:
        self._server = server
        self._stepping = server.stepping
        self._awaited = server.config.time == "awaited"
        self._paused = server.config.time == "paused"
        self._owed = 0

    async def begin(self) -> None:
        """Let time stand from here on, unless it runs from the start; return once it does.

        Raises:
            CommandError: Time cannot be controlled.
        """
        if self._server.config.time != "running":
            self._stepping.pause()
            await self._stepping.stands()

    def owed(self, task: asyncio.Future[R]) -> asyncio.Future[R]:
        """Return a future for the reply to a vehicle's task.

        With ``time = "awaited"`` time runs until the task is done, and the reply comes once time
        stands at that instant, so that what a client does next finds all that was due by then
        done. While another task goes on, time runs on and the reply comes at once.

        Args:
            task: Done when the vehicle's task ends; cancelling the returned future leaves it.
        """
        if not self._awaited:
            return task
        reply: asyncio.Future[R] = task.get_loop().create_future()
        self._owed += 1
        self._apply()

        def ended(_: asyncio.Future[R]) -> None:
            self._owed -= 1
            self._apply()
            self._stepping.stands().add_done_callback(lambda _: _copy(task, reply))

        task.add_done_callback(ended)
        return reply

    @rpc("simPause")
    def pause(self, is_paused: bool) -> None:
        """Let the run's time stand, or run on; a run in real time cannot be paused."""
        if is_paused:
            self._stepping.pause()
        elif self._stepping.state != "running" and not self._awaited:
            self._stepping.resume()
        self._paused = is_paused
        self._apply()

    @rpc("simIsPaused")
    def is_paused(self) -> bool:
        """Return whether time stands by `simPause` or after a step."""
        return self._stepping.state == "paused" and (self._paused or not self._awaited)

    @rpc("simContinueForTime")
    def continue_for_time(
        self, seconds: Annotated[float, msgspec.Meta(ge=0.0, le=LONGEST_STEP)]
    ) -> Awaitable[None]:
        """Let **simulated** time run for some seconds, and then stand; replies once it stands."""
        return self._continue(round(seconds * SECOND))

    @rpc("simContinueForFrames")
    def continue_for_frames(
        self, frames: Annotated[int, msgspec.Meta(ge=0, le=LONGEST_STEP)]
    ) -> Awaitable[None]:
        """Let time run for some images of the fastest camera; without any, steps of 1/60 s."""
        multirotors, free = self._server.siblings(Multirotor), self._server.siblings(FreeCamera)
        rates = [camera.rate for each in multirotors for camera in each.config.cameras]
        rates += [each.config.rate for each in free]
        period = SECOND / Fraction(max(rates, default=FRAMES_WITHOUT_CAMERAS)).limit_denominator()
        now = self._server.clock.now()
        newest = math.ceil((now + 1) / period) - 1  # number of the last image by now, from 0
        return self._continue(max(int((newest + frames) * period) - now, 0))

    def _continue(self, ns: int) -> Awaitable[None]:
        if self._awaited and not self._paused:
            over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            clock = self._server.clock
            clock.schedule.add(clock.now() + ns, Once(lambda: over.set_result(None)))
            return self.owed(over)
        if ns > 0:
            step = self._stepping.step(ns)
        else:
            self._stepping.pause()
            step = self._stepping.stands()
        self._paused = True

        async def stepped() -> None:
            await step

        return stepped()

    def _apply(self) -> None:
        """Let time run if somebody waits for a vehicle, and else stand; a paused one stays."""
        if not self._awaited or self._paused:
            return
        if self._owed == 0:
            self._stepping.pause()
        elif self._stepping.state != "running":
            self._stepping.resume()


def _copy(task: asyncio.Future[R], reply: asyncio.Future[R]) -> None:
    """Give a reply the outcome of its task, unless nobody waits for it any more."""
    if reply.done():
        return
    if task.cancelled():
        reply.cancel()
    elif (error := task.exception()) is not None:
        reply.set_exception(error)
    else:
        reply.set_result(task.result())
