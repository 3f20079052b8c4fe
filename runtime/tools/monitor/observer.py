"""Makes snapshots of a run, its log's last records included, and carries commands out.

All of it happens on the run's loop.

The newest image of a camera as a small JPEG, made in a thread and only when a page asks.
"""

from __future__ import annotations

import asyncio
import collections
import itertools
import logging
import os
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import Image
from runtime.config.model import Config
from runtime.config.parameters import settings
from runtime.errors import CommandError, suggest
from runtime.node import NodeConfig, senders, streams
from runtime.run.node_runner import NodeRunner
from runtime.run.summarise import count_drops
from runtime.run.supervisor import Supervisor
from runtime.time.schedule import SECOND
from runtime.tools.monitor.command import Command, Pause, Restart, Resume, Set, Speed, Step, Stop
from runtime.tools.monitor.snapshot import (
    ClockState,
    InputState,
    LinkState,
    LogLine,
    Meter,
    NodeCondition,
    NodeState,
    OutputState,
    RecentSamples,
    Sample,
    Snapshot,
    TickState,
)

KEPT = 100


class LastRecords(logging.Handler):
    """A handler that keeps the last records; runs in the log's own thread."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: collections.deque[LogLine] = collections.deque(maxlen=KEPT)
        self._numbers = itertools.count()

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record."""
        self._lines.append(
            LogLine(
                number=next(self._numbers),
                seconds=getattr(record, "seconds", 0.0),
                level=record.levelname,
                logger_name=getattr(record, "logger_name", record.name),
                text=record.getMessage(),
            )
        )

    def lines(self) -> list[LogLine]:
        """Return the records, the oldest first."""
        return list(self._lines)


class Observer:
    """Observes and controls one run."""

    def __init__(self, supervisor: Supervisor, config: Config, records: LastRecords) -> None:
        self._supervisor = supervisor
        self._state = supervisor.state
        self._config = config
        self._records = records
        self._meter: Meter | None = None
        self._recent = RecentSamples(self._sample())
        self._settings: dict[str, tuple[NodeConfig, dict[str, str]]] = {}
        """Of each node, with their text, which seldom changes."""
        self._number = 0

    def begin(self) -> None:
        """Begin to measure: somebody watches."""
        if self._meter is None:
            self._meter = Meter(self._state.clock)
            self._supervisor.instruments.attach(self._meter)
            self._recent = RecentSamples(self._sample())

    def end(self) -> None:
        """Stop measuring: nobody watches."""
        if self._meter is not None:
            self._supervisor.instruments.detach(self._meter)
            self._meter = None
            self._recent = RecentSamples(self._sample())

    # Snapshots.

    def take(self) -> Snapshot:
        """Return a snapshot of now and of the last second or so."""
        state = self._state
        self._number += 1
        sample = self._sample()
        self._recent.add(sample)
        now = sample.run
        return Snapshot(
            run=self._config.run.name,
            pid=os.getpid(),
            number=self._number,
            ended=state.reason,
            clock=ClockState(
                kind=state.clock.kind,
                now=now / SECOND,
                duration=float(self._config.run.duration),
                speed=self._recent.run / self._recent.real,
                target_speed=self._supervisor.stepping.target_speed,
                paused=self._supervisor.stepping.state != "running",
                fixed=self._supervisor.stepping.fixed(),
            ),
            nodes=[self._node(runner) for runner in state.runners.values()],
            outputs=self._outputs(sample),
            inputs=[
                InputState(
                    name=stream.name,
                    buffered=stream.statistics().buffered,
                    peak=found.peak,
                    bound=found.bound,
                    dropped=found.dropped,
                )
                for stream, found in self._inputs()
            ],
            links=[
                LinkState(name=link.name, lost=link.lost, thinned=link.thinned)
                for link in state.links.values()
            ],
            ticks=[
                TickState(
                    name=name,
                    hz=ticker.hz,
                    calls=ticker.calls,
                    missed=ticker.missed,
                    late_p99_us=ticker.late.quantile(0.99) / 1e3,
                    late_max_us=ticker.late.maximum / 1e3,
                )
                for name, ticker in state.tickers.items()
            ],
            cameras=sorted(self._meter.images) if self._meter is not None else [],
            log=self._records.lines(),
        )

    def image(self, camera: str) -> Image:
        """Return the newest image of one of a snapshot's cameras.

        Raises:
            CommandError: It has sent no image, or nobody watches.
        """
        images = self._meter.images if self._meter is not None else {}
        if camera not in images:
            raise CommandError(
                f"expected a camera that has sent images, found {camera!r}{suggest(camera, images)}"
            )
        return images[camera]

    def _sample(self) -> Sample:
        """Return the counters, with what was measured since the last sample."""
        sent: Counter[str] = Counter()
        for node in self._state.all_nodes:
            for sender in senders(node).values():
                sent[sender.name] += sender.sent().total()
        meter = self._meter
        return Sample(
            time.perf_counter(),
            self._state.clock.now(),
            sent,
            {} if meter is None else {name: sum_.take() for name, sum_ in meter.nodes.items()},
            {} if meter is None else {name: sum_.take() for name, sum_ in meter.outputs.items()},
        )

    def _node(self, runner: NodeRunner) -> NodeState:
        steps, real = self._recent.node(runner.spec.name), self._recent.real
        return NodeState(
            name=runner.spec.name,
            type=runner.spec.type_name,
            condition=self._condition(runner),
            failures=runner.failures,
            share=steps.total / 1e9 / real,
            steps=steps.times / real,
            longest_ms=steps.longest / 1e6,
            calls=sum(worker.outstanding() for worker in runner.workers),
            settings=self._shown(runner),
        )

    def _shown(self, runner: NodeRunner) -> dict[str, str]:
        config = runner.node.config if runner.node else runner.spec.config
        known = self._settings.get(runner.spec.name)
        if known is None or known[0] is not config:
            known = self._settings[runner.spec.name] = config, settings(config)
        return known[1]

    def _condition(self, runner: NodeRunner) -> NodeCondition:
        if runner.restarting:
            return "left out" if runner.spec.on_error == "drop" else "restarting"
        if self._state.reason and not runner.started:
            return "over"
        if runner.node is None:
            return "waiting"
        if not runner.started:
            return "starting"
        return "running" if self._state.running else "ready"

    def _outputs(self, sample: Sample) -> list[OutputState]:
        events = {
            sender.name: sender.event.__name__
            for node in self._state.all_nodes
            for sender in senders(node).values()
        }
        last = self._meter.outputs if self._meter is not None else {}
        found = []
        for name, event in events.items():
            flow = self._recent.output(name)
            found.append(
                OutputState(
                    name=name,
                    event=event,
                    count=sample.sent[name],
                    rate=self._recent.rate(name),
                    age=(sample.run - last[name].last) / SECOND if name in last else None,
                    latency_ms=flow.total / flow.times / 1e6 if flow.times else None,
                    latency_max_ms=flow.longest / 1e6 if flow.times else None,
                )
            )
        return found

    def _inputs(self) -> list[tuple[Any, Any]]:
        drops = count_drops(self._state)
        return [
            (stream, drops[stream.name])
            for runner in self._state.runners.values()
            if runner.node is not None
            for stream in streams(runner.node).values()
        ]

    # Commands.

    def execute(self, command: Command) -> str:
        """Carry a command out, and return what was done.

        Raises:
            VisnavError: It cannot be carried out; the message says why.
        """
        stepping = self._supervisor.stepping
        match command:
            case Pause():
                stepping.pause()
                return "paused"
            case Resume():
                stepping.resume()
                return "runs"
            case Step(seconds=seconds):
                stepping.step(None if seconds is None else max(round(seconds * SECOND), 1))
                return "one step" if seconds is None else f"runs for {seconds:g} s"
            case Speed(factor=factor):
                stepping.pace(factor)
                return "as fast as it can" if factor is None else f"{factor:g} × real time"
            case Stop():
                self._supervisor.stop("stopped by hand")
                return "ends"
            case Restart(node=node):
                return self._restart(node)
            case Set(text=text):
                values = self._supervisor.parameters.set(text)
                return ", ".join(f"{key} = {value}" for key, value in values.items()) or "as it was"

    def _restart(self, name: str) -> str:
        runners = self._state.runners
        if name not in runners:
            raise CommandError(
                f"expected the name of a node, found {name!r}{suggest(name, runners)}"
            )
        condition = self._condition(runners[name])
        if condition not in {"running", "left out"}:
            raise CommandError(f"expected a node that runs, and {name} is {condition}")
        self._supervisor.restart(name, anyway=True)
        return f"{name} restarts"


