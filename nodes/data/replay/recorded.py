"""Recordings of `nodes.data.recorder`: events are restored unchanged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from events import Announcement, CameraAnnouncement, Event
from nodes.data.mcap import native
from nodes.data.mcap.layout import RecordingError
from nodes.data.mcap.mcap_file import Record, contents, read
from nodes.data.mcap.native import HOLDERS, arrays
from nodes.data.replay.reader import Reader, ReplayError, Timed, Wants
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.typestore import TypeStore
from runtime.errors import WireError
from runtime.wire import event_type

_LOOK = 64  # messages searched for our own metadata, in files rewritten by other tools


class Recorded(Reader):
    """Reader of a recording of ours, torn ones too; a `ReplayError` if it is no MCAP file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._store = TypeStore()
        self._frames = FrameNames()
        try:
            self._contents = contents(path)
        except RecordingError as error:
            raise ReplayError(str(error)) from None
        self._announcements = tuple(self._read_announcements())
        for announcement in self._announcements:
            if isinstance(announcement, CameraAnnouncement):
                self._frames.add(announcement)

    def announcements(self) -> Sequence[Announcement]:
        """Return the recorded announcements."""
        return self._announcements

    def events(self, start: int, end: int | None, wants: Wants) -> Iterator[Timed]:
        """Yield the recorded events, equal to the originals."""
        holders: dict[str, Record] = {}  # the newest of each topic, until its event has come
        for record in read(self._path, start, end, self.complain):
            if record.type in HOLDERS:
                holders[record.topic] = record
            kind = record.metadata.get("kind")
            if kind is None or record.metadata.get("announcement"):
                continue
            holder = holders.pop(record.metadata.get("arrays", ""), None)
            try:
                if wants(event_type(kind), record.metadata.get("source", "")):
                    yield Timed(record.time, self._event(record, holder))
            except (WireError, ValueError) as error:
                self.left_out += 1
                self.complain(f"{record.topic}: {error}")

    def end(self) -> int | None:
        """Return the recorder's end time (ns); `None` if not noted."""
        end = self._contents.metadata.get("visnav", {}).get("end", "")
        return int(end) if end.isdigit() else None

    def _event(self, record: Record, holder: Record | None) -> Event:
        lacking = native.lacking(record.data)
        if not lacking:
            return native.event(record.data)
        if holder is None or holder.time != record.time:
            raise ValueError(f"expected a message of {record.time} ns with its arrays, found none")
        # All events with arrays and a message have a frame.
        frame = native.fields(record.data).get("frame_id", "map")
        axes = self._frames.axes(frame)
        found = arrays(self._store, holder.data, holder.type, lacking, axes)
        return native.event(record.data, found)

    def _read_announcements(self) -> Iterator[Announcement]:
        for record in read(self._path):
            if record.metadata.get("announcement"):
                try:
                    event = native.event(record.data)
                except WireError as error:
                    self.complain(f"{record.topic}: {error}")
                    continue
                if isinstance(event, Announcement):
                    yield event
            elif "kind" in record.metadata:
                return


def is_ours(path: Path) -> bool:
    """Return whether a file is our recording, or one rewritten; a `ReplayError` if no MCAP file."""
    try:
        if contents(path).ours:
            return True
        return any("kind" in record.metadata for record in islice(read(path), _LOOK))
    except RecordingError as error:
        raise ReplayError(str(error)) from None
