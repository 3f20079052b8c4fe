"""The end of a run in several processes: nobody leaves before all know what each has to say."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import msgspec

from runtime.limits import real_time_limit
from runtime.peers.meeting import name_of
from runtime.peers.member import Member
from runtime.peers.messages import Parted
from runtime.peers.roster import Roster
from runtime.summary import ProcessSummary, Summary, merged

log = logging.getLogger("visnav.runtime")

PARTING = 5.0
"""Seconds that a process has, in the end, to tell what there was."""


async def part(roster: Roster, parted: Mapping[int, Member], mine: Summary) -> Summary:
    """Exchange what each process has to say of the run; return all of it together.

    Args:
        roster: Who is there.
        parted: Those who have said theirs, by their numbers; more come while this waits.
        mine: What there is to say here.
    """
    for member in roster.present():
        member.line.send(Parted(msgspec.json.encode(mine)))
    try:
        async with real_time_limit(PARTING):
            await roster.until(
                lambda: all(m.parted and m.has_ours for m in roster.present()), despite=True
            )
    except TimeoutError:
        silent = [name_of(m.nodes) for m in roster.present() if m.parted is None]
        log.warning("no summary of %s", "; ".join(silent))
    parts = {roster.me: mine}
    processes = {roster.me: ProcessSummary(list(roster.here), roster.hello.place)}
    for member in [*parted.values(), *roster.present()]:
        processes[member.number] = member.summary()
        if member.parted is not None:
            parts[member.number] = member.parted
    return merged(
        [part for _, part in sorted(parts.items())], [p for _, p in sorted(processes.items())]
    )
