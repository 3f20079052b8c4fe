"""When the turns of a lidar are made, above all when their ticks come late, as in real time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
import pytest

from runtime import Tick
from sims.sensors.lidar import LidarSpec
from sims.sensors.lidar_rig import LATE, LidarRig
from sims.vehicle import Physics
from tests.sims.vehicle.flight import compiled

MS = 1_000_000


class Scanning:
    """Stands for the node and its worker: notes which states are scanned."""

    log = logging.getLogger("scanning")

    def __init__(self) -> None:
        self.rng = np.random.default_rng([0])
        self.scanned: list[tuple[int, int]] = []
        self.turn: Callable[[Tick], None] = lambda _: None
        self.clock = self.lidar_scans = self
        self.model_bytes, self.dynamics = b"", None
        self.name = "drone"

    async def offload(self, call: Callable[[], Any]) -> Any:
        return call()

    async def worker(self, *_: Any) -> Any:
        return self

    def every(self, _: float, call: Callable[[Tick], None], __: str) -> None:
        self.turn = call

    def start(self, coro: Coroutine[Any, Any, None]) -> None:
        asyncio.run(coro)

    def now(self) -> int:
        return 0

    def send(self, _: Any) -> None:
        """Send nothing."""

    async def call_for(self, _: float, __: Any, ___: str, start: int, states: Any) -> None:
        self.scanned.append((start, len(states)))


def test_a_turn_that_ends_late_is_made_whole_and_one_that_ends_too_late_is_skipped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    physics, node = Physics(compiled(), "drone"), Scanning()
    spec = LidarSpec(name="lidar", rate=10.0)
    lidar: Any = type("Mounted", (), {"spec": spec, "source": "drone/lidar"})()

    def advance(tick: Tick) -> int:
        physics.advance_to(tick.stamp)
        return max(tick.stamp, physics.time_ns)

    rig: Any = LidarRig(node, [lidar], physics, advance)  # type: ignore[arg-type]
    asyncio.run(rig.start(node))
    late = round(LATE * 1e9)
    ends = [0, 100 * MS, 100 * MS + 150 * MS, 250 * MS + 100 * MS + late + 10 * MS]
    ends.append(ends[-1] + 100 * MS)
    for index, end in enumerate(ends):
        node.turn(Tick(end, index, 0, 0))
    assert node.scanned == [(ends[0], 101), (ends[1], 151), (ends[3], 101)]
    assert "turns skipped" in caplog.text
