"""A snapshot, and a fake client."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import msgspec

from runtime.errors import CommandError
from runtime.tools.monitor.protocol import Answer, ClockState, Command, LogLine, Snapshot


def snapshot(**changes: Any) -> Snapshot:
    """Return a snapshot of a run with a drone and a pilot; `clock_…` changes its clock."""
    clock = ClockState(
        kind="lockstep",
        now=1.5,
        duration=60.0,
        speed=2.0,
        target_speed=None,
        paused=False,
        fixed="",
    )
    of_clock = {k.removeprefix("clock_"): v for k, v in changes.items() if k.startswith("clock_")}
    found = Snapshot(
        run="sample",
        pid=1,
        number=1,
        ended="",
        clock=msgspec.structs.replace(clock, **of_clock),
        tables={
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
        cameras=["drone.images: drone/front"],
        log=[
            LogLine(number=0, seconds=0.5, level="WARNING", logger_name="pilot", text="[b]wind[/b]")
        ],
    )
    rest = {k: v for k, v in changes.items() if not k.startswith("clock_")}
    return msgspec.structs.replace(found, **rest)


class FakeClient:
    """Takes the place of a `Client`: yields the snapshots it is given, and keeps the commands."""

    def __init__(self, *snapshots: Snapshot | None) -> None:
        self.asked: list[Command] = []
        self.coming: asyncio.Queue[Snapshot | None] = asyncio.Queue()
        for each in snapshots:
            self.coming.put_nowait(each)

    async def snapshots(self) -> AsyncIterator[Snapshot]:
        """Yield snapshots until there is `None` instead."""
        while (found := await self.coming.get()) is not None:
            yield found

    async def ask(self, command: Command) -> Answer:
        """Remember a command."""
        self.asked.append(command)
        return Answer(number=0, done=True, text="done")

    async def image(self, camera: str) -> bytes:
        """Return something for the one camera there is."""
        if camera != "drone.images: drone/front":
            raise CommandError(f"found {camera!r}")
        return b"\xff\xd8 a JPEG"
