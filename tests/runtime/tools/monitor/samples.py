"""A snapshot, and a fake client."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import msgspec

from runtime.errors import CommandError
from runtime.tools.monitor.command import Answer, Command
from runtime.tools.monitor.snapshot import (
    ClockState,
    InputState,
    LinkState,
    LogLine,
    NodeState,
    OutputState,
    Snapshot,
    TickState,
)


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
    common: dict[str, Any] = {"failures": 0, "share": 0.25, "steps": 400.0, "longest_ms": 1.25}
    found = Snapshot(
        run="sample",
        pid=1,
        number=1,
        ended="",
        clock=msgspec.structs.replace(clock, **of_clock),
        nodes=[
            NodeState(
                name="drone", type="m:D", condition="running", calls=2, settings={}, **common
            ),
            NodeState(
                name="pilot",
                type="m:P",
                condition="running",
                calls=0,
                settings={"gain": "1.0", "patience": "0.5"},
                **common,
            ),
        ],
        outputs=[
            OutputState(
                name="drone.images",
                event="Image",
                count=45,
                rate=30.0,
                age=0.02,
                latency_ms=40.0,
                latency_max_ms=41.5,
            )
        ],
        inputs=[InputState(name="vo.images", buffered=1, peak=1, bound=1, dropped=7)],
        links=[LinkState(name="pilot.fly", lost=3, thinned=0)],
        ticks=[
            TickState(
                name="drone.control", hz=400, calls=600, missed=0, late_p99_us=12, late_max_us=90
            )
        ],
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
