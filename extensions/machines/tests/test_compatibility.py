"""Processes come together in any order, or say why they do not."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from extensions.machines.tests.samples import Process, settings
from runtime.errors import PeerError
from visnav_machines.handshake import check_fits, shared_settings
from visnav_machines.messages import Hello

TWO: tuple[tuple[str, str, dict[str, Any]], ...] = (("asker", "Asker", {}), ("one", "Answerer", {}))
NODES = ["drone", "tour", "odometry"]


def hello(*nodes: str, config: object = None, left_out: tuple[str, ...] = ()) -> Hello:
    return Hello(
        nodes=nodes,
        config={"nodes": [{"name": "drone", "rate": config}]},
        place="host, process 1",
        began=0.0,
        left_out=left_out,
    )


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (hello("tour", config=2), "found nodes[0].rate = 2 there, nothing here"),
        (hello("drone", "tour"), "found drone at host, process 1, too"),
        (hello("tour", left_out=("drone",)), "goes on without drone"),
    ],
)
def test_a_process_that_does_not_fit_is_told_why(other: Hello, said: str) -> None:
    mine = hello("drone")
    mine.config["nodes"][0].pop("rate")
    if other.config["nodes"][0]["rate"] is None:
        other.config["nodes"][0].pop("rate")
    with pytest.raises(PeerError) as raised:
        check_fits(mine, other, NODES)
    assert said in str(raised.value)


@pytest.mark.slow
def test_a_run_that_waits_in_vain_says_for_whom() -> None:
    config = settings(*TWO, ("other", "Answerer", {}), wait=0.3)
    process = Process(config, "one").done()
    assert isinstance(process.error, PeerError)
    assert "found none of asker, other" in str(process.error)
    assert str(process.error).endswith("start them with --only asker,other")


@pytest.mark.slow
def test_another_file_is_refused_and_the_right_one_still_welcome() -> None:
    right = settings(*TWO)
    wrong = settings(TWO[0], ("one", "Answerer", {"takes": 0.5}), meet=right.network.meet)
    first = Process(right, "asker").up()
    refused = Process(wrong, "one").done()
    assert "found nodes[1].takes = 0.005 there, 0.5 here" in str(refused.error)
    Process(right, "one").ended()
    assert first.ended().outputs["one.answers"] > 0


@pytest.mark.slow
def test_both_are_told_in_what_their_files_differ(caplog: pytest.LogCaptureFixture) -> None:
    first, second = (
        settings(*TWO, wait=3.0),
        settings(*TWO[:1], ("one", "Answerer", {"takes": 0.5})),
    )
    second = msgspec.structs.replace(second, network=first.network)
    waiting = Process(first, "asker").up()
    assert "takes = 0.005 there, 0.5 here" in str(Process(second, "one").done().error)
    assert "takes = 0.5 there, 0.005 here" in str(waiting.done().error)
    assert "left alone: expected the process" in caplog.text


def test_how_each_process_gets_there_and_what_it_logs_may_differ() -> None:
    """Through a tunnel, say, or with other certificates."""
    here = settings(*TWO, log="debug", stall=0, shared=False)
    there = settings(*TWO, meet="tcp/10.0.0.1:4711", wait=1.0)
    assert shared_settings(here) == shared_settings(there)
    assert shared_settings(here) != shared_settings(settings(*TWO, seed=1))
