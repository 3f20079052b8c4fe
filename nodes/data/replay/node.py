"""A recording in the place of the simulator: the same announcements, events, stamps and sources."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from events import Announcement, Event, Odometry, TrajectoryEstimate, VehicleAnnouncement
from nodes.data.replay.bags import Recorded, RosBag, is_recording
from nodes.data.replay.chains import chain_of
from nodes.data.replay.reader import Choice, Reader, ReplayConfig, ReplayError, Timed
from runtime import Node, Output
from runtime.extras import READERS, others
from runtime.run.results import newest
from runtime.time.clock import SECOND

Batch = list[Timed]

MOST = 64  # events of a batch
LARGEST = 4 << 20  # bytes of a batch, without its last event; fixed, for reproducible batches
_SMALL = 512


class ReadAhead:
    """Events from a thread, batch by batch, up to a limit of bytes that may wait."""

    def __init__(self, events: Iterator[Timed], limit: int) -> None:
        self._events, self._limit = events, limit
        self._batches: deque[tuple[Batch, int]] = deque()
        self._waiting = 0
        self.peak = 0  # largest number of bytes waiting so far
        self._change = threading.Condition()
        self._ended = False
        self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="read ahead", daemon=True)
        self._thread.start()

    def pop(self) -> Batch | None:
        """Wait for the next batch or an error (not on a loop); return `None` at the end."""
        with self._change:
            self._change.wait_for(lambda: self._batches or self._ended)
            if self._batches:
                batch, size = self._batches.popleft()
                self._waiting -= size
                self._change.notify_all()
                return batch
            if self._error is not None:
                raise self._error
            return None

    def close(self) -> None:
        """Stop reading; returns when the thread is done. Not on a loop."""
        with self._change:
            self._closed = True
            self._change.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._read()
        except BaseException as error:
            self._error = error
        finally:
            with contextlib.suppress(Exception):  # no generator, or one that cannot be closed
                self._events.close()  # type: ignore[attr-defined]
            with self._change:
                self._ended = True
                self._change.notify_all()

    def _read(self) -> None:
        batch: Batch = []
        size = 0
        for event in self._events:
            batch.append(event)
            size += _event_size(event)
            if len(batch) >= MOST or size >= LARGEST:
                if not self._add(batch, size):
                    return
                batch, size = [], 0
        self._add(batch, size)

    def _add(self, batch: Batch, size: int) -> bool:
        """Add a batch when there is room; return False after `close`."""
        with self._change:
            while self._waiting and self._waiting + size > self._limit and not self._closed:
                self._change.wait()
            if self._closed:
                return False
            if batch:
                self._batches.append((batch, size))
                self._waiting += size
                self.peak = max(self.peak, self._waiting)
                self._change.notify_all()
            return True


def _event_size(timed: Timed) -> int:
    event = timed.event
    values = (getattr(event, name) for name in event.__struct_fields__)
    return _SMALL + sum(value.nbytes for value in values if isinstance(value, np.ndarray))


def open_reader(config: ReplayConfig, name: str) -> Reader:
    """Return a reader of a recording; a `ReplayError` if nothing there can be read."""
    path = newest(Path(config.file))
    vehicle = config.vehicle or name
    if (path / "recording.mcap").is_file() and not config.topics:  # a run's folder
        path /= "recording.mcap"
    # Readers are imported when needed: scipy and rosbags take tenths of a second.
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        if (bag := _only_bag(path)) is not None:
            path = bag
        else:
            from nodes.data.replay.datasets import open_folder

            return open_folder(path, config, vehicle)
    if not path.is_dir() and not path.is_file():
        raise ReplayError(
            f"{path}: expected a recording or the folder of a data set, found nothing there; "
            "docs/how-to/datasets.md says where to download those of EuRoC, TUM and KITTI"
        )
    if path.is_file() and others(READERS):
        from nodes.data.replay.datasets import open_other

        if (reader := open_other(path, config, vehicle)) is not None:
            return reader
    if path.is_file() and path.suffix not in {".db3", ".bag"} and is_recording(path):
        if config.calibration:
            raise ReplayError(
                "calibration: expected a bag of ROS or a data set in EuRoC's layout beside it, "
                f"found a recording, whose cameras are announced in it: {path}"
            )
        return Recorded(path)
    return RosBag(path, config.topics, vehicle, chain_of(config))


def _only_bag(folder: Path) -> Path | None:
    """Return the only bag of a folder without metadata.yaml; `None` if there is none.

    Raises:
        ReplayError: There are several.
    """
    bags = sorted(path for path in folder.iterdir() if path.suffix in _BAGS and path.is_file())
    if len(bags) > 1:
        raise ReplayError(
            f"{folder}: expected one bag, or a bag of ROS 2 of several files with its "
            f"metadata.yaml (`ros2 bag reindex` writes it), found {len(bags)} bags: "
            f"{', '.join(path.name for path in bags[:5])}{', …' * (len(bags) > 5)}; "
            "name one in file"
        )
    return bags[0] if bags else None


_BAGS = {".bag", ".db3", ".mcap"}


class Timeline:
    """Map from recording times to the run's clock, by the stretches played."""

    def __init__(self) -> None:
        self._stretches: list[tuple[int, int, bool]] = []
        """Start on the recording (ns), start on the run (ns), whether a pause precedes."""
        self.shift = 0  # the run's clock less the recording's time now (ns)

    def start_stretch(self, position: int, now: int, *, pause: bool = False) -> None:
        """Start a stretch: the recording is played from `position` at `now` (run, ns)."""
        self._stretches.append((position, now, pause))
        self.shift = now - position

    def moved(self, event: Event) -> Event | None:
        """Return an event on the run's clock; `None` if true before the run.

        A stamp before a pause stays where it was; poses of a trajectory that were not played are
        left out.
        """
        if not self.shift and len(self._stretches) < 2:
            return event
        stamp = self._stamp(event.stamp)
        if stamp < 0:
            return None
        if isinstance(event, TrajectoryEstimate):
            played, stamps = self._stamps(event.stamps)
            return msgspec.structs.replace(
                event,
                stamp=stamp,
                stamps=stamps[played],
                positions=event.positions[played],
                orientations=event.orientations[played],
            )
        return msgspec.structs.replace(event, stamp=stamp)

    def _stamp(self, time: int) -> int:
        shift = 0
        for position, now, pause in reversed(self._stretches):
            shift = now - position
            if time >= position or not pause:
                break
        return time + shift

    def _stamps(
        self, times: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
        """Return a mask of the times played, and their last time on the run's clock."""
        played, stamps = np.zeros(times.shape, np.bool_), times.copy()
        first = last = np.iinfo(np.int64).max  # of what was played later: on recording and run
        for position, now, _ in reversed(self._stretches):
            mask = (times >= position) & (times < min(first, last - now + position))
            stamps[mask] += now - position
            played |= mask
            first, last = min(first, position), now
        return played, stamps


_SLICE = SECOND // 10  # in real time, how long a sleep may keep `seek` waiting (ns)


class Replay(Node[ReplayConfig]):
    """Player of recorded events, each at its time, on either clock.

    ::

        [[nodes]]
        name = "replay"
        type = "Replay"
        file = "../runs/record/latest/recording.mcap"

    The run ends with the recording. Meanwhile ``python -m runtime set replay.paused=true`` and
    ``replay.position=12s`` do as `pause` and `seek`, which are for the loop's thread.
    """

    ends_run = "plan"
    relays_estimates = True

    events = Output(Event)

    def __init__(self) -> None:
        self._reader: Reader | None = None
        self._ahead: ReadAhead | None = None
        self._announcements: list[Announcement] = []
        self._timeline = Timeline()
        self._paused_at: int | None = None
        self._resumed = asyncio.Event()
        self._target: int | None = None
        self._logged = 0
        self._logged_left_out = 0
        self.sent = 0
        if self.config.paused:
            self.pause()

    async def on_startup(self) -> None:
        """Open the recording; a `FatalError` if it cannot be read."""
        try:
            await self.offload(self._open)
        except ReplayError as error:
            self.log.fatal("%s", error)
        assert self._reader is not None
        for note in self._reader.notes:
            self.log.info("%s: %s", self.config.file, note)
        self._log_trouble()

    def announce(self) -> Iterable[Announcement]:
        """Announce the recorded announcements, and this node as source of the events."""
        return [*self._announcements, Announcement(stamp=0, source="*")]

    async def run(self) -> None:
        """Send all events from start to end, repeatedly if set."""
        assert self._reader is not None
        start = round(self.config.start * SECOND)
        end = round(self.config.end * SECOND) or None
        position = start
        while True:
            self._timeline.start_stretch(position, self.clock.now())
            last = await self._play(position, end)
            if last is None and not self.sent and self._target is None:
                self.log.fatal("%s", self._nothing())
            last = position if last is None else last
            over = end or self._reader.end() or last + round(self.config.linger * SECOND)
            over = max(over, last)
            await self._sleep_until(over)
            if self._target is not None:
                position, self._target = self._target, None
            elif self.config.loop:
                if over <= start:
                    self.log.fatal(
                        "loop: expected a recording that takes some time, found one moment"
                    )
                position = start
            else:
                break
        self._log_trouble()
        if named := ", ".join(sorted(self._choice.unmatched)):
            self.log.warning("only, skip: nothing in the recording is of %s", named)
        self.stop("the recording ended")

    async def on_shutdown(self) -> None:
        """Close the recording."""
        await self._close_ahead()
        self._log_trouble()
        if self._reader is not None:
            await self.offload(self._reader.close)

    def on_change(self, before: ReplayConfig) -> None:
        """Pause, resume, or seek."""
        if self.config.paused != before.paused:
            (self.pause if self.config.paused else self.resume)()
        if self.config.position != before.position:
            self.seek(self.config.position)

    def pause(self) -> None:
        """Send nothing until `resume`; the clock continues."""
        if self._paused_at is None:
            self._paused_at = self.clock.now()
            self._resumed.clear()

    def resume(self) -> None:
        """Continue at the position of `pause`."""
        if self._paused_at is not None:
            position = self._paused_at - self._timeline.shift
            self._timeline.start_stretch(position, self.clock.now(), pause=True)
            self._paused_at = None
            self._resumed.set()

    def seek(self, seconds: float) -> None:
        """Continue at another time of the recording; stamps stay on the run's clock."""
        self._target = max(round(seconds * SECOND), 0)

    @property
    def position(self) -> float:
        """Return the position in the recording, now or on resuming, seconds."""
        if self._target is not None:
            return self._target / SECOND
        now = self.clock.now() if self._paused_at is None else self._paused_at
        return (now - self._timeline.shift) / SECOND

    async def _play(self, start: int, end: int | None) -> int | None:
        assert self._reader is not None
        await self._close_ahead()
        events = self._reader.events(start, end, self._choice)
        self._ahead = ahead = ReadAhead(events, self.config.memory)
        send, now, timeline = self.events.send, self.clock.now, self._timeline
        last = None
        try:
            while (batch := await self.offload(ahead.pop)) is not None:
                for last, event in batch:
                    if last + timeline.shift > now() or self._paused_at is not None:
                        await self._sleep_until(last)
                    if self._target is not None:
                        return last
                    if (moved := timeline.moved(event)) is not None:
                        self.sent += 1
                        send(moved)
        except ReplayError as error:
            self.log.fatal("%s", error)
        return last

    async def _sleep_until(self, time: int) -> None:
        """Wait for a time of the recording; return early if `seek` was called."""
        real = self.clock.kind == "real"
        while self._target is None:
            if self._paused_at is not None:
                await self._resumed.wait()
                continue
            now, due = self.clock.now(), time + self._timeline.shift
            if due <= now:
                return
            await self.clock.sleep_until(min(due, now + _SLICE) if real else due)

    def _open(self) -> None:
        config = self.config
        self._reader = reader = open_reader(config, self.name)
        announced = reader.announcements()
        self._choice = Choice(config.only, config.skip, announced)
        self._announcements = [a for a in announced if self._choice.announced(a)]
        if config.start:
            self._announcements = [self._at_start(reader, a) for a in self._announcements]

    def _at_start(self, reader: Reader, announcement: Announcement) -> Announcement:
        if not isinstance(announcement, VehicleAnnouncement):
            return announcement

        def wants(kind: type[Event], source: str) -> bool:
            return issubclass(kind, Odometry) and source == announcement.source

        events = reader.events(round(self.config.start * SECOND), None, wants)
        event = next((recorded.event for recorded in events), None)
        if not isinstance(event, Odometry):
            return announcement
        return msgspec.structs.replace(
            announcement,
            stamp=event.stamp - round(self.config.start * SECOND),
            control_rate=0.0,  # in mid-recording, it may be moving
            position=event.position,
            orientation=event.orientation,
        )

    def _nothing(self) -> str:
        config, named = self.config, ", ".join(sorted(self._choice.unmatched))
        return (
            f"{config.file}: expected events that are wanted, found none"
            + (f" from {config.start:g} s on" if config.start else "")
            + (f" to {config.end:g} s" if config.end else "")
            + (f" of {named}" if named else "")
            + "".join(f"; {problem}" for problem in (self._reader.trouble if self._reader else []))
        )

    def _log_trouble(self) -> None:
        if self._reader is None:
            return
        for problem in self._reader.trouble[self._logged :]:
            self.log.warning("%s: %s", self.config.file, problem)
        self._logged = len(self._reader.trouble)
        if (left_out := self._reader.left_out - self._logged_left_out) > 0:
            self.log.warning(
                "%s: %d events cannot be read, and are left out", self.config.file, left_out
            )
            self._logged_left_out += left_out

    async def _close_ahead(self) -> None:
        if self._ahead is not None:
            ahead, self._ahead = self._ahead, None
            await self.offload(ahead.close)