def describe(command: Command) -> str:
    """Return a command as text, for the log."""
    words = [str(v) for v in msgspec.structs.astuple(command) if v is not None]
    return " ".join([type(command).__name__.lower(), *words])


MAX_SIDE = 480
"""Pixels of an encoded image's longer side at most."""

PERIOD = 0.25
"""Real seconds between two encoded images of a camera at least, however many pages ask."""

QUALITY = 75
"""Quality of the JPEG, of 100."""


class ImageEncoder:
    """Encodes images beside the run's loop, at most one per camera and `PERIOD`."""

    def __init__(self) -> None:
        self._encoded: dict[str, tuple[float, bytes]] = {}
        self._lock = asyncio.Lock()

    async def encode(self, camera: str, newest: Callable[[], Awaitable[Image]]) -> bytes:
        """Return the JPEG of a camera's newest image.

        Args:
            newest: Gets its newest image; not called if the last JPEG is younger than `PERIOD`.
        """
        async with self._lock:
            now = time.monotonic()
            made, jpeg = self._encoded.get(camera, (-np.inf, b""))
            if now - made >= PERIOD:
                image = await newest()
                jpeg = await asyncio.to_thread(small_jpeg, image.data)
                self._encoded[camera] = now, jpeg
            return jpeg


def small_jpeg(data: npt.NDArray[np.uint8]) -> bytes:
    """Return an image as JPEG, made smaller where a side is longer than `MAX_SIDE` pixels.

    Args:
        data: Pixels, shape (height, width, 3) in RGB, or (height, width) in grey.
    """
    import cv2  # not before somebody asks for an image

    pixels: Any = data
    height, width = data.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale < 1.0:
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if data.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
