"""From a vehicle's recent states to the scans of its lidars, made beside the loop."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from runtime import Node, Tick, Worker
from sims.cameras.rig import DrawnWorld
from sims.sensors.lidar import Lidar
from sims.sensors.scanner import Scanner
from sims.sensors.sensor import generator_of
from sims.vehicle import TIMESTEP_NS, Physics

LATE = 1.0
"""Seconds by which a turn may end late, as it may in real time; one that ends later is skipped."""


class LidarRig:
    """All lidars of one vehicle.

    A turn begins at one tick and ends at the next. It is then made from the states in which the
    vehicle was meanwhile, and sent `latency` after its end, with the stamp of its first ray.

    Args:
        node: The vehicle's node, with the output ``lidar_scans``.
        lidars: Its lidars.
        physics: The vehicle.
        advance: Steps the physics up to a tick, and returns the stamp of the state then.
    """

    def __init__(
        self,
        node: Node[Any],
        lidars: list[Lidar],
        physics: Physics,
        advance: Callable[[Tick], int],
    ) -> None:
        self._node: Any = node
        self._lidars = lidars
        self._physics = physics
        self._advance = advance
        self._scanner: Worker[Scanner] | None = None
        self._starts: dict[str, int] = {}
        self._in_flight = {lidar.source: 0 for lidar in lidars}
        self._skipped: set[str] = set()

    async def start(self, world: DrawnWorld) -> None:
        """Start what scans the world, and the turns; call it in `on_startup`."""
        if not self._lidars:
            return
        specs = tuple(lidar.spec for lidar in self._lidars)
        seed = int(generator_of(self._node.rng, "lidars").integers(1 << 31))
        model = await self._node.offload(lambda: world.model_bytes)
        self._scanner = await self._node.worker(
            Scanner, model, world.dynamics, specs, self._node.name, seed
        )
        self._physics.history.keep(max(1.0 / spec.rate for spec in specs) + LATE + 2e-3)
        for lidar in self._lidars:
            self._node.every(lidar.spec.rate, functools.partial(self._turn, lidar), lidar.spec.name)

    def _turn(self, lidar: Lidar, tick: Tick) -> None:
        """End the turn that began at the tick before, and begin the next."""
        end = self._advance(tick)
        start = self._starts.get(lidar.source, end)
        self._starts[lidar.source] = end
        if start == end or start < lidar.spec.startup_delay * 1e9:
            return
        on_their_way = math.ceil(lidar.spec.latency * lidar.spec.rate) + 1
        too_long = end - start > (1.0 / lidar.spec.rate + LATE) * 1e9
        # In real time it, or what calls this, may fall behind.
        if too_long or self._in_flight[lidar.source] > on_their_way:
            if lidar.source not in self._skipped:
                self._node.log.warning("%s: turns skipped, scanning is too slow", lidar.source)
            self._skipped.add(lidar.source)
            return
        stamps = range(start, end, TIMESTEP_NS)
        states = np.stack([self._physics.history.at(stamp)[0] for stamp in (*stamps, end)])
        self._in_flight[lidar.source] += 1
        self._node.start(self._deliver(lidar, start, end, states))

    async def _deliver(self, lidar: Lidar, start: int, end: int, states: Any) -> None:
        assert self._scanner is not None
        due = end + round(lidar.spec.latency * 1e9)
        wait = max(due - self._node.clock.now(), 0) / 1e9
        try:
            scan = await self._scanner.call_for(wait, Scanner.scan, lidar.spec.name, start, states)
        finally:
            self._in_flight[lidar.source] -= 1
        self._node.lidar_scans.send(scan)
