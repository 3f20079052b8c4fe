"""Notes of steps within steps, and of threads."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from runtime.channels.sender import Sender
from runtime.time.clock import Tick
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.tools.tracing.record import CHUNK, Spool, TraceInstrument
from tests.runtime.samples import Ping


def notes(path: Path, do: Any) -> list[Any]:
    """Return the notes of what a function does with a recorder."""
    loop = LockstepLoop()
    try:
        spool = Spool(path / "notes")
        recorder = TraceInstrument(LockstepClock(loop), spool)
        do(recorder)
        recorder.close()
        spool.close()
        return list(spool.read())
    finally:
        loop.close()
        assert not (path / "notes").exists()


def test_what_is_sent_after_an_inner_step_is_the_outer_ones(tmp_path: Path) -> None:
    sender = Sender("a.pings", Ping)
    given, reply = Ping(stamp=1, source="x"), Ping(stamp=2, source="a")

    def do(recorder: TraceInstrument) -> None:
        inner = recorder.wrap_call("b", "hear", lambda _: None)

        def outer(_: Any) -> None:
            recorder.event_sent(sender, reply)
            inner(reply)
            recorder.event_sent(sender, reply)

        recorder.wrap_call("a", "hear", outer)(given)
        recorder.event_sent(None, reply)

    first, within, second, around, outside = notes(tmp_path, do)
    assert first[-1] == second[-1] == around[-1] == id(given)
    assert (within[1:3], within[-1]) == (["b", "hear"], id(reply))
    assert outside[-1] == 0
    assert around[3] <= first[1] <= within[3] <= within[4] <= second[1] <= around[4]


def test_what_is_no_event_is_no_cause(tmp_path: Path) -> None:
    tick = Tick(stamp=1, index=0, late=0, missed=0)  # it may lie where an event lay

    def do(recorder: TraceInstrument) -> None:
        recorder.wrap_call(
            "a", "tick", lambda _: recorder.event_sent(None, Ping(stamp=1, source="a"))
        )(tick)

    event, step = notes(tmp_path, do)
    assert (event[-1], step[-1]) == (0, 0)


def test_the_order_is_kept_however_many_there_are(tmp_path: Path) -> None:
    def do(recorder: TraceInstrument) -> None:
        for n in range(3 * CHUNK):
            recorder.wrap_call("a", str(n), lambda _: None)(None)

    assert [note[2] for note in notes(tmp_path, do)] == [str(n) for n in range(3 * CHUNK)]


def test_threads_are_noted_with_what_they_did(tmp_path: Path) -> None:
    def do(recorder: TraceInstrument) -> None:
        with ThreadPoolExecutor(1, thread_name_prefix="beside") as inner:
            for divisor, result in ((2, (3, 1)), (0, None)):
                call = recorder.wrap_offload("a", functools.partial(divmod, 7, divisor), "divmod")
                answer = inner.submit(call)
                assert isinstance(answer.exception(), ZeroDivisionError) == (divisor == 0)
                assert result is None or answer.result() == result

    for note in notes(tmp_path, do):
        assert note[:4] == ["thread", "beside_0", "a", "divmod"]
        submitted, begin, end = note[4:]
        assert submitted <= begin <= end
