"""``run --twice``: two equal runs compared, with the first difference and its size.

The first of both runs writes nothing: so no program finds in a folder what it is judged by.
"""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Collection
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from events import Event
from runtime.channels.sender import Sender
from runtime.channels.wire import Digest
from runtime.config.model import Config
from runtime.errors import ConfigError
from runtime.run.execute import execute
from runtime.run.results import Folder
from runtime.summary import OutsideSummary, Summary, TwiceSummary

log = logging.getLogger("visnav.runtime")


class Track(Digest):
    """A digest with a memory of all events, to be compared with those of an equal run.

    Attributes:
        first: The first different event: output, event, and metres between the positions, if it
            has one.
    """

    def __init__(self, before: Track | None = None) -> None:
        super().__init__()
        self.first: tuple[str, Event, float] | None = None
        self._before = before
        self._marks: dict[str, array[int]] = {}  # by output: fingerprints so far, their half
        self._places: dict[str, array[float]] = {}

    def __call__(self, sender: Sender[Any] | None, event: Event) -> None:
        """Compare an event with the first run's event."""
        super().__call__(sender, event)
        name = self.name_of(sender, event)
        marks = self._marks.setdefault(name, array("Q"))
        marks.append(self.mark(name))
        place = getattr(event, "position", (math.nan,) * 3)
        if self._before is None:
            self._places.setdefault(name, array("d")).extend(place)
            return
        number, marks_before = len(marks) - 1, self._before._marks.get(name, array("Q"))
        if self.first is None and (
            number >= len(marks_before) or marks_before[number] != marks[number]
        ):
            place_before = self._before._places.get(name, array("d"))[3 * number : 3 * number + 3]
            self.first = (
                name,
                event,
                math.dist(place, place_before) if len(place_before) == 3 else math.nan,
            )


def run_twice(
    config: Config, out: Path | Folder | None, only: Collection[str], **options: Any
) -> Summary:
    """Run a configuration twice, and compare.

    Raises:
        ConfigError: Time is real, or other processes have a part in the run.
        VisnavError: Something went wrong in one of the runs.
    """
    if config.run.clock != "lockstep" or only:
        problem = "--only" if only else f'clock = "{config.run.clock}"'
        raise ConfigError(f'--twice: expected one process and clock = "lockstep", found {problem}')
    first = Track()
    before = execute(config, digest=first)
    second = Track(first)
    return execute(
        config,
        out,
        digest=second,
        complete=lambda summary: compared(before, summary, second),
        **options,
    )


def compared(before: Summary, after: Summary, track: Track) -> Summary:
    """Return the summary of the second run, with the comparison of both."""
    outputs = sorted(
        name
        for name in before.digests | after.digests
        if before.digests.get(name) != after.digests.get(name)
    )
    outside, systems = {}, []
    for name, system in after.outside.items():
        system_before = before.outside.get(name, system)
        outside[name] = _compare_systems(system_before, system)
        if (system_before.inputs, system_before.answers) != (system.inputs, system.answers):
            systems.append(name)
    same = not outputs and not systems
    twice = TwiceSummary(
        same, "" if same else _describe_first(after, track, outputs + systems), outputs
    )
    if not same:
        log.warning("run twice, it differs: %s", twice.first)
    return replace(after, outside=outside, twice=twice)


def _compare_systems(before: OutsideSummary, now: OutsideSummary) -> OutsideSummary:
    if before.inputs != now.inputs:
        reasons = [*now.why_not, "its inputs differed when run twice"]
        return replace(now, reproducible=False, why_not=reasons)
    return replace(now, repeats=before.answers == now.answers)


def _describe_first(summary: Summary, track: Track, differ: list[str]) -> str:
    if track.first is None:  # events are missing at the end of an output
        return f"{', '.join(differ)} at the end"
    output, event, distance = track.first
    node = output.partition(".")[0]
    outside = node in summary.outside or event.source in summary.outside
    distance_text = "" if math.isnan(distance) else f", {distance:.2g} m apart"
    return (
        f"{'the system ' + event.source if outside else 'the rig, ' + node}, in {output}: "
        f"{type(event).__name__} of {event.source}, {event.stamp / 1e9:.6f} s{distance_text}"
    )
