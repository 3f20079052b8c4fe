"""How much gets through: events through handlers and streams, images through streams and workers.

Times are of whole bursts, divided by their size; each figure is the median of many bursts.

And what a run takes through which nothing goes: processor time of one 100 Hz timer node.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import uvloop

from bench.benchmarks import Progress, Row
from bench.harness import paired, silent, timed
from bench.system import Ping
from events import Event, Image, PoseEstimate, Quaternion, Vector3
from runtime import Node, Tick, every
from runtime.channels.sender import Listener, Sender
from runtime.channels.streams import Stream
from runtime.config.reading import parse
from runtime.run import event_loop
from runtime.run.execute import execute
from runtime.time.clock import RealClock
from runtime.workers.worker import Worker

BATCH = 256  # events of a burst: as many as a reader may take before the loop gets a turn


class Unchecked(Event):
    """`PoseEstimate` without checks, for comparison."""

    frame_id: str = "odom"
    child_frame_id: str = "base_link"
    position: Vector3
    orientation: Quaternion
    covariance: tuple[float, ...] = ()


class Mirror:
    """Object in a worker: returns each image to the caller."""

    def echo(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the image, passed through shared memory both ways."""
        return image


def measure(*, bursts: int = 400, progress: Progress = silent) -> list[Row]:
    """Measure all ways."""
    progress("throughput")
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(_measure(bursts))


async def _measure(bursts: int) -> list[Row]:
    event_loop.install(asyncio.get_running_loop())
    event = Ping(stamp=0, source="one", receiver=2, number=0)
    pixels = np.zeros((512, 512, 3), np.uint8)
    image = Image(stamp=0, source="drone/front", frame_id="f", data=pixels)
    times = {
        **_by_making(bursts),
        "events, handler": _by_handler(event, bursts),
        "events, stream, reader resumed by each": await _by_stream(event, bursts, soon=False),
        "events, stream, all in one wake": await _by_stream(event, bursts, soon=True),
    }
    by_reference = await _by_stream(image, bursts, soon=False)
    return [
        *(_row(case, BATCH, of_bursts) for case, of_bursts in times.items()),
        _row("images by reference, stream", BATCH, by_reference, pixels.nbytes),
        *await _by_worker(pixels),
    ]


def _row(case: str, batch: int, bursts: Sequence[int], size: int = 0) -> Row:
    """Return the figures of a case, of the times of its bursts (ns); `size` is in bytes."""
    per_event = float(np.median(bursts)) / batch
    return {
        "case": case,
        "batch": batch,
        "per_event_us": per_event / 1e3,
        "events_per_second": 1e9 / per_event,
        "bytes_per_second": size * 1e9 / per_event,
    }


def _by_making(bursts: int) -> dict[str, list[int]]:
    place, turn = (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5)

    def make(event: type[Unchecked] | type[PoseEstimate]) -> None:
        for stamp in range(BATCH):
            event(stamp=stamp, source="one", position=place, orientation=turn)

    kinds = {
        "poses made, without checks": functools.partial(make, Unchecked),
        "poses made, as they are": functools.partial(make, PoseEstimate),
    }
    return paired({kind: functools.partial(timed, kinds[kind]) for kind in kinds}, bursts)


def _by_handler(event: Event, bursts: int) -> list[int]:
    sender: Sender[Event] = Sender("one.out", type(event))
    sender.connect([Listener("two", lambda _: None, (type(event),))])
    send = sender.send

    def burst() -> None:
        for _ in range(BATCH):
            send(event)

    return [timed(burst) for _ in range(bursts)]


async def _by_stream(event: Event, bursts: int, *, soon: bool) -> list[int]:
    """Return the time of each burst, until the reader has had its last event."""
    stream: Stream[Event] = Stream("two.in", bound=BATCH, soon=soon)
    sender: Sender[Event] = Sender("one.out", type(event))
    sender.connect([Listener("two", stream.offer, (type(event),), None, stream)])
    read_all = asyncio.Event()

    async def read() -> None:
        seen = 0
        async for _ in stream:
            seen += 1
            if seen % BATCH == 0:
                read_all.set()

    reader = asyncio.create_task(read())
    await asyncio.sleep(0)
    send, taken = sender.send, []
    for _ in range(bursts):
        read_all.clear()
        begin = time.perf_counter_ns()
        for _ in range(BATCH):
            send(event)
        await read_all.wait()
        taken.append(time.perf_counter_ns() - begin)
        await asyncio.sleep(0)
    stream.close()
    await reader
    return taken


async def _by_worker(pixels: npt.NDArray[np.uint8]) -> list[Row]:
    clock = RealClock(asyncio.get_running_loop())
    worker = Worker("mirror", clock, Mirror)
    try:
        await worker.ready()
        rows = []
        for batch in (1, 4):
            taken = []
            for _ in range(100):
                begin = time.perf_counter_ns()
                await asyncio.gather(*(worker.call(Mirror.echo, pixels) for _ in range(batch)))
                taken.append(time.perf_counter_ns() - begin)
            rows.append(_row("images to a worker and back", batch, taken, 2 * pixels.nbytes))
        return rows
    finally:
        await asyncio.to_thread(worker.close)
        clock.close()


_marks: list[tuple[float, float]] = []


class Timer(Node):
    """Does nothing, a hundred times a second."""

    @every(hz=100)
    def tick(self, _: Tick) -> None:
        """Note the time, real and of the processor."""
        _marks.append((time.monotonic(), time.process_time()))


def measure_idle(*, seconds: float = 10.0, progress: Progress = silent) -> list[Row]:
    """Measure the cost of a nearly idle run: percent of a core, all threads together."""
    progress("idle")
    _marks.clear()
    node = {"name": "timer", "type": f"{__name__}:Timer"}
    execute(parse({"run": {"clock": "real", "duration": seconds}, "nodes": [node]}, "bench idle"))
    (begin, cpu_begin), (end, cpu_end) = _marks[0], _marks[-1]
    percent = 100 * (cpu_end - cpu_begin) / (end - begin)
    return [{"hz": 100, "seconds": end - begin, "ticks": len(_marks), "cpu_percent": percent}]
