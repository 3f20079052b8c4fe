"""Overhead of the runtime over raw Zenoh between two processes: round trips and bursts.

Two nodes of one run in two processes, on the real clock, against two bare Zenoh sessions in the
same two processes. A request is a small event or an image; the answer is always small. Blocks of
both sides are measured in turns, in random order, so that other load on the machine falls on both
alike; a ratio is that of the two medians.

Also the cost of encoding an image for ROS 2, as the bridge does it, and by rosbags alone. Both
make the same bytes, CDR of a ``sensor_msgs/msg/Image``; rosbags gets its message ready-made, with
only the time to set.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

from bench.system import free_port, in_turns, pair, zenoh_config, zenoh_publisher, zenoh_subscriber
from events import Event, Image
from nodes.ros2.messages.images import ImageWriter
from nodes.ros2.messages.typestore import TypeStore
from runtime import Input, Node, Output
from runtime.config.model import Config
from runtime.config.reading import parse
from runtime.run.execute import execute

BLOCK = 50  # round trips of a side in each of its turns

WARM_UP = 50
ENCODED_FIRST = 20  # images encoded by both sides before the first measurement

IMAGE = "sensor_msgs/msg/Image"
FRAME = "camera_optical_frame"
IMAGES = {"512×512 rgb8": (512, 512, 3), "1080×1080 rgb8": (1080, 1080, 3)}


class BridgeRow(msgspec.Struct, frozen=True, kw_only=True):
    """Round trips of a kind of event, ours and raw Zenoh's: medians, 99th percentiles.

    Attributes:
        bytes: Of its payload.
        ours_per_second: Events of a burst that came through, each second.
    """

    case: str
    bytes: int
    samples: int
    ours_us: float
    zenoh_us: float
    ratio: float
    ours_p99_us: float
    zenoh_p99_us: float
    ours_per_second: float
    zenoh_per_second: float


class RosImageRow(msgspec.Struct, frozen=True, kw_only=True):
    """Encoding time of a kind of image, by the bridge and rosbags' ``serialize_cdr``.

    Attributes:
        bytes: Of a message.
    """

    case: str
    bytes: int
    samples: int
    ours_us: float
    rosbags_us: float
    ratio: float
    ours_p99_us: float
    rosbags_p99_us: float


class Asked(Event):
    """A small question."""

    number: int
    answer: bool = True


class Answered(Event):
    """An answer to whatever was asked."""

    number: int


class Mirror(Node):
    """Answers each question and each image, in the other process."""

    questions = Input(Asked, bound=100_000)
    images = Input(Image, bound=1000)
    answers = Output(Answered)

    async def run(self) -> None:
        """Answer."""
        self.start(self._look())
        async for question in self.questions:
            if question.answer:
                self._answer(question.number)

    async def _look(self) -> None:
        async for image in self.images:
            if image.source == "asker":
                self._answer(0)

    def _answer(self, number: int) -> None:
        self.answers.send(Answered(stamp=self.clock.now(), source=self.name, number=number))


class Asker(Node):
    """Node to measure round trips to the other process, in turns with raw Zenoh."""

    questions = Output(Asked)
    images = Output(Image)
    answers = Input(Answered)

    samples = 1000
    raw: Raw
    rows: list[BridgeRow]
    progress: Callable[[str], None]

    async def run(self) -> None:
        """Measure, and end the run."""
        cls = type(self)
        cls.rows = [await self._measure("small event", None)]
        for case, shape in IMAGES.items():
            cls.rows.append(await self._measure(case, shape))
        self.stop("measured")

    async def _measure(self, case: str, shape: tuple[int, ...] | None) -> BridgeRow:
        self.progress(case)
        data = None if shape is None else np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        samples = self.samples if data is None else max(self.samples // 4, BLOCK)
        taken: dict[str, list[int]] = {"ours": [], "zenoh": []}
        for _, side in in_turns(taken, -(-(samples + WARM_UP) // BLOCK)):
            if side == "ours":
                taken[side] += [await self._round_trip(data) for _ in range(BLOCK)]
            else:
                taken[side] += await asyncio.to_thread(self.raw.round_trips, data, BLOCK)
        burst = 200 if data is None else 20
        ours_burst = [await self._burst(data, burst) for _ in range(5)]
        raw_burst = [await asyncio.to_thread(self.raw.burst, data, burst) for _ in range(5)]
        return BridgeRow(
            case=case,
            bytes=64 if data is None else data.nbytes,
            samples=samples,
            ours_per_second=float(np.median(ours_burst)),
            zenoh_per_second=float(np.median(raw_burst)),
            **pair({side: times[WARM_UP:] for side, times in taken.items()}),
        )

    async def _round_trip(self, data: npt.NDArray[np.uint8] | None) -> int:
        begin = time.perf_counter_ns()
        self._ask(data)
        await anext(self.answers)
        return time.perf_counter_ns() - begin

    async def _burst(self, data: npt.NDArray[np.uint8] | None, count: int) -> float:
        """Return events per second in a burst; only the last event is answered."""
        begin = time.perf_counter_ns()
        for number in range(count):
            self._ask(data, answer=number == count - 1)
        for _ in range(1 if data is None else count):
            await anext(self.answers)
        return count * 1e9 / (time.perf_counter_ns() - begin)

    def _ask(self, data: npt.NDArray[np.uint8] | None, *, answer: bool = True) -> None:
        now = self.clock.now()
        if data is None:
            self.questions.send(Asked(stamp=now, source=self.name, number=0, answer=answer))
        else:
            self.images.send(Image(stamp=now, source=self.name, frame_id="f", data=data))


class Raw:
    """The asking end of two bare sessions."""

    def __init__(self, locator: str) -> None:
        import zenoh

        self._session = zenoh.open(zenoh_config(listen=locator))
        self._put = zenoh_publisher(self._session, "asked").put
        self._answered = threading.Semaphore(0)
        self._kept = zenoh_subscriber(self._session, "answered", lambda _: self._answered.release())

    def round_trips(self, data: npt.NDArray[np.uint8] | None, count: int) -> list[int]:
        """Return the nanoseconds of each."""
        taken = []
        for _ in range(count):
            begin = time.perf_counter_ns()
            self._ask(data)
            self._answered.acquire()
            taken.append(time.perf_counter_ns() - begin)
        return taken

    def burst(self, data: npt.NDArray[np.uint8] | None, count: int) -> float:
        """Return events a second."""
        begin = time.perf_counter_ns()
        for _ in range(count):
            self._ask(data)
        for _ in range(count):
            self._answered.acquire()
        return count * 1e9 / (time.perf_counter_ns() - begin)

    def close(self) -> None:
        """End the session."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _ask(self, data: npt.NDArray[np.uint8] | None) -> None:
        # Zenoh takes no arrays; their bytes are new each time, as an image is.
        self._put(b"x" * 64 if data is None else data.tobytes())


