"""A snapshot, and a fake client."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import msgspec

from runtime.tools.monitor.protocol import Answer, Command, LogLine, Snapshot


def snapshot(**changes: Any) -> Snapshot:
    """Return a snapshot of a run with a drone, an estimator and a pilot."""
    default = Snapshot(
        headline="sample   1.500 of 60 s   2.00 × real time (as fast as it can)   runs",
        now=1.5,
        ended="",
        paused=False,
        fixed="",
        speed=2.0,
        tables={
            "estimators": [("vo", "tracking", "0.012", "0.31", "55.0")],
            "nodes": [
                ("drone", "running", "25.0%", "400", "1.25", "2"),
                ("pilot", "running", "25.0%", "400", "1.25", ""),
            ],
            "outputs": [("drone.images", "Image", "45", "30.0", "0.02", "40.00", "41.50")],
            "inputs": [("vo.images", "1", "1", "1", "7")],
            "links": [("pilot.fly", "3", "0")],
            "ticks": [("drone.control", "400", "600", "0", "12", "90")],
            "settings": [("pilot.gain", "1.0"), ("pilot.patience", "0.5")],
        },
        paths={"drone: truth": [(0.0, 0.0), (10.0, 0.0)], "vo": [(0.0, 0.0), (0.0, 5.0)]},
        cameras=["drone.images: drone/front"],
        log=[LogLine(number=0, level="WARNING", text="     0.500 WARNING  pilot: [b]wind[/b]")],
    )
    return msgspec.structs.replace(default, **changes)


class FakeClient:
    """Takes the place of a `Client`: yields the snapshots it is given, and keeps the commands."""

    def __init__(self, *snapshots: Snapshot | None) -> None:
        self.asked: list[Command] = []
        self.coming: asyncio.Queue[Snapshot | None] = asyncio.Queue()
        for snapshot in snapshots:
            self.coming.put_nowait(snapshot)

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until there is `None` instead."""
        while (snapshot := await self.coming.get()) is not None:
            yield snapshot

    async def ask(self, command: Command) -> Answer:
        """Remember a command."""
        self.asked.append(command)
        return Answer(done=True, text="done")
