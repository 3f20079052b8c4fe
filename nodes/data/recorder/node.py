"""Records a run: all its events, as MCAP, beside the loop."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path

from events import Announcement, Event
from nodes.data.mcap.layout import RecordingError
from nodes.data.recorder.writer_process import (
    STANDSTILL,
    Backlog,
    McapRecorderConfig,
    WriteRequest,
    WriterProcess,
)
from nodes.trajectory_files import part_name
from runtime import Input, Node
from runtime.workers.worker import spare_cores

_WAITING = 1 << 16  # event queue length while simulated time waits: above any number sent at a time
_LOOK = 0.5  # real seconds between checks of the process while simulated time waits
_END_TIMEOUT = 8.0  # real seconds for the end of the run; `run.shutdown_limit` is 10 by default


class McapRecorder(Node[McapRecorderConfig]):
    """Recorder of all events, for ROS 2 tools, Foxglove and `nodes.data.replay`.

    ::

        [[nodes]]
        name = "recorder"
        type = "McapRecorder"

    Put it first in the file: events are recorded in the order of arrival, causes before effects
    then.
    """

    reads_truth = "recording"
    events = Input(Event, bound=_WAITING, overflow="drop_oldest")

    def __init__(self) -> None:
        self._process: WriterProcess | None = None
        self._backlog = Backlog(self.config.memory, self.config.when_full)
        self._failed: asyncio.Future[RecordingError] | None = None
        self._ended_run = False
        self._unfinished: int | None = None  # end of the run (ns), while yet to be written
        self._warned_at = 1
        self._pauses = 0
        self._pause_seconds = 0.0

    async def on_startup(self) -> None:
        """Open the file; a `FatalError` if it cannot be written."""
        if self.out is None:
            if not self.checking:
                self.log.warning("the run writes no files, so nothing is recorded")
            return
        config = self.config
        if config.when_full == "wait" and self.clock.kind == "real":
            self._backlog.when_full = "drop_images"
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        try:
            self._process = await self.offload(self._open_file, loop)
        except RecordingError as error:
            self.log.fatal("%s", error)
        assert self._process is not None
        self._process.start()
        self.after_run(self._finish)

    def on_announcement(self, announcement: Announcement) -> None:
        """Record an announcement; a bare `Announcement` only names sources: left out."""
        if self._process is not None and type(announcement) is not Announcement:
            self._backlog.add(0, announcement)

    async def run(self) -> None:
        """Pass all events to the thread feeding the writing process."""
        if self._process is None:
            return
        self.start(self._end_run_on_failure())
        clock, backlog, add_event = self.clock, self._backlog, self._backlog.add
        waits = backlog.when_full == "wait"
        async for event in self.events:
            add_event(clock.now(), event)
            if backlog.dropped >= self._warned_at:
                self._warn()
            if waits and backlog.is_full:
                await self._wait_for_disk()

    async def on_shutdown(self) -> None:
        """Write queued events and the index, on a slow disk after the run, or end with an error."""
        process, backlog = self._process, self._backlog
        if process is None:
            return
        while self.events.statistics().buffered:
            backlog.add(self.clock.now(), self.events.receive_nowait())
        self._unfinished = self.clock.now()
        if not await self.offload(process.close, self._unfinished, _END_TIMEOUT):
            megabytes = backlog.bytes / 1e6
            self.log.warning("%.1f MB are yet to be written: that goes on after the run", megabytes)
            return
        self._unfinished = None
        self._log_result(process)
        if process.error is not None and not self._ended_run:
            self.log.fatal("%s", process.error)

    def _finish(self, _: Path) -> None:
        process = self._process
        if process is None or self._unfinished is None:
            return
        process.close(self._unfinished)
        if process.error is not None:
            raise process.error

    def _log_result(self, process: WriterProcess) -> None:
        backlog, result = self._backlog, process.result
        lost = backlog.dropped + process.unwritten
        self.events.dropped += lost
        if result.kind != "gone":  # it did not report how many there are
            pauses = f"{self._pauses} times for the disk, {self._pause_seconds:.1f} s in all"
            self.log.info(
                "%s: %d events, %.1f MB; at most %.1f MB waited%s",
                Path(process.path).name,
                result.written,
                result.size / 1e6,
                backlog.peak / 1e6,
                f", and simulated time {pauses}" if self._pauses else "",
            )
        if lost:
            self.log.warning(
                "%d events are not in the recording%s",
                lost,
                ", nor is what its process had yet to write" if result.kind == "gone" else "",
            )

    def _open_file(self, loop: asyncio.AbstractEventLoop) -> WriterProcess:
        assert self.out is not None

        def complain(text: str) -> None:
            with contextlib.suppress(RuntimeError):  # the run is over
                loop.call_soon_threadsafe(self.log.warning, "%s", text)

        def failed(error: RecordingError) -> None:
            with contextlib.suppress(RuntimeError):  # the run is over, and `_finish` raises it
                loop.call_soon_threadsafe(self._fail, error)

        path = self.out / part_name(self, self.config.file)
        is_first = self.name == self.siblings(McapRecorder)[0].name  # a folder is one bag at most
        request = WriteRequest(
            path=str(path),
            config=self.config,
            attachment=str(self.out / "config.toml"),
            niceness=5,
            cores=spare_cores() if self.clock.kind == "real" else (),
            metadata=str(path.with_name("metadata.yaml")) if is_first else "",
        )
        return WriterProcess(request, self._backlog, failed, complain)

    def _fail(self, error: RecordingError) -> None:
        if self._failed is not None and not self._failed.done():
            self._failed.set_result(error)

    async def _end_run_on_failure(self) -> None:
        assert self._failed is not None
        error = await self._failed
        self._ended_run = True
        self.log.fatal("%s", error)

    async def _wait_for_disk(self) -> None:
        if not self._pauses:
            self.log.info(
                "the disk is slower than the run: simulated time waits, now and again, with "
                "%.0f MB to write",
                self._backlog.bytes / 1e6,
            )
        start = time.monotonic()
        assert self._process is not None
        self._process.seconds_without_progress()  # counted from now on
        while not await self.offload(self._backlog.wait_for_room, _LOOK):
            if self._process.seconds_without_progress() >= STANDSTILL:
                self.log.fatal("%s", self._process.standstill_error())
        self._pauses += 1
        self._pause_seconds += time.monotonic() - start

    def _warn(self) -> None:
        dropped = self._backlog.dropped
        self._warned_at = 10 * dropped
        self.log.warning(
            "the disk is too slow: %d events dropped so far (%s)", dropped, self._backlog.when_full
        )