def measure(
    samples: int = 1000, progress: Callable[[str], None] = lambda _: None
) -> list[BridgeRow]:
    """Measure small events and images.

    Args:
        samples: Round trips with small events on each side; a quarter with images.
    """
    meet, locator = f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    Asker.samples, Asker.progress, Asker.rows = samples, staticmethod(progress), []
    with _other_process(meet, locator):
        Asker.raw = Raw(locator)
        try:
            execute(_config(meet), only=["asker"])
        finally:
            Asker.raw.close()
    return Asker.rows


def mirror(meet: str, locator: str) -> None:
    """Run the answering process: a node, and a bare Zenoh session."""
    import zenoh

    with zenoh.open(zenoh_config(connect=locator)) as session:
        answer = zenoh_publisher(session, "answered").put

        def asked(sample: Any) -> None:
            np.frombuffer(sample.payload.to_bytes(), np.uint8)
            answer(b"x" * 64)

        _kept = zenoh_subscriber(session, "asked", asked)
        execute(_config(meet), only=["mirror"])


def _config(meet: str) -> Config:
    nodes = [{"name": n, "type": f"bench.bridge:{n.title()}"} for n in ("asker", "mirror")]
    run = {"name": "bench-bridge", "clock": "real", "stall": 0, "log": "error"}
    return parse({"run": run, "network": {"meet": meet}, "nodes": nodes}, "bench bridge")


@contextmanager
def _other_process(meet: str, locator: str) -> Iterator[None]:
    code = f"from bench.bridge import mirror; mirror({meet!r}, {locator!r})"
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        yield
        process.wait(10)
    finally:
        process.kill()
        process.wait()


def measure_ros_images(repeats: int = 300) -> list[RosImageRow]:
    """Measure a colour image and a depth image of 512×512."""
    drawn = np.random.default_rng(0)
    return [
        _measure_encoding("rgb8", drawn.integers(0, 256, (512, 512, 3), np.uint8), repeats),
        _measure_encoding(
            "32FC1", drawn.uniform(0.3, 20.0, (512, 512)).astype(np.float32), repeats
        ),
    ]


def _measure_encoding(encoding: str, data: npt.NDArray[Any], repeats: int) -> RosImageRow:
    ours, theirs = _by_the_bridge(encoding, data), _by_rosbags(encoding, data)
    for number in range(ENCODED_FIRST):
        if bytes(ours(number)) != bytes(theirs(number)):
            raise AssertionError(f"{encoding}: expected the same bytes of both")
    encoders = {"ours": ours, "rosbags": theirs}
    taken: dict[str, list[int]] = {side: [] for side in encoders}
    for number, side in in_turns(encoders, repeats):
        begin = time.perf_counter_ns()
        encoders[side](number)
        taken[side].append(time.perf_counter_ns() - begin)
    height, width = data.shape[:2]
    return RosImageRow(
        case=f"{width}×{height} {encoding}", bytes=len(ours(0)), samples=repeats, **pair(taken)
    )


def _by_the_bridge(encoding: str, data: npt.NDArray[Any]) -> Callable[[int], Any]:
    writer = ImageWriter(TypeStore(), FRAME, encoding)
    return lambda number: writer.write((number, 7), data)


def _by_rosbags(encoding: str, data: npt.NDArray[Any]) -> Callable[[int], Any]:
    store, plain = TypeStore(), get_typestore(Stores.ROS2_JAZZY)
    message: Any = plain.types[IMAGE](
        header=store.header((0, 7), FRAME),
        height=data.shape[0],
        width=data.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=data.nbytes // data.shape[0],
        data=data.view(np.uint8).ravel(),
    )

    def encode(number: int) -> Any:
        message.header.stamp.sec = number
        return plain.serialize_cdr(message, IMAGE)

    return encode
