"""The real clock on real time: few and short, for only these show that timerfd and loop agree."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import uvloop

from runtime.time.clock import Alarm, LoopAlarm, RealClock, Tick, Ticker, TimerFd

MS = 1_000_000


@pytest.mark.parametrize("make_loop", [asyncio.SelectorEventLoop, uvloop.new_event_loop])
@pytest.mark.parametrize("alarm", [TimerFd, LoopAlarm])
def test_ticks_and_sleeps_end_in_order_and_never_early(
    make_loop: Callable[[], asyncio.AbstractEventLoop],
    alarm: Callable[..., Alarm],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("runtime.time.clock.TimerFd", alarm)

    async def main() -> tuple[list[Tick], int]:
        clock = RealClock(asyncio.get_running_loop())
        ticks: list[Tick] = []
        clock.start()
        ticker = Ticker("n.tick", 500, ticks.append, lambda _: None)
        clock.schedule.add(0, ticker)
        # Real, for it is the kernel's timer that is tested.
        await clock.sleep(0.011)
        slept = clock.now()
        ticker.stopped = True
        clock.close()
        return ticks, slept

    with asyncio.Runner(loop_factory=make_loop) as runner:
        ticks, slept = runner.run(main())
    assert slept >= 11 * MS
    assert ticks[-1].index + 1 == len(ticks) + sum(tick.missed for tick in ticks)
    assert [tick.stamp for tick in ticks] == [tick.index * 2 * MS for tick in ticks]
    assert all(tick.late >= 0 for tick in ticks)


def test_before_the_first_update_sleeping_works_and_time_stands() -> None:
    async def main() -> tuple[int, int]:
        clock = RealClock(asyncio.get_running_loop())
        # Real, for time has not begun; nodes may do this in `on_startup`.
        await clock.sleep(0.001)
        before = clock.now()
        clock.start()
        clock.close()
        return before, clock.now()

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        before, after = runner.run(main())
    assert before == 0
    assert after > 0


def test_a_sooner_entry_moves_the_alarm_forward() -> None:
    async def main() -> list[str]:
        clock, log = RealClock(asyncio.get_running_loop()), list[str]()
        clock.start()

        async def sleep(name: str, seconds: float) -> None:
            await clock.sleep(seconds)
            log.append(name)

        later = asyncio.create_task(sleep("later", 3600))
        await asyncio.sleep(0)
        # Real, for it is the kernel's timer that is set anew.
        await sleep("sooner", 0.001)
        later.cancel()
        clock.close()
        return log

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        assert runner.run(main()) == ["sooner"]


def test_closing_gives_the_file_back() -> None:
    def open_files() -> set[Path]:
        return set(Path("/proc/self/fd").iterdir())

    async def main() -> None:
        before = open_files()
        clock = RealClock(asyncio.get_running_loop())
        assert len(open_files()) == len(before) + 1
        clock.close()
        assert open_files() == before

    with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
        runner.run(main())


def test_an_alarm_that_the_kernel_refuses_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        alarm = TimerFd(loop, lambda: None)
        refuses = SimpleNamespace(timerfd_create=lambda *_: -1, timerfd_settime=lambda *_: -1)
        monkeypatch.setattr("runtime.time.clock._libc", refuses)
        with pytest.raises(OSError, match="timerfd_settime failed"):
            alarm.set(1)
        alarm.close()
        with pytest.raises(OSError, match="timerfd_create failed"):
            TimerFd(loop, lambda: None)

    asyncio.run(main())
