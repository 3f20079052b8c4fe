"""What a run reports of itself: ``summary.json`` and the table at its end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

import msgspec

from runtime.answers import Answers
from runtime.digest import Digest, combined
from runtime.environment import command_line, commit, environment
from runtime.json_values import plain
from runtime.node import matchers, senders, streams
from runtime.part_summaries import (
    LinkSummary,
    OutsideSummary,
    StreamSummary,
    TickSummary,
    TwiceSummary,
    WorkerSummary,
)
from runtime.run_state import RunState
from runtime.schedule import SECOND
from runtime.watchdogs.loop import Stall


class Verdict(msgspec.Struct, frozen=True):
    """How those did whom the run was about.

    Attributes:
        passed: Whether all met their thresholds; `None` if none failed and one was not judged.
        estimators: By source: ``passed``, and figures such as ``ate_rmse_m``.
    """

    passed: bool | None
    estimators: dict[str, dict[str, Any]]


class ProcessSummary(msgspec.Struct, frozen=True):
    """One of the processes of a run.

    Attributes:
        nodes: That ran in it.
        place: Host and process number.
        clock_offset_ms: Its monotonic clock, less that of the process whose summary this is.
        round_trip_ms: Of the quickest question and answer; the offset is off by half of it at most.
        clock_drift_ppm: How much quicker its clock is, in millionths, if ours follows it.
        waited: Most messages that waited for the network on their way there.
        replaced: Events that newer ones replaced on their way there.
    """

    nodes: list[str]
    place: str
    clock_offset_ms: float | None = None
    round_trip_ms: float | None = None
    clock_drift_ppm: float | None = None
    waited: int = 0
    replaced: int = 0


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Attributes:
        name: Of the run.
        clock: ``lockstep`` or ``real``.
        seed: Of the run's random numbers.
        reason: What ended it.
        ended_by: Who did: a node's name, ``user``, or "" for its duration; see `RunEnd`.
        error: What went wrong, or `None`.
        wall_seconds: Real seconds, from the first update to when the end was asked for.
        sim_seconds: The same time on the run's clock: what was sent, was sent in it.
        digest: Fingerprint of all events in order; equal for equal runs in lockstep. (Pixels
            depend on the graphics driver, so digests compare on one machine.) `None` if off.
        digests: Fingerprint of each output's events, of which that of the run is made.
        not_deterministic: Nodes because of which equal runs may have unequal digests.
        verdict: What nodes concluded; `None` if none did.
        events: Events sent, by type.
        outputs: Events sent, by output.
        drops: Events dropped, by input.
        streams: Inputs' bounds and peaks.
        links: What links did, by port.
        ticks: Punctuality, by ticker.
        stalls: Times the loop did not turn, by node.
        longest_stalls: The worst of them, by node.
        announcements: What nodes announced.
        truth_readers: Nodes that received true poses, but those that fly, judge, record or show.
        environment: Machine and versions; the command line, and the commit of the current folder.
        processes: Where which nodes ran, if not all in one process.
        workers: What workers cost, by ``node.Factory``, and programs, by their nodes.
        outside: How systems outside the process answered, by name.
        twice: How it compares with an equal run before; `None` if there was none.
    """

    name: str
    clock: str
    seed: int
    reason: str
    ended_by: str
    error: str | None
    sim_seconds: float
    wall_seconds: float
    digest: str | None
    digests: dict[str, str]
    not_deterministic: list[str]
    verdict: Verdict | None
    events: dict[str, int]
    outputs: dict[str, int]
    drops: dict[str, int]
    streams: dict[str, StreamSummary]
    links: dict[str, LinkSummary]
    ticks: dict[str, TickSummary]
    stalls: dict[str, int]
    longest_stalls: dict[str, Stall]
    truth_readers: list[str]
    announcements: list[dict[str, Any]]
    environment: dict[str, str]
    processes: list[ProcessSummary] = []
    workers: dict[str, WorkerSummary] = {}
    outside: dict[str, OutsideSummary] = {}
    twice: TwiceSummary | None = None


def count_events(state: RunState) -> tuple[Counter[str], Counter[str]]:
    """Count what was sent so far, by type of event and by output."""
    by_type: Counter[str] = Counter()
    by_output: Counter[str] = Counter()
    for node in state.all_nodes:
        for sender in senders(node).values():
            for event, count in sender.sent().items():
                by_type[event.__name__] += count
                by_output[sender.name] += count
    return by_type, by_output


def count_drops(state: RunState) -> dict[str, StreamSummary]:
    """Return how full each input got and what it dropped."""
    found: dict[str, StreamSummary] = {}
    for node in state.all_nodes:
        missed = {port: matcher.missed for port, matcher in matchers(node).items()}
        for port, stream in streams(node).items():
            before = found.get(stream.name, StreamSummary(stream.bound, 0, 0))
            now = stream.statistics()
            found[stream.name] = StreamSummary(
                stream.bound,
                max(before.peak, now.peak),
                before.dropped + now.dropped,
                dict(Counter(before.missed) + Counter(missed.get(port, {}))),
            )
    return found


