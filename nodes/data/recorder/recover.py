"""The command ``recover``: mends recordings of killed runs or full disks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from nodes.data.mcap import layout
from nodes.data.mcap import native as records
from nodes.data.mcap.layout import RecordingError, is_being_written, unwritable
from nodes.data.mcap.mcap_file import contents

MENDED = "visnav_mended"  # metadata record of a mended file: the unreadable parts, by number


class Recovery(msgspec.Struct, frozen=True):
    """Result of mending a file."""

    path: Path
    messages: int
    trouble: list[str]  # parts unread, now or when mended before; empty if the file was whole
    mended: bool  # whether the file was written again
    partial: bool  # whether messages are missing before the last one, too


def recover_file(path: Path, out: Path | None = None) -> Recovery:
    """Write a whole, indexed file from the readable parts of a torn file.

    Args:
        out: The whole file; if `None`, it replaces the torn one when complete. A file with an index
            is left alone then, for its damaged parts may be of use.

    Raises:
        RecordingError: The file is no MCAP file, unreadable or being written, or the other cannot
            be written.
    """
    recording = contents(path)
    with records.open_file(path) as file:
        if is_being_written(file):
            raise RecordingError(f"{path}: expected a file that is done, found one being written")
    if recording.complete and out is None:
        trouble: list[str] = []
        messages = sum(isinstance(r, records.Message) for r in _records(path, trouble))
        trouble += recording.metadata.get(MENDED, {}).values()
        return Recovery(path, messages, trouble, mended=False, partial=bool(trouble))
    if out is not None and out.exists():
        raise RecordingError(f"{out}: expected the name of a new file, found one that is there")
    target = out or path.with_name(f"{path.name}.mended")
    try:
        messages, trouble = _write_readable(path, target)
        if not messages:
            raise RecordingError(f"{path}: expected messages, found none that can be read")
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    if out is None:
        target.replace(path)
    partial = any(problem != layout.NOT_CLOSED for problem in trouble)
    return Recovery(out or path, messages, trouble, mended=True, partial=partial)


def _records(path: Path, trouble: list[str]) -> Iterator[Any]:
    return records.records(path, 0, None, trouble.append, with_metadata=True)


def _write_readable(path: Path, out: Path) -> tuple[int, list[str]]:
    """Write a file's readable messages, with an index; return their number, and the troubles."""
    trouble: list[str] = []
    messages = 0
    with records.open_file(path) as torn:
        header = records.header_of(torn)
    try:
        with out.open("wb") as file:
            writer = records.writer(
                file,
                compression="zstd",
                chunk_size=4 << 20,
                profile=header.profile,
                library=header.library,
            )
            schemas: dict[int, int] = {0: 0}
            channels: dict[int, int] = {}
            for record in _records(path, trouble):
                match record:
                    case records.Schema():
                        if record.id not in schemas:
                            schema = record.name, record.encoding, record.data
                            schemas[record.id] = writer.register_schema(*schema)
                    case records.Channel(topic=topic, message_encoding=encoding, metadata=metadata):
                        if record.id not in channels:
                            schema_id = schemas.get(record.schema_id, 0)  # a damaged chunk's
                            number = writer.register_channel(topic, encoding, schema_id, metadata)
                            channels[record.id] = number
                    case records.Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case records.Attachment(create_time=created, log_time=time):
                        file_ = record.name, record.media_type, record.data
                        writer.add_attachment(created, time, *file_)
                    case records.Message(log_time=time, publish_time=published):
                        number = channels[record.channel_id]
                        writer.add_message(number, time, record.data, published, record.sequence)
                        messages += 1
            lost = [problem for problem in trouble if problem != layout.NOT_CLOSED]
            if lost:  # recorded, as a file with an index looks complete
                writer.add_metadata(MENDED, {str(n): problem for n, problem in enumerate(lost, 1)})
            writer.finish()  # type: ignore[no-untyped-call]
            file.flush()
            os.fsync(file.fileno())  # it may replace the only copy
    except OSError as error:
        raise unwritable(out, error) from error
    return messages, trouble


def recover(
    file: Annotated[Path, typer.Argument(help="A recording: runs/<name>/latest/recording.mcap.")],
    out: Annotated[
        Path | None,
        typer.Option(help="A new file to write; if not given, the whole file replaces the torn."),
    ] = None,
) -> None:
    """Mend the recording of a killed run, or of a run with a full disk.

    Readable messages are written to a complete file with an index; at most the last second of such
    a run is missing. A file with an index is only checked.
    """
    from runtime.errors import ConfigError

    try:
        result = recover_file(file, out)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from None
    for problem in result.trouble:
        print(f"{file}: {problem}")
    partial = "; what is named above is missing" if result.partial else ""
    if result.mended:
        print(f"{result.path}: {result.messages} messages, now with an index{partial}")
    elif result.partial:
        print(f"{result.path}: {result.messages} messages, has its index, left as it is{partial}")
    else:
        print(f"{result.path}: {result.messages} messages, complete, nothing to mend")
