"""Methods that pause and step the run's time."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import TYPE_CHECKING

from runtime.errors import CommandError
from runtime.schedule import SECOND
from sims.airsim.server.methods import RpcError, rpc

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer


class Time:
    """Pausing and stepping."""

    def __init__(self, server: AirsimServer) -> None:
        self._stepping = server.stepping

    @rpc("simPause")
    def pause(self, is_paused: bool) -> None:
        """Let the run's time stand, or run on."""
        try:
            if is_paused:
                self._stepping.pause()
            else:
                self._stepping.resume()
        except CommandError as error:
            raise RpcError(str(error)) from None

    @rpc("simIsPaused")
    def is_paused(self) -> bool:
        """Return whether the run's time stands."""
        return self._stepping.state == "paused"

    @rpc("simContinueForTime")
    def continue_for_time(self, seconds: float) -> Awaitable[None]:
        """Let simulated time run for some seconds, and then stand; replies once it stands."""
        try:
            step = self._stepping.step(round(seconds * SECOND))
        except CommandError as error:
            raise RpcError(str(error)) from None

        async def stepped() -> None:
            await step

        return stepped()
