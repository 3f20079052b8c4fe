"""A wire that is slow changes how long a run takes, and nothing else."""

from __future__ import annotations

import re

import msgspec
import pytest

from runtime.config.model import Config
from runtime.run.execute import execute
from tests.runtime.peers.relay import slow_wire
from tests.runtime.peers.samples import Process, settings
from tests.runtime.peers.test_runs import THREE

DELAY = 0.01


def at(config: Config, port: int) -> Config:
    network = msgspec.structs.replace(config.network, meet=f"tcp/127.0.0.1:{port}")
    return msgspec.structs.replace(config, network=network)


def port_of(config: Config) -> int:
    found = re.search(r":(\d+)$", config.network.meet)
    assert found is not None
    return int(found[1])


@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
def test_in_lockstep_the_digest_is_that_of_one_process(shared: bool) -> None:
    """Each process reaches the other where its own file says."""
    config = settings(*THREE, duration=0.2, shared=shared)
    with slow_wire(port_of(config), DELAY) as port:
        here = Process(config, "asker").up()
        there = Process(at(config, port), "one,other")
        alone = execute(config)
        for summary in (here.ended(), there.ended()):
            assert summary.digests == alone.digests
            assert summary.wall_seconds > 10 * DELAY  # there was a wire, and it was used


@pytest.mark.slow
def test_in_real_time_both_clocks_show_the_same() -> None:
    """Though a word takes a while: offsets are measured, and half a round trip is known."""
    config = settings(*THREE, clock="real", duration=0.5)
    with slow_wire(port_of(config), DELAY) as port:
        here = Process(config, "asker").up()
        there = Process(at(config, port), "one,other")
        one, other = here.ended(), there.ended()
    assert one.outputs == other.outputs
    (trip,) = (p.round_trip_ms for p in other.processes if p.round_trip_ms is not None)
    (offset,) = (p.clock_offset_ms for p in other.processes if p.clock_offset_ms is not None)
    assert trip >= 2e3 * DELAY
    assert abs(offset) <= trip / 2  # it is one machine, so 0 is the truth
