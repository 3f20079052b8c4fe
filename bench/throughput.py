"""How much gets through: events through handlers and streams, images through streams and workers.

Times are of whole bursts, divided by their size; each figure is the median of many bursts.

And what a run takes through which nothing goes: processor time of one 100 Hz timer node.
"""

from __future__ import annotations

import asyncio
import time

import msgspec
import numpy as np
import numpy.typing as npt
import uvloop

from bench.system import Ping, in_turns
from events import Event, Image, PoseEstimate, Quaternion, Vector3
from runtime import Node, Tick, every
from runtime.channels.sender import Listener, Sender
from runtime.channels.streams import Stream
from runtime.config.reading import parse
from runtime.run import event_loop
from runtime.run.execute import execute
from runtime.time.clock import RealClock
from runtime.workers.worker import Worker


class ThroughputRow(msgspec.Struct, frozen=True, kw_only=True):
    """Throughput of a case.

    Attributes:
        batch: How many at a time.
        bytes_per_second: Of payload.
    """

    case: str
    batch: int
    per_event_us: float
    events_per_second: float
    bytes_per_second: float

    @property
    def megabytes_per_second(self) -> float:
        """Return the same in megabytes."""
        return self.bytes_per_second / 1e6


class IdleRow(msgspec.Struct, frozen=True, kw_only=True):
    """Processor load in a run of a timer: percent of one core, all threads together."""

    hz: float
    seconds: float
    ticks: int
    cpu_percent: float


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


def measure(bursts: int = 400) -> list[ThroughputRow]:
    """Measure all ways."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(_measure(bursts))


async def _measure(bursts: int) -> list[ThroughputRow]:
    event_loop.install(asyncio.get_running_loop())
    event = Ping(stamp=0, source="one", receiver=2, number=0)
    pixels = np.zeros((512, 512, 3), np.uint8)
    image = Image(stamp=0, source="drone/front", frame_id="f", data=pixels)
    at_once = "events, stream, reader resumed by each"
    in_one_wake = "events, stream, all in one wake"
    return [
        *_making_rows(bursts),
        _row("events, handler", BATCH, _by_handler(event, bursts), 0),
        _row(at_once, BATCH, await _by_stream(event, bursts, soon=False), 0),
        _row(in_one_wake, BATCH, await _by_stream(event, bursts, soon=True), 0),
        _row(
            "images by reference, stream",
            BATCH,
            await _by_stream(image, bursts, soon=False),
            pixels.nbytes,
        ),
        *await _worker_rows(pixels),
    ]


def _making_rows(bursts: int) -> list[ThroughputRow]:
    place, turn = (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5)
    taken: dict[type[Unchecked] | type[PoseEstimate], list[float]] = {
        Unchecked: [],
        PoseEstimate: [],
    }
    for _, event in in_turns(taken, bursts):
        begin = time.perf_counter_ns()
        for stamp in range(BATCH):
            event(stamp=stamp, source="one", position=place, orientation=turn)
        taken[event].append((time.perf_counter_ns() - begin) / BATCH)
    plain, checked = (float(np.median(each)) for each in taken.values())
    return [
        _row("poses made, without checks", BATCH, plain, 0),
        _row("poses made, as they are", BATCH, checked, 0),
    ]


def _by_handler(event: Event, bursts: int) -> float:
    """Return nanoseconds an event."""
    sender: Sender[Event] = Sender("one.out", type(event))
    sender.connect([Listener("two", lambda _: None, (type(event),))])
    send, taken = sender.send, []
    for _ in range(bursts):
        begin = time.perf_counter_ns()
        for _ in range(BATCH):
            send(event)
        taken.append((time.perf_counter_ns() - begin) / BATCH)
    return float(np.median(taken))


async def _by_stream(event: Event, bursts: int, *, soon: bool) -> float:
    """Return nanoseconds an event, until the reader has had the last of a burst."""
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
        taken.append((time.perf_counter_ns() - begin) / BATCH)
        await asyncio.sleep(0)
    stream.close()
    await reader
    return float(np.median(taken))


async def _worker_rows(pixels: npt.NDArray[np.uint8]) -> list[ThroughputRow]:
    loop = asyncio.get_running_loop()
    clock = RealClock(loop)
    worker = Worker("mirror", clock, Mirror)
    try:
        await worker.ready()
        rows = []
        for batch in (1, 4):
            taken = []
            for _ in range(100):
                begin = time.perf_counter_ns()
                await asyncio.gather(*(worker.call(Mirror.echo, pixels) for _ in range(batch)))
                taken.append((time.perf_counter_ns() - begin) / batch)
            case = "images to a worker and back"
            rows.append(_row(case, batch, float(np.median(taken)), 2 * pixels.nbytes))
        return rows
    finally:
        await asyncio.to_thread(worker.close)
        clock.close()


def _row(case: str, batch: int, nanoseconds: float, size: int) -> ThroughputRow:
    return ThroughputRow(
        case=case,
        batch=batch,
        per_event_us=nanoseconds / 1e3,
        events_per_second=1e9 / nanoseconds,
        bytes_per_second=size * 1e9 / nanoseconds,
    )


_marks: list[tuple[float, float]] = []


class Timer(Node):
    """Does nothing, a hundred times a second."""

    @every(hz=100)
    def tick(self, _: Tick) -> None:
        """Note the time, real and of the processor."""
        _marks.append((time.monotonic(), time.process_time()))


def measure_idle(seconds: float = 10.0) -> IdleRow:
    """Measure the cost of a nearly idle run: a timer for some seconds."""
    _marks.clear()
    node = {"name": "timer", "type": f"{__name__}:Timer"}
    execute(parse({"run": {"clock": "real", "duration": seconds}, "nodes": [node]}, "bench idle"))
    (begin, cpu_begin), (end, cpu_end) = _marks[0], _marks[-1]
    return IdleRow(
        hz=100,
        seconds=end - begin,
        ticks=len(_marks),
        cpu_percent=100 * (cpu_end - cpu_begin) / (end - begin),
    )