def tick_summaries(state: RunState) -> dict[str, TickSummary]:
    """Return how punctual each ticker was."""
    return {
        name: TickSummary(
            hz=ticker.hz,
            calls=ticker.calls,
            late_p50_us=ticker.late.quantile(0.5) / 1e3,
            late_p99_us=ticker.late.quantile(0.99) / 1e3,
            late_max_us=ticker.late.maximum / 1e3,
            missed=ticker.missed,
        )
        for name, ticker in state.tickers.items()
    }


def summarise(
    state: RunState,
    *,
    digest: Digest | None,
    stalls: Counter[str],
    longest_stalls: dict[str, Stall],
) -> Summary:
    """Put together what is known at the end of a run."""
    by_type, by_output = count_events(state)
    by_input = count_drops(state)
    ended = state.stopped or time.monotonic()
    return Summary(
        name=state.config.run.name,
        clock=state.clock.kind,
        seed=state.config.run.seed,
        reason=state.reason,
        ended_by=state.end.by if state.end is not None else "",
        error=None if state.error is None else str(state.error),
        sim_seconds=(state.clock.now() if state.stopped_at is None else state.stopped_at) / SECOND,
        wall_seconds=round(ended - (state.first_update or ended), 6),
        digest=digest.hexdigest() if digest else None,
        digests=digest.outputs() if digest else {},
        not_deterministic=_not_deterministic(state),
        verdict=_verdict(state.conclusions | _losses(state.outside)),
        events=dict(sorted(by_type.items())),
        outputs=dict(by_output),
        drops={port: s.dropped for port, s in by_input.items()},
        streams=by_input,
        links={link.name: LinkSummary(link.lost, link.thinned) for link in state.links.values()},
        ticks=tick_summaries(state),
        stalls=dict(stalls),
        longest_stalls=longest_stalls,
        truth_readers=sorted(state.truth_readers),
        announcements=[
            {"type": type(a).__name__, **plain(a, a.source)} for a in state.announcements
        ],
        environment={
            **environment(),
            **state.environment,
            "command": command_line(),
            "commit": commit(),
        },
        workers={
            name: WorkerSummary.of(each)
            for name, each in (
                state.costs | {k: a.costs for k, a in state.outside.items() if a.costs.calls}
            ).items()
        },
        outside={name: OutsideSummary.of(each) for name, each in state.outside.items()},
    )


def _not_deterministic(state: RunState) -> list[str]:
    nodes = {node.name for node in state.all_nodes if not node.deterministic}
    held = state.outside.items() if state.clock.kind == "lockstep" else ()
    return sorted(nodes | {name for name, answers in held if answers.why_not})


def _losses(outside: dict[str, Answers]) -> dict[str, dict[str, Any]]:
    """Return a verdict on each system that has lost more frames than it may."""
    return {
        f"{name} (answers)": {
            "passed": False,
            "lost_frames": lost,
            "failed": [f"lost_frames: expected at most {most}, found {lost}"],
        }
        for name, answers in outside.items()
        if (lost := answers.counts["lost"]) > (most := answers.lost_allowed)
    }


def _verdict(found: dict[str, dict[str, Any]]) -> Verdict | None:
    if not found:
        return None
    return Verdict(overall(each["passed"] for each in found.values()), found)


def overall(passed: Iterable[bool | None]) -> bool | None:
    """Return what several verdicts are together: failed before not judged before passed."""
    each = set(passed)
    return False if False in each else None if None in each else True


def merged(parts: list[Summary], processes: list[ProcessSummary]) -> Summary:
    """Put together the summaries of one run's processes; where it runs together, once."""
    first = parts[0]
    digests = {name: each for part in parts for name, each in part.digests.items()}
    verdicts = [part.verdict for part in parts if part.verdict is not None]
    stalls: Counter[str] = Counter()
    events: Counter[str] = Counter()
    for part in parts:
        events.update(part.events)
        stalls.update(part.stalls)

    def of_all(field: str) -> dict[str, Any]:
        return {key: value for part in parts for key, value in getattr(part, field).items()}

    return msgspec.structs.replace(
        first,
        error=next((part.error for part in parts if part.error), None),
        sim_seconds=max(part.sim_seconds for part in parts),
        wall_seconds=max(part.wall_seconds for part in parts),
        digest=combined(digests) if all(part.digest for part in parts) else None,
        digests=dict(sorted(digests.items())),
        not_deterministic=sorted({node for part in parts for node in part.not_deterministic}),
        verdict=_verdict({k: f for v in verdicts for k, f in v.estimators.items()}),
        events=dict(sorted(events.items())),
        stalls=dict(stalls),
        longest_stalls=of_all("longest_stalls"),
        truth_readers=sorted({node for part in parts for node in part.truth_readers}),
        processes=processes,
        **{
            field: of_all(field)
            for field in ("outputs", "drops", "streams", "links", "ticks", "workers", "outside")
        },
    )
