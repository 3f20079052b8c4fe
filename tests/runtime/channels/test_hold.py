"""Simulated time waits for answers from outside, and says what it did when none came."""

from __future__ import annotations

import asyncio
import concurrent.futures
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.channels import hold as hold_module
from runtime.channels.answers import Answers, Settled
from runtime.channels.hold import BEHIND, IN_A_ROW, Hold, HoldConfig, future
from runtime.errors import MissingAnswerError
from runtime.summary import OUTSIDE_COLUMNS, OutsideSummary
from runtime.testing import run_in_lockstep
from runtime.time.clock import RealClock
from runtime.time.lockstep import LockstepClock, LockstepLoop
from runtime.units import Duration

MS = 1_000_000
SECOND = 1000 * MS
PERIOD = 33 * MS


class Wall:
    """Real time that a test moves."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


def hold_in(
    loop: asyncio.AbstractEventLoop,
    wall: Wall,
    latency: float,
    log: Callable[[str], None] = lambda _: None,
    **config: Any,
) -> Hold[str]:
    assert isinstance(loop, LockstepLoop)
    return Hold("slam", LockstepClock(loop), HoldConfig(**config), latency, log=log, wall=wall)


def fly(
    act: Callable[[Hold[str], Wall, int], None],
    *,
    frames: int = 5,
    latency: float = 0.04,
    log: Callable[[str], None] = lambda _: None,
    **config: Any,
) -> tuple[list[tuple[int, str | None]], Hold[str]]:
    """Send frames, and return what came at which simulated time (ns).

    `act` is called in a thread after each frame has gone out, with its number.
    """
    wall = Wall()

    async def main() -> tuple[list[tuple[int, str | None]], Hold[str]]:
        loop = asyncio.get_running_loop()
        hold = hold_in(loop, wall, latency, log, **config)
        clock = LockstepClock(loop)  # type: ignore[arg-type]
        came: list[tuple[int, str | None]] = []

        async def deliver(owed: Any) -> None:
            value = await owed
            came.append((clock.now(), value))

        with concurrent.futures.ThreadPoolExecutor(1) as outside:  # in the order of the frames
            async with asyncio.TaskGroup() as tasks:
                for number in range(frames):
                    await clock.sleep_until(number * PERIOD)
                    tasks.create_task(deliver(hold.owe(number * PERIOD)))
                    outside.submit(act, hold, wall, number)
        hold.close()
        return came, hold

    return run_in_lockstep(main())


def answer_all(hold: Hold[str], wall: Wall, number: int) -> None:
    hold.answer(number * PERIOD, str(number))


def run_async(main: Coroutine[Any, Any, None]) -> None:
    run_in_lockstep(main)


class TestDelivery:
    def test_an_answer_comes_exactly_its_latency_after_the_frame(self) -> None:
        came, hold = fly(answer_all)
        assert came == [(n * PERIOD + 40 * MS, str(n)) for n in range(5)]
        assert hold.answers.counts == {"answered": 5}
        assert not hold.answers.why_not

    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 2**32))
    def test_what_comes_when_in_real_time_decides_nothing(self, seed: int) -> None:
        numbers = list(range(6))
        later: list[int] = []

        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            """Answer two frames at once, in any order, and some of them twice."""
            later.append(number)
            dice = random.Random(seed + number)
            if number % 2:
                dice.shuffle(later)
                for frame in [*later, *later[: dice.randrange(3)]]:
                    hold.answer(frame * PERIOD + dice.randrange(-900, 900), str(frame))
                later.clear()

        came, hold = fly(act, frames=len(numbers))
        assert came == [(n * PERIOD + 40 * MS, str(n)) for n in numbers]
        assert hold.answers.counts["answered"] == len(numbers)

    def test_the_real_time_that_an_answer_took_is_measured(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            wall.seconds += 0.25
            answer_all(hold, wall, number)

        _, hold = fly(act, latency=0.01)
        assert hold.answers.latency_quantiles(0.0, 1.0) == [0.25, 0.25]

    def test_time_stands_until_the_answer_is_in(self) -> None:
        waiting = threading.Event()

        async def main() -> None:
            loop = asyncio.get_running_loop()
            hold = hold_in(loop, Wall(), 0.04)
            owed = hold.owe(0)
            ticks: list[float] = []
            loop.call_later(0.039, lambda: ticks.append(loop.time()))
            loop.call_later(0.039, waiting.set)
            loop.call_later(0.041, lambda: ticks.append(loop.time()))

            def slow() -> None:
                assert waiting.wait(60)
                hold.answer(0, "pose")

            threading.Thread(target=slow).start()
            assert await owed == "pose"
            assert ticks == [0.039]
            assert loop.time() == 0.04

        run_async(main())

    def test_empty_answers_hold_nothing_and_come_in_time(self) -> None:
        came, hold = fly(lambda hold, _, n: hold.answer(n * PERIOD, None))
        assert [value for _, value in came] == [None] * 5
        assert hold.answers.counts == {"empty": 5}
        assert hold.answers.initialisation is None

    def test_a_later_answer_says_that_others_were_skipped_if_that_is_allowed(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number % 2:
                hold.answer(number * PERIOD, str(number))

        came, hold = fly(act, frames=6, latency=0.04, skips="allowed")
        assert came == [(n * PERIOD + 40 * MS, str(n) if n % 2 else None) for n in range(6)]
        assert hold.answers.counts == {"answered": 3, "skipped": 3}

    def test_answers_of_no_frame_are_counted(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            hold.answer(number * PERIOD + 5000, "of no frame")
            hold.answer((number + 10) * PERIOD, "of the future")
            answer_all(hold, wall, number)

        came, hold = fly(act, frames=3)
        assert [value for _, value in came] == ["0", "1", "2"]
        assert hold.answers.counts == {"answered": 3, "unknown": 6}

    @pytest.mark.parametrize(("off", "outcome"), [(1000, "answered"), (1001, "unknown")])
    def test_a_stamp_may_be_off_by_the_tolerance(self, off: int, outcome: str) -> None:
        async def main() -> None:
            for sign in (1, -1):
                hold = hold_in(asyncio.get_running_loop(), Wall(), 0.0, tolerance_ns=1000)
                hold.owe(0)
                hold.answer(sign * off, "pose")
                assert hold.answers.counts == {outcome: 1}
                hold.close()

        run_async(main())

    def test_the_newest_settled_frames_are_remembered(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(hold_module, "_REMEMBERED", 2)

        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            answer_all(hold, wall, number)
            if number == 2:
                for frame in range(3):
                    answer_all(hold, wall, frame)

        _, hold = fly(act, frames=3)
        assert hold.answers.counts == {"answered": 3, "unknown": 1, "repeated": 2}

    def test_stamps_must_rise(self) -> None:
        async def main() -> None:
            hold = hold_in(asyncio.get_running_loop(), Wall(), 0.04)
            hold.owe(5)
            with pytest.raises(ValueError, match=r"slam: expected a frame after 0\.000000 s"):
                hold.owe(5)
            hold.close()

        run_async(main())


class TestMissing:
    def silent_after(self, last: int) -> Callable[[Hold[str], Wall, int], None]:
        """Return a system that answers up to a frame; after that, real time runs."""

        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number <= last:
                answer_all(hold, wall, number)
            else:
                wall.seconds += 10.1
                hold.look()

        return act

    def test_an_error_names_the_frame_and_what_there_was(self) -> None:
        with pytest.raises(ExceptionGroup) as caught:
            fly(self.silent_after(2), latency=0.01)
        (error,) = caught.value.exceptions
        assert isinstance(error, MissingAnswerError)
        assert str(error) == (
            "slam: expected an answer to the frame of 0.099000 s within 10 s (max_wait), found "
            "none (4 frames sent, 3 answered, 0 answers of no frame)"
        )

    def test_lost_frames_count_and_the_next_are_waited_for(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number == 2:
                wall.seconds += 10.1
                hold.look()
                hold.answer(2 * PERIOD, "too late")
            else:
                answer_all(hold, wall, number)

        came, hold = fly(act, latency=0.01, on_missing="lost")
        assert [value for _, value in came] == ["0", "1", None, "3", "4"]
        assert hold.answers.counts == {"answered": 4, "lost": 1, "late": 1}
        assert list(hold.answers.why_not) == ["frames were lost after 10 s of real time"]

    def test_one_that_hangs_is_not_waited_for_again(self) -> None:
        came, hold = fly(self.silent_after(1), frames=40, latency=0.01, on_missing="lost")
        assert len(came) == 40
        assert hold.answers.counts == {"answered": 2, "lost": 38}
        assert hold._wall() <= 100 + 10.1 * (IN_A_ROW + 38)

    def test_after_losses_in_a_row_all_frames_are_lost_at_once_until_an_answer(self) -> None:
        async def main() -> None:
            wall, log = Wall(), list[str]()
            hold = hold_in(
                asyncio.get_running_loop(), wall, 1.0, log.append, on_missing="lost", max_wait=9.0
            )
            for number in range(IN_A_ROW + 1):
                hold.owe(number * PERIOD)
            for losses in range(1, IN_A_ROW):
                wall.seconds += 9.0
                hold.look()
                assert hold.answers.counts == {"lost": losses}
                assert hold.expects
            wall.seconds += 9.0
            hold.look()
            assert not hold.expects
            assert log[-2:] == [
                "slam: expected an answer to the frame of 0.066000 s within 9 s (max_wait), found "
                "none: the frame is lost",
                "slam: 3 frames in a row are lost: it is not waited for again before it answers",
            ]
            hold.owe(SECOND)
            assert hold.answers.counts == {"lost": IN_A_ROW + 2}
            hold.answer(0, "late")
            assert log[-1] == "slam: it answers again"
            hold.answer(0, "late")
            assert log.count("slam: it answers again") == 1
            assert hold.expects
            hold.owe(2 * SECOND)
            hold.look()
            assert hold.answers.counts == {"lost": IN_A_ROW + 2, "late": 2}
            hold.close()

        run_async(main())

    def test_a_thread_gives_up_also_after_it_had_nothing_to_do(self) -> None:
        async def main() -> None:
            wall = Wall()
            hold = hold_in(asyncio.get_running_loop(), wall, 0.01, on_missing="lost")
            hold.owe(0)
            hold.answer(0, "pose")
            # Really: the thread has to see that nothing is owed.
            time.sleep(0.05)  # noqa: ASYNC251
            owed = hold.owe(PERIOD)
            wall.seconds += 10.1
            assert await owed is None
            hold.close()

        run_async(main())

    def test_an_answer_ends_losses_in_a_row(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number in {0, 1, 3, 4}:
                wall.seconds += 10.1
                hold.look()
            else:
                answer_all(hold, wall, number)

        came, _ = fly(act, frames=6, latency=0.01, on_missing="lost")
        assert [value for _, value in came] == [None, None, "2", None, None, "5"]

    def test_continue_waits_no_more_and_says_so(self) -> None:
        async def main() -> None:
            loop = asyncio.get_running_loop()
            wall = Wall()
            log: list[str] = []
            hold = hold_in(loop, wall, 0.01, log.append, on_missing="continue")
            task = asyncio.create_task(_value(hold.owe(0)))
            await asyncio.sleep(0)
            wall.seconds += 11
            hold.look()
            await asyncio.sleep(1.0)  # time goes on without
            assert not task.done()
            hold.answer(0, "when it comes")
            assert await task == "when it comes"
            assert log == [
                "slam: expected an answer to the frame of 0.000000 s within 10 s (max_wait), found "
                "none; the run goes on without",
                "slam: it answers again",
            ]
            assert list(hold.answers.why_not) == ["the run went on without an answer"]
            hold.close()

        run_async(main())

    def test_progress_is_what_counts_not_how_long_one_has_waited(self) -> None:
        async def main() -> None:
            wall = Wall()
            hold = hold_in(asyncio.get_running_loop(), wall, 1.0)
            owed = [hold.owe(n * PERIOD) for n in range(5)]
            for n in range(5):
                wall.seconds += 9.0
                hold.look()
                hold.answer(n * PERIOD, str(n))
            assert [await future for future in owed] == ["0", "1", "2", "3", "4"]
            hold.close()

        run_async(main())


class TestGone:
    def test_the_end_of_a_system_is_an_error_at_once(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number == 1:
                hold.gone("ended with exit code 3")
            else:
                answer_all(hold, wall, number)

        with pytest.raises(ExceptionGroup) as caught:
            fly(act, latency=0.01)
        assert str(caught.value.exceptions[0]).startswith("slam: ended with exit code 3 (2 frames")

    @pytest.mark.parametrize("policy", ["lost", "continue"])
    def test_frames_are_lost_while_it_is_away_and_owed_when_it_is_back(self, policy: str) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number == 1:
                hold.gone("killed")
                assert not hold.expects
            elif number == 3:
                hold.back()
                assert hold.expects
            elif number > 3:
                answer_all(hold, wall, number)

        # The frame of the return itself is lost, as it went out before.
        wall = Wall()

        async def main() -> list[str | None]:
            loop = asyncio.get_running_loop()
            hold = hold_in(loop, wall, 0.01, on_missing=policy)
            answers = []
            for number in range(6):
                owed = hold.owe(number * PERIOD)
                if number == 0:
                    answer_all(hold, wall, number)
                act(hold, wall, number)
                answers.append(await owed)
            assert hold.answers.counts == {"answered": 3, "lost": 3}
            why_not = ["when it came back was up to real time"]
            assert (
                list(hold.answers.why_not)
                == ["it was gone for a while"] * (policy == "continue") + why_not
            )
            hold.close()
            return answers

        assert run_in_lockstep(main()) == ["0", None, None, None, "4", "5"]

    def test_who_is_back_may_initialise_anew(self) -> None:
        async def main() -> None:
            wall = Wall()
            hold = hold_in(
                asyncio.get_running_loop(), wall, 0.0, on_missing="lost", initialise=Duration(10)
            )
            hold.owe(0)
            hold.answer(0, "pose")
            hold.gone("killed")
            hold.back()
            hold.owe(PERIOD)
            wall.seconds += BEHIND + 1.0
            hold.look()
            assert hold.answers.counts == {"answered": 1, "initialising": 1}
            hold.close()

        run_async(main())

    def test_the_log_says_when_it_goes_and_comes_back(self) -> None:
        async def main() -> None:
            log: list[str] = []
            hold = hold_in(asyncio.get_running_loop(), Wall(), 0.0, log.append, on_missing="lost")
            hold.back()
            for _ in range(2):
                hold.gone("killed")
            hold.back()
            assert log == ["slam: killed", "slam: it is there again"]
            hold.close()

        run_async(main())

    def test_the_first_failure_counts_and_none_after_the_end(self) -> None:
        async def main() -> None:
            hold = hold_in(asyncio.get_running_loop(), Wall(), 0.01)
            owed = hold.owe(0)
            hold.fail(MissingAnswerError("first"))
            hold.fail(MissingAnswerError("second"))
            with pytest.raises(MissingAnswerError, match="first"):
                await owed
            with pytest.raises(MissingAnswerError, match="first"):
                hold.owe(1)
            hold.close()
            ended = hold_in(asyncio.get_running_loop(), Wall(), 0.01)
            owed = ended.owe(0)
            ended.close()
            ended.fail(MissingAnswerError("a gap"))
            assert not owed.work.done()

        run_async(main())

    def test_a_failure_reaches_who_waits_and_the_next_frame(self) -> None:
        async def main() -> None:
            hold = hold_in(asyncio.get_running_loop(), Wall(), 0.01)
            owed = hold.owe(0)
            hold.fail(MissingAnswerError("a gap"))
            with pytest.raises(MissingAnswerError, match="a gap"):
                await owed
            with pytest.raises(MissingAnswerError, match="a gap"):
                hold.owe(1)
            hold.close()

        run_async(main())


class TestInitialising:
    def test_nothing_is_owed_before_the_first_answer(self) -> None:
        """The system answers from frame 3 on; before, time goes as real time does, some behind."""

        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number < 3:
                wall.seconds = 100.0 + number * 0.033 + 0.01 + BEHIND - 0.001
                hold.look()
                assert hold.answers.counts["initialising"] == number
                wall.seconds += 0.002
                hold.look()
            else:
                answer_all(hold, wall, number)

        came, hold = fly(act, latency=0.01, initialise=Duration(10))
        assert came == [(n * PERIOD + 10 * MS, None if n < 3 else str(n)) for n in range(5)]
        assert hold.answers.counts == {"initialising": 3, "answered": 2}
        assert hold.answers.initialisation == pytest.approx(0.099)
        assert not hold.answers.why_not

    def test_frames_before_the_first_answer_are_never_answered(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number >= 3:
                answer_all(hold, wall, number)

        came, hold = fly(act, latency=0.12, initialise=Duration(10))
        assert [value for _, value in came] == [None, None, None, "3", "4"]
        assert hold.answers.counts == {"initialising": 3, "answered": 2}

    def test_a_first_answer_that_comes_too_late_is_said(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            if number == 0:
                wall.seconds += BEHIND + 1
                hold.look()
                hold.answer(0, "late")
            else:
                answer_all(hold, wall, number)

        came, hold = fly(act, latency=0.01, initialise=Duration(10), frames=2)
        assert [value for _, value in came] == [None, "1"]
        assert list(hold.answers.why_not) == ["its first answer came too late to be held for"]

    def test_the_time_counts_from_the_first_frame_which_may_be_late_in_the_run(self) -> None:
        async def main() -> None:
            wall = Wall()
            hold = hold_in(
                asyncio.get_running_loop(), wall, 0.5, initialise=Duration(1), on_missing="lost"
            )
            for stamp in (4 * SECOND, 5 * SECOND - 1, 5 * SECOND):
                hold.owe(stamp)
            for lost, seconds in ((0, BEHIND + 0.49), (1, 0.01), (1, 0.98), (2, 0.02)):
                wall.seconds += seconds
                hold.look()
                assert hold.answers.counts["initialising"] == lost
            wall.seconds = 109.9
            hold.look()
            assert hold.answers.counts == {"initialising": 2}
            wall.seconds = 110.0
            hold.look()
            assert hold.answers.counts == {"initialising": 2, "lost": 1}
            hold.close()

        run_async(main())

    def test_after_that_time_answers_are_owed_in_any_case(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            wall.seconds += 11
            hold.look()

        with pytest.raises(ExceptionGroup) as caught:
            fly(act, latency=0.01, initialise=Duration(0.05))
        assert "the frame of 0.066000 s" in str(caught.value.exceptions[0])


def test_what_is_not_due_at_the_end_is_open_whether_it_was_answered_or_not() -> None:
    async def main() -> None:
        hold = hold_in(asyncio.get_running_loop(), Wall(), 0.04)
        owed = [hold.owe(n) for n in range(2)]
        hold.answer(0, "answered already")
        hold.close()
        hold.answer(1, "after the end")
        hold.gone("as it was told to end")
        assert not +hold.answers.counts
        assert hold.answers.sent == 2
        assert await owed[0] == "answered already"

    run_async(main())


def test_what_it_is_sent_and_has_received_is_in_the_answers() -> None:
    async def main() -> None:
        hold = hold_in(asyncio.get_running_loop(), Wall(), 0.04)
        assert (hold.answers.inputs(), hold.answers.received) == (None, None)
        hold.sent("images", b"image")
        for count in (1, 2):
            hold.received(count)
        expected = Answers()
        expected.record_input("images", b"image")
        assert (hold.answers.inputs(), hold.answers.received) == (expected.inputs(), 3)

    run_async(main())


def test_a_doubt_is_logged_once() -> None:
    async def main() -> None:
        log: list[str] = []
        hold = hold_in(asyncio.get_running_loop(), Wall(), 0.04, log.append)
        for _ in range(2):
            hold.doubt("it is Monday")
        assert log == ["slam: an equal run may differ: it is Monday"]
        assert list(hold.answers.why_not) == ["it is Monday"]

    run_async(main())


def test_the_thread_that_watches_ends_with_the_hold() -> None:
    async def main() -> None:
        hold = hold_in(asyncio.get_running_loop(), Wall(), 0.04)
        hold.owe(0)
        hold.answer(0, "pose")
        thread = hold._thread
        assert thread is not None
        hold.close()
        thread.join(2.0)
        assert not thread.is_alive()

    run_async(main())


def test_by_default_each_frame_is_to_be_answered_at_once() -> None:
    assert HoldConfig() == HoldConfig(
        skips="refused", initialise=Duration(0), max_wait=Duration(10), on_missing="error",
        lost_allowed=0, tolerance_ns=1000, latencies="", latency_factor=1.0,
    )  # fmt: skip
    with pytest.raises(msgspec.ValidationError, match="unknown field `skip`"):
        msgspec.convert({"skip": "allowed"}, HoldConfig)


def test_who_no_longer_waits_cancels_no_answer() -> None:
    assert not future().cancel()


class TestLatencies:
    def test_what_a_run_measured_is_replayed_in_the_order_of_the_frames(
        self, tmp_path: Path
    ) -> None:
        answers = Answers()
        for number, milliseconds in enumerate([10.0, 50.0, 5.0]):
            answers.settled(Settled(number * PERIOD, 0, "answered", milliseconds / 1e3))
        answers.settled(Settled(3 * PERIOD, 0, "lost"))
        answers.write(tmp_path, "slam")
        file = tmp_path / "answers" / "slam.csv"
        came, hold = fly(answer_all, latencies=str(file), latency_factor=2.0)
        dues = [20 * MS, PERIOD + 100 * MS, PERIOD + 100 * MS, PERIOD + 100 * MS + 9 * MS]
        assert [time for time, _ in came[:3]] == dues[:3]
        assert came[3][0] == max(3 * PERIOD + 10 * MS, dues[2])
        assert hold.answers.latency is None


async def test_in_real_time_nothing_is_held_and_skips_are_counted() -> None:
    clock = RealClock(asyncio.get_running_loop())
    clock.start()
    hold: Hold[str] = Hold("slam", clock, HoldConfig(), 0.0)
    skipped, answered = hold.owe(0), hold.owe(PERIOD)
    threading.Thread(target=hold.answer, args=(PERIOD, "pose")).start()
    assert await skipped is None
    assert await answered == "pose"
    assert hold.answers.counts == {"skipped": 1, "answered": 1}
    assert list(hold.answers.why_not) == ["the clock is real"]
    hold.close()
    clock.close()


async def _value(owed: Any) -> Any:
    return await owed


class Model:
    """What is owed and what became of the rest, said another way."""

    def __init__(self, skips: bool, on_missing: str, initialises: bool) -> None:
        self.skips, self.on_missing, self.initialises = skips, on_missing, initialises
        self.counts: Counter[str] = Counter()
        self.owed: list[int] = []
        self.settled: dict[int, tuple[str, str | None]] = {}  # outcome and answer, by stamp
        self.sent = self.lost_in_a_row = 0
        self.gone = self.hangs = self.began = self.heard = False

    @property
    def initialising(self) -> bool:
        return self.initialises and self.began and not self.heard

    def settle(self, stamp: int, outcome: str, answer: str | None = None) -> None:
        self.owed.remove(stamp)
        self.settled[stamp] = outcome, answer
        self.counts[outcome] += 1

    def settle_all(self, outcome: str) -> None:
        for stamp in list(self.owed):
            self.settle(stamp, outcome)

    def owe(self, stamp: int) -> None:
        self.sent += 1
        self.began = True
        self.owed.append(stamp)
        if self.gone or (self.hangs and self.on_missing == "lost"):
            self.settle(stamp, "lost")

    def answer(self, stamp: int, answer: str | None, says: str = "") -> None:
        if stamp in self.owed:
            for earlier in [other for other in self.owed if other < stamp]:
                if self.initialising:
                    self.settle(earlier, "initialising")
                elif self.skips:
                    self.settle(earlier, "skipped")
            outcome = "initialising" if says == "initialising" else "answered"
            self.settle(stamp, outcome if answer or says == "initialising" else "empty", answer)
        elif stamp not in self.settled:
            self.counts["unknown"] += 1
        else:
            outcome, first = self.settled[stamp]
            late = outcome in {"lost", "skipped", "initialising"}
            same = answer in {None, first}
            self.counts["late" if late else "repeated" if same else "contradicting"] += 1
        self.heard, self.hangs, self.lost_in_a_row = True, False, 0

    def wait(self) -> None:
        """Let more real time go by than an answer may take."""
        if self.hangs or not self.owed:
            return
        if self.initialising:
            self.settle_all("initialising")
            return
        self.hangs = self.on_missing == "continue"
        if self.on_missing == "lost":
            self.heard = True
            self.settle(self.owed[0], "lost")
            self.lost_in_a_row += 1
            if self.lost_in_a_row == IN_A_ROW:
                self.hangs = True
                self.settle_all("lost")

    def leave(self) -> None:
        self.gone = True
        self.settle_all("lost")

    def come_back(self) -> None:
        if self.gone:
            self.gone = self.hangs = self.began = self.heard = False
            self.lost_in_a_row = 0


ACTS = {
    "owe": 8,
    "answer": 4,
    "empty": 1,
    "says": 1,
    "lost": 1,
    "stranger": 1,
    "wait": 4,
    "gone": 1,
    "back": 2,
}
"""What may happen to a frame or a system, and how often it does."""


class TestLedger:
    """What is owed and what became of the frames is as said another way, whatever happens."""

    @settings(max_examples=80, deadline=None)
    @given(st.integers(0, 2**32))
    def test_it_is_as_the_model_says(self, seed: int) -> None:
        dice, wall = random.Random(seed), Wall()
        acts = dice.choices([*ACTS], [*ACTS.values()], k=50)
        skips, initialises = dice.random() < 0.5, dice.random() < 0.3
        on_missing = dice.choice(["lost", "continue"])
        model = Model(skips, on_missing, initialises)

        async def main() -> Hold[str]:
            loop = asyncio.get_running_loop()
            config: dict[str, Any] = {"initialise": Duration(10.0 * initialises)}
            config |= {"skips": "allowed" if skips else "refused", "on_missing": on_missing}
            hold = hold_in(loop, wall, 0.04, **config)
            stamps, newest = [0], -1
            answers: dict[int, asyncio.Task[str | None]] = {}
            for act in acts:
                stamp = dice.choice(stamps[-6:])
                awaited = stamp in model.owed
                value = dice.choice(["pose", "another"])
                match act:
                    case "owe":
                        newest = stamps[-1] + PERIOD
                        stamps.append(newest)
                        model.owe(newest)
                        answers[newest] = asyncio.create_task(_value(hold.owe(newest)))
                    case "answer":
                        model.answer(stamp, value)
                        hold.answer(stamp + dice.randrange(-900, 900), value)
                    case "empty":
                        model.answer(stamp, None)
                        hold.answer(stamp, None)
                    case "says":
                        model.answer(stamp, None, "initialising")
                        hold.answer(stamp, value if awaited else None, "initialising")
                    case "lost":
                        model.answer(stamp, value)
                        hold.answer(stamp, value, "lost")
                    case "wait":
                        model.wait()
                        wall.seconds += 11.0
                        hold.look()
                    case "gone":
                        model.leave()
                        hold.gone("killed")
                    case "back":
                        model.come_back()
                        hold.back()
                    case "stranger":
                        model.answer(stamp + 5_000, value)
                        hold.answer(stamp + 5_000, value)
                assert +hold.answers.counts == +model.counts
                assert [known for known in stamps if hold.waited(known) is not None] == model.owed
                assert hold.newest == newest
                assert hold.answers.sent == model.sent
            for stamp in list(model.owed):
                model.answer(stamp, "at last")
                hold.answer(stamp, "at last")
            for stamp, task in answers.items():
                assert await task == model.settled[stamp][1]
            hold.close()
            return hold

        summary = OutsideSummary.of(run_in_lockstep(main()).answers)
        parts = (
            summary.answered,
            summary.empty,
            summary.initialising,
            summary.skipped,
            summary.lost,
        )
        assert summary.sent == sum(parts) + summary.open
        assert min(*parts, summary.open) >= 0
        assert summary.says_lost <= summary.answered + summary.empty
        shown = dict(zip(OUTSIDE_COLUMNS, summary.row(), strict=True))
        columns = ("answered", "empty", "initialising", "skipped", "no answer", "open")
        assert int(shown["sent"]) == sum(int(shown[column]) for column in columns)

    def test_what_it_says_of_itself_is_counted(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            says: Any = {0: "initialising", 3: "lost"}.get(number, "")
            hold.answer(number * PERIOD, None if says == "initialising" else "pose", says)

        came, hold = fly(act)
        assert [value for _, value in came] == [None, "pose", "pose", "pose", "pose"]
        assert hold.answers.counts == {"initialising": 1, "answered": 4}
        assert hold.answers.says_lost == 1


class TestTwoAnswers:
    @pytest.mark.parametrize(("second", "why"), [("0", []), ("1", ["frames were answered twice"])])
    def test_a_second_answer_that_differs_is_told(self, second: str, why: list[str]) -> None:
        """Of two systems at one topic, the quicker one decides: no equal run is promised."""

        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            hold.answer(number * PERIOD, "0")
            hold.answer(number * PERIOD, second)

        log: list[str] = []
        came, hold = fly(act, log=log.append)
        assert {value for _, value in came} == {"0"}
        assert [line.partition(",")[0] for line in log] == [
            "slam: expected one answer to the frame of 0.000000 s"
        ] * bool(why)
        kind = "contradicting" if why else "repeated"
        assert hold.answers.counts == {"answered": 5, kind: 5}
        assert [reason.partition(",")[0] for reason in hold.answers.why_not] == why
        assert OutsideSummary.of(hold.answers).reproducible is not bool(why)

    def test_one_that_says_that_no_more_is_to_come_contradicts_nothing(self) -> None:
        def act(hold: Hold[str], wall: Wall, number: int) -> None:
            answer_all(hold, wall, number)
            hold.answer(number * PERIOD, None)

        _, hold = fly(act)
        assert hold.answers.counts == {"answered": 5, "repeated": 5}
        assert not hold.answers.why_not

    def test_the_digest_of_answers_is_that_of_each_to_its_frame(self) -> None:
        def digest(value: str) -> str | None:
            return fly(lambda hold, _, n: hold.answer(n * PERIOD, value))[1].answers.outputs()

        assert digest("a") == digest("a") != digest("b")
