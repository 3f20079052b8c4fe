"""A node with work at 400 Hz, as a controller has it."""

from __future__ import annotations

from runtime import Node, Tick, every


class Ticker(Node):
    """Does next to nothing, on time."""

    @every(hz=400)
    def control(self, tick: Tick) -> None:
        """Be called."""
