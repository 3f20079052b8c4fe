"""The summary of a run: from its state, the machine, versions, command line and commit."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from events import (
    Announcement,
    Category,
    EstimatorAnnouncement,
    PathAnnouncement,
    PilotAnnouncement,
)
from runtime.channels.wire import Digest, combined, fingerprint
from runtime.commit import commit
from runtime.json_values import plain
from runtime.node import matchers, senders, streams
from runtime.run.run_state import RunState
from runtime.summary import (
    LinkSummary,
    OutsideSummary,
    Stall,
    StreamSummary,
    Summary,
    TickSummary,
    WorkerSummary,
    verdict_of,
)
from runtime.time.clock import SECOND

if TYPE_CHECKING:
    from runtime.channels.answers import Answers


def environment() -> dict[str, str]:
    """Return the environment of a run's figures: machine, Python and library versions."""
    libraries = [
        "visnav-runtime", "numpy", "mujoco", "opencv-python-headless", "scipy", "uvloop", "msgspec",
    ]  # fmt: skip
    return {
        "system": f"{platform.system()} {platform.release().partition('-')[0]}",
        "processor": platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        **{library: _version(library) for library in libraries},
    }


@cache
def _version(library: str) -> str:
    """Return the version of an installed library; finding it takes 5 ms."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


_SECRET = re.compile(r"(secret\s*=\s*)(?!\W*(?:file|env):).*", re.DOTALL)
"""A secret in a command-line setting, unless given by ``file`` or ``env``."""


def command_line() -> str:
    """Return the command line of this process, without Python's folder and secrets."""
    program, *arguments = sys.orig_argv
    shown = [_SECRET.sub(r"\1…", argument) for argument in arguments]
    return shlex.join([Path(program).name, *shown])


def count_events(state: RunState) -> tuple[Counter[str], Counter[str]]:
    """Count the events sent so far, by type and by output."""
    by_type: Counter[str] = Counter()
    by_output: Counter[str] = Counter()
    for node in state.all_nodes:
        for sender in senders(node).values():
            for event, count in sender.sent().items():
                by_type[event.__name__] += count
                by_output[sender.name] += count
    return by_type, by_output


def count_drops(state: RunState) -> dict[str, StreamSummary]:
    """Return each input's bound, peak and drops."""
    summaries: dict[str, StreamSummary] = {}
    for node in state.all_nodes:
        missed = {port: matcher.missed for port, matcher in matchers(node).items()}
        for port, stream in streams(node).items():
            before = summaries.get(stream.name, StreamSummary(stream.bound, 0, 0))
            now = stream.statistics()
            summaries[stream.name] = StreamSummary(
                stream.bound,
                max(before.peak, now.peak),
                before.dropped + now.dropped,
                dict(Counter(before.missed) + Counter(missed.get(port, {}))),
            )
    return summaries


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


_INPUTS = Category.SENSOR | Category.GEOMETRY
_OF_OTHERS = (EstimatorAnnouncement, PathAnnouncement, PilotAnnouncement)


def inputs(state: RunState, outputs: Mapping[str, str]) -> dict[str, str]:
    """Return the fingerprints of what estimators are fed, by output and by announcement.

    An output counts if it has sent a sensor's event, a true pose or the wind (`_INPUTS`) in an
    announced name, or below one, but not in that of an estimator or a pilot: so what an estimator
    republishes does not. It counts as a whole, such as that of a replay, with all that was
    recorded. Announcements of such names count, too: calibration, noise.

    Args:
        outputs: Fingerprint of each output's events, by its name.
    """
    others = [a for a in state.announcements if isinstance(a, _OF_OTHERS)]
    inputs = [a for a in state.announcements if not _named(a.source, others)]
    digests = {f"{a.source} {type(a).__name__}": f"{fingerprint(a):016x}" for a in inputs}
    for node in state.all_nodes:
        for sender in senders(node).values():
            if any(event.category in _INPUTS for event in sender.sent()) and any(
                _named(source, inputs) and not _named(source, others) for source in sender.sources
            ):
                digests[sender.name] = outputs[sender.name]
    return dict(sorted(digests.items()))


def _named(source: str, announcements: Iterable[Announcement]) -> bool:
    return any(f"{source}/".startswith(f"{a.source}/") for a in announcements)


def summarise(
    state: RunState,
    *,
    digest: Digest | None,
    stalls: Counter[str],
    longest_stalls: dict[str, Stall],
) -> Summary:
    """Return the summary of a run at its end."""
    by_type, by_output = count_events(state)
    by_input = count_drops(state)
    ended = state.stopped or time.monotonic()
    digests = digest.outputs() if digest else {}
    fed = inputs(state, digests) if digest and state.running else {}
    return Summary(
        name=state.config.run.name,
        clock=state.clock.kind,
        seed=state.config.run.seed,
        reason=state.reason,
        ended_by=state.run_end.by if state.run_end is not None else "",
        error=None if state.error is None else str(state.error),
        sim_seconds=(state.clock.now() if state.stopped_at is None else state.stopped_at) / SECOND,
        wall_seconds=round(ended - (state.first_update or ended), 6),
        digest=combined(digests) if digest else None,
        digests=digests,
        inputs_digest=combined(fed) if digest else None,
        inputs=fed,
        not_deterministic=_not_deterministic(state),
        verdict=verdict_of(state.conclusions | _losses(state.outside), state.flights),
        events=dict(sorted(by_type.items())),
        outputs=dict(by_output),
        drops={port: s.dropped for port, s in by_input.items()},
        streams=by_input,
        links={link.name: LinkSummary(link.lost, link.thinned) for link in state.links.values()},
        ticks=tick_summaries(state),
        stalls=dict(stalls),
        longest_stalls=longest_stalls,
        truth_readers=sorted(state.truth_readers()),
        announcements=[
            {"type": type(a).__name__, **plain(a, a.source)} for a in state.announcements
        ],
        environment={
            **environment(),
            **state.environment,
            "command": command_line(),
            "commit": commit(),
        },
        code={
            name: key
            for name, key in state.code.items()
            if any(
                isinstance(a, EstimatorAnnouncement) and f"{a.source}/".startswith(f"{name}/")
                for a in state.announcements
            )
        },
        truth=state.truth,
        workers={
            name: WorkerSummary.of(costs)
            for name, costs in (
                state.costs | {k: a.costs for k, a in state.outside.items() if a.costs.calls}
            ).items()
        },
        outside={name: OutsideSummary.of(answers) for name, answers in state.outside.items()},
    )


def _not_deterministic(state: RunState) -> list[str]:
    nodes = {node.name for node in state.all_nodes if not node.deterministic}
    held = state.outside.items() if state.clock.kind == "lockstep" else ()
    return sorted(nodes | {name for name, answers in held if answers.why_not})


def _losses(outside: dict[str, Answers]) -> dict[str, dict[str, Any]]:
    return {
        f"{name} (answers)": {
            "passed": False,
            "lost_frames": lost,
            "failed": [f"lost_frames: expected at most {most}, found {lost}"],
        }
        for name, answers in outside.items()
        if (lost := answers.counts["lost"]) > (most := answers.lost_allowed)
    }
