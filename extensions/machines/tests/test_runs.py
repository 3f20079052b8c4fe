"""One run in several processes is the run that it is in one."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from extensions.machines.tests.samples import Process, apart, settings
from runtime.errors import PeerError
from runtime.run.execute import execute
from visnav_machines.member import Outbox
from visnav_machines.messages import FinalSummary, Message

THREE: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("asker", "Asker", {}),
    ("one", "Answerer", {}),
    ("other", "Answerer", {"takes": 0.02}),
)


@pytest.mark.parametrize(
    "onlys",
    [
        ("asker", "one,other"),
        pytest.param(("one,other", "asker"), marks=pytest.mark.slow),
        pytest.param(("asker,other", "one"), marks=pytest.mark.slow),
        ("other", "one", "asker"),
    ],
    ids=str,
)
def test_in_lockstep_the_digest_is_that_of_one_process(onlys: tuple[str, ...]) -> None:
    """Also of answers that hold all that was heard before, in order."""
    config = settings(*THREE)
    alone = execute(config)
    for summary in apart(config, *onlys):
        assert summary.digests == alone.digests
        assert summary.digest == alone.digest
        assert summary.inputs_digest == alone.inputs_digest
        assert summary.outputs == alone.outputs
        assert summary.sim_seconds == alone.sim_seconds
        assert {*summary.streams} == {*alone.streams}
        assert [len(process.nodes) for process in summary.processes] == [
            len(only.split(",")) for only in sorted(onlys, key=lambda only: "aot".index(only[0]))
        ]


@pytest.mark.slow
def test_time_is_held_in_all_processes_for_a_system_outside_of_one() -> None:
    config = settings(
        ("asker", "Asker", {}), ("one", "Answerer", {}), ("slam", "Outside", {"takes": 0.03})
    )
    alone = execute(config)
    for summary in apart(config, "asker,one", "slam"):
        assert summary.digests == alone.digests
        assert summary.outside["slam"].answered == alone.outside["slam"].answered > 0
        assert summary.outside["slam"].reproducible


@pytest.mark.slow
def test_in_real_time_everything_crosses_too() -> None:
    config = settings(*THREE, clock="real", duration=0.6)
    one, other = apart(config, "asker", "one,other")
    assert one.outputs == other.outputs
    for output in ("asker.questions", "asker.images", "one.answers", "other.answers"):
        assert one.outputs[output] > 0  # how many is up to the machine
    for summary in (one, other):
        trips = [process.round_trip_ms for process in summary.processes]
        assert trips.count(None) < len(trips) or summary.processes[0].clock_offset_ms is None


@pytest.mark.slow
def test_nobody_leaves_before_all_have_heard_what_it_had_to_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Zenoh may tell that a process has gone before it delivers that one's last words."""
    send, late = Outbox.send, list[threading.Timer]()

    def send_late(line: Outbox, message: Message, *args: Any) -> None:
        if isinstance(message, FinalSummary) and not late:
            late.append(threading.Timer(0.2, send, (line, message)))
            late[0].start()
        else:
            send(line, message, *args)

    monkeypatch.setattr(Outbox, "send", send_late)
    one, other = apart(settings(*THREE, duration=0.1), "asker", "one,other")
    assert late
    assert one.outputs == other.outputs
    assert len(one.processes) == len(other.processes) == 2


@pytest.mark.slow
def test_handled_ends_the_delivery_in_its_own_process_only() -> None:
    """Both answerers hear the question though the first one handles it."""
    config = settings(
        ("asker", "Asker", {}), ("one", "Answerer", {"handles": True}), ("other", "Answerer", {})
    )
    assert "other.answers" not in execute(config).outputs
    both = apart(config, "asker,one", "other")[0].outputs
    assert both["other.answers"] > 0


def test_an_error_in_one_process_ends_all_and_says_whose_it_is() -> None:
    config = settings(("asker", "Asker", {}), ("refuser", "Refuser", {}))
    here, there = Process(config, "asker"), Process(config, "refuser")
    assert "refuser: no more" in str(there.done().error)
    assert isinstance(here.done().error, PeerError)
    assert "at refuser: refuser: no more" in str(here.error)


@pytest.mark.slow
def test_simulated_time_does_not_pass_while_processes_wait_for_one_another() -> None:
    """What is due meanwhile, as in a task that a node has begun, waits for the first update."""
    config = settings(("asker", "Restless", {}), ("one", "SlowAnswerer", {}), duration=0.2)
    alone = execute(config)
    for summary in apart(config, "asker", "one"):
        assert summary.digest == alone.digest
        assert summary.sim_seconds == alone.sim_seconds
