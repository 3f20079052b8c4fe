"""All benchmarks in one go; `bench.page` shows their results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from bench import (
    airsim,
    bridge,
    flood,
    held,
    idle,
    link,
    lockstep,
    parts,
    recording,
    ros_images,
    stall,
    throughput,
)
from bench.driver import Outcome, Row, measure_all
from bench.results import environment
from bench.system import NODES, CaseName


class Results(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that was measured; the content of ``results.json``."""

    environment: dict[str, str]
    quick: bool
    rows: list[Row]
    stall: list[stall.StallRow]
    throughput: list[throughput.ThroughputRow]
    idle: idle.IdleRow
    lockstep: list[lockstep.LockstepRow]
    parts: list[parts.PartRow] = []
    bridge: list[bridge.BridgeRow] = []
    link: list[link.LinkRow] = []
    held: list[held.HeldRow] = []
    ros_images: list[ros_images.RosImageRow] = []
    recording: list[recording.RecordingRow] = []
    flood: list[flood.FloodRow] = []
    airsim: list[airsim.AirsimRow] = []
    missing: dict[str, str]
    versions: dict[str, str]


QUICK_SYSTEMS = ("visnav", "plain", "asyncio.queue", "pyee", "thesis")
"""Parts of the names of what a quick run measures: what is quick to start."""


def measure(*, quick: bool, progress: Callable[..., None] = lambda *_: None) -> Results:
    """Run all benchmarks.

    Args:
        quick: Measure less: under two minutes.
        progress: Called with what is being measured, and the share of its part that is done.
    """
    few = (2, 16, 128)
    outcomes: list[Outcome] = []
    cases: list[tuple[CaseName, Sequence[int]]] = [
        ("small", few if quick else NODES),
        ("large", (2,) if quick else few),
        ("large-shared", (2,) if quick else few),
    ]
    for case, nodes in cases:
        outcome = measure_all(
            case,
            nodes=nodes,
            samples=20_000 if case == "small" else 1_000,
            warm_up=2_000 if case == "small" else 100,
            repeats=3 if case == "small" and not quick else 2,
            only=QUICK_SYSTEMS if quick else (),
            budget=0.3 if quick else 0.5,
            progress=progress,
        )
        outcomes.append(outcome)
    progress("throughput")
    through = throughput.measure()
    progress("idle")
    idling = idle.measure(3.0 if quick else 10.0)
    return Results(
        environment=environment(),
        quick=quick,
        rows=[row for outcome in outcomes for row in outcome.rows],
        stall=stall.measure(
            seconds=2.0 if quick else 6.0, repeats=2 if quick else 5, progress=progress
        ),
        throughput=through,
        idle=idling,
        lockstep=lockstep.measure(repeats=2 if quick else 5, progress=progress),
        parts=parts.measure(repeats=1 if quick else 5),
        **beside(quick=quick, progress=progress),
        missing={k: v for outcome in outcomes for k, v in outcome.missing.items()},
        versions={k: v for outcome in outcomes for k, v in outcome.versions.items()},
    )


def beside(*, quick: bool, progress: Callable[..., None] = lambda *_: None) -> dict[str, Any]:
    """Measure what goes on between processes and beside the loop, by field of `Results`."""
    return {
        "bridge": bridge.measure(200 if quick else 2000, progress),
        "link": link.measure(100 if quick else 1000),
        "held": held.measure(
            seconds=2.0 if quick else 8.0, repeats=1 if quick else 5, progress=progress
        ),
        "ros_images": ros_images.measure(50 if quick else 300),
        "recording": recording.measure(
            seconds=3.0 if quick else 5.0, repeats=1 if quick else 9, progress=progress
        ),
        "flood": flood.measure(windows=4 if quick else 30, progress=progress),
        "airsim": airsim.measure(rounds=1 if quick else 10, progress=progress),
    }
