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
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_typestore

from bench.benchmarks import Progress, Row
from bench.harness import in_turns, pair, program, silent
from bench.lockstep import random_images
from bench.system import free_port, zenoh_publisher, zenoh_session, zenoh_subscriber
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
CASES: dict[str, tuple[int, ...] | None] = {
    "small event": None,
    "512×512 rgb8": (512, 512, 3),
    "1080×1080 rgb8": (1080, 1080, 3),
}
"""Shapes of the images, by what is measured."""


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
    rows: list[Row]
    progress: Progress

    async def run(self) -> None:
        """Measure, and end the run."""
        for case, shape in CASES.items():
            self.progress(case)
            self.rows.append(await self._measure(case, shape))
        self.stop("measured")

    async def _measure(self, case: str, shape: tuple[int, ...] | None) -> Row:
        data = None if shape is None else np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        samples = self.samples if data is None else max(self.samples // 4, BLOCK)
        taken: dict[str, list[int]] = {"ours": [], "zenoh": []}
        for _, side in in_turns(taken, -(-(samples + WARM_UP) // BLOCK)):
            if side == "ours":
                taken[side] += [await self._exchange(data) for _ in range(BLOCK)]
            else:
                taken[side] += await asyncio.to_thread(self.raw.round_trips, data, BLOCK)
        burst = 200 if data is None else 20
        bursts = {
            "ours": [await self._exchange(data, burst) for _ in range(5)],
            "zenoh": [await asyncio.to_thread(self.raw.exchange, data, burst) for _ in range(5)],
        }
        return {
            "case": case,
            "bytes": 64 if data is None else data.nbytes,
            "samples": samples,
            **pair({side: times[WARM_UP:] for side, times in taken.items()}),
            **{
                f"{side}_per_second": burst * 1e9 / float(np.median(times))
                for side, times in bursts.items()
            },
        }

    async def _exchange(self, data: npt.NDArray[np.uint8] | None, count: int = 1) -> int:
        """Return the nanoseconds of a burst; of small events only the last is answered."""
        begin = time.perf_counter_ns()
        for number in range(count):
            now = self.clock.now()
            if data is None:
                last = number == count - 1
                self.questions.send(Asked(stamp=now, source=self.name, number=0, answer=last))
            else:
                self.images.send(Image(stamp=now, source=self.name, frame_id="f", data=data))
        for _ in range(1 if data is None else count):
            await anext(self.answers)
        return time.perf_counter_ns() - begin


class Raw:
    """The asking end of two bare sessions."""

    def __init__(self, locator: str) -> None:
        self.session = zenoh_session(listen=locator)
        self._put = zenoh_publisher(self.session, "asked").put
        self._answered = threading.Semaphore(0)
        self._kept = zenoh_subscriber(self.session, "answered", lambda _: self._answered.release())

    def round_trips(self, data: npt.NDArray[np.uint8] | None, count: int) -> list[int]:
        """Return the nanoseconds of each."""
        return [self.exchange(data) for _ in range(count)]

    def exchange(self, data: npt.NDArray[np.uint8] | None, count: int = 1) -> int:
        """Return the nanoseconds of a burst."""
        begin = time.perf_counter_ns()
        for _ in range(count):
            # Zenoh takes no arrays; their bytes are new each time, as an image is.
            self._put(b"x" * 64 if data is None else data.tobytes())
        for _ in range(count):
            self._answered.acquire()
        return time.perf_counter_ns() - begin


def measure(*, samples: int = 1000, progress: Progress = silent) -> list[Row]:
    """Measure small events and images.

    Args:
        samples: Round trips with small events on each side; a quarter with images.
    """
    meet, locator = f"tcp/127.0.0.1:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    Asker.samples, Asker.progress, Asker.rows = samples, staticmethod(progress), []
    code = f"from bench.bridge import mirror; mirror({meet!r}, {locator!r})"
    with program("-c", code) as process:
        Asker.raw = Raw(locator)
        with Asker.raw.session:
            execute(_config(meet), only=["asker"])
        process.wait(10)
    return Asker.rows


def mirror(meet: str, locator: str) -> None:
    """Run the answering process: a node, and a bare Zenoh session."""
    with zenoh_session(connect=locator) as session:
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


def measure_ros_images(*, repeats: int = 300, progress: Progress = silent) -> list[Row]:
    """Measure a colour image and a depth image of 512×512."""
    progress("images for ROS")
    colours, depth = random_images(512)
    return [_measure_encoding(*side, repeats) for side in (("rgb8", colours), ("32FC1", depth))]


def _measure_encoding(encoding: str, data: npt.NDArray[Any], repeats: int) -> Row:
    encoders = {"ours": _by_the_bridge(encoding, data), "rosbags": _by_rosbags(encoding, data)}
    ours, theirs = encoders.values()
    for number in range(ENCODED_FIRST):
        if bytes(ours(number)) != bytes(theirs(number)):
            raise AssertionError(f"{encoding}: expected the same bytes of both")
    taken: dict[str, list[int]] = {side: [] for side in encoders}
    for number, side in in_turns(encoders, repeats):
        begin = time.perf_counter_ns()
        encoders[side](number)
        taken[side].append(time.perf_counter_ns() - begin)
    height, width = data.shape[:2]
    case = f"{width}×{height} {encoding}"
    return {"case": case, "bytes": len(ours(0)), "samples": repeats, **pair(taken)}


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
