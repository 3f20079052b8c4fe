"""Notes of steps within steps, and of threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from runtime.lockstep import LockstepClock, LockstepLoop
from runtime.schedule import Tick
from runtime.sender import Sender
from runtime.tools.tracing.record import OUTSIDE, NotingExecutor, Recorder
from runtime.tools.tracing.spool import CHUNK, Spool
from tests.runtime.samples import Ping


def notes(path: Path, do: Any) -> list[Any]:
    """Return the notes of what a function does with a recorder."""
    loop = LockstepLoop()
    try:
        spool = Spool(path / "notes")
        recorder = Recorder(LockstepClock(loop), spool)
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

    def do(recorder: Recorder) -> None:
        inner = recorder.around("b", "hear", lambda _: None)

        def outer(_: Any) -> None:
            recorder.tap(sender, reply)
            inner(reply)
            recorder.tap(sender, reply)

        recorder.around("a", "hear", outer)(given)
        recorder.tap(None, reply)

    first, within, second, around, outside = notes(tmp_path, do)
    assert first[-1] == second[-1] == around[-1] == id(given)
    assert (within[1:3], within[-1]) == (["b", "hear"], id(reply))
    assert outside[-1] == 0
    assert around[3] <= first[1] <= within[3] <= within[4] <= second[1] <= around[4]


def test_what_is_no_event_is_no_cause(tmp_path: Path) -> None:
    tick = Tick(stamp=1, index=0, late=0, missed=0)  # it may lie where an event lay

    def do(recorder: Recorder) -> None:
        recorder.around("a", "tick", lambda _: recorder.tap(None, Ping(stamp=1, source="a")))(tick)

    event, step = notes(tmp_path, do)
    assert (event[-1], step[-1]) == (0, 0)


def test_the_order_is_kept_however_many_there_are(tmp_path: Path) -> None:
    def do(recorder: Recorder) -> None:
        for n in range(3 * CHUNK):
            recorder.around("a", str(n), lambda _: None)(None)

    assert [note[2] for note in notes(tmp_path, do)] == [str(n) for n in range(3 * CHUNK)]


def test_threads_are_noted_with_what_they_did(tmp_path: Path) -> None:
    def do(recorder: Recorder) -> None:
        with ThreadPoolExecutor(1, thread_name_prefix="beside") as inner:
            executor = NotingExecutor(inner, recorder.beside.append)
            assert executor.submit(divmod, 7, 2).result() == (3, 1)
            assert isinstance(executor.submit(divmod, 7, 0).exception(), ZeroDivisionError)

    for note in notes(tmp_path, do):
        assert note[:4] == ["thread", "beside_0", OUTSIDE, "divmod"]
        submitted, begin, end = note[4:]
        assert submitted <= begin <= end
