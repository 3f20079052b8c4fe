"""A recorded run's small sensors as CSV files: one for each sensor and kind of measurement."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from events import Event
from events.measurements import MEASURED, fields_of, numbers
from nodes.trajectory.table import EPOCH, epoch_of
from runtime.paths import source_file


def export_measurements(run: Path, out: Path | None = None, epoch: int | str = EPOCH) -> list[Path]:
    """Write what IMUs, barometers, receivers, … measured: ``<source>.<kind>.csv``.

    Rows are in the order in which the measurements came; a column is named by its field and unit.

    Args:
        run: The run's folder, with recordings (MCAP) in it.
        out: Folder for the files, made if need be; ``export`` in the run's folder if None.
        epoch: The run's time 0: a date (ISO 8601), or nanoseconds of Unix time.

    Returns:
        What was written.

    Raises:
        ValueError: There is no recording, or no measurement in it; or the epoch is none.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    recordings = sorted(run.glob("*.mcap"))
    if not recordings:
        raise ValueError(
            f"{run}: expected a recording (*.mcap), found none: a run leaves one if a node of type "
            "McapRecorder is in it"
        )
    folder = out or run / "export"
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[Path, IO[str]] = {}
    with ExitStack() as stack:
        for path in recordings:
            for event in _measurements(path):
                kind = next(known for known in MEASURED if isinstance(event, known))
                name = f"{source_file(event.source)}.{kind.__name__}.csv"
                file = files.get(folder / name)
                if file is None:
                    opened = (folder / name).open("w", encoding="utf-8", newline="\n")
                    file = files[folder / name] = stack.enter_context(opened)
                    file.write(_header(event))
                values = (v for field in fields_of(kind) for v in numbers(event, field))
                file.write(f"{zero + event.stamp},{','.join(map(repr, values))}\n")
    if not files:
        raise ValueError(f"{recordings[0]}: expected measurements of small sensors, found none")
    return sorted(files)


def _measurements(recording: Path) -> Iterator[Event]:
    from nodes.data.replay.recorded import Recorded  # which needs mcap

    reader = Recorded(recording)
    wanted = reader.events(0, None, lambda kind, _: bool(fields_of(kind)))
    yield from (each.event for each in wanted)


def _header(event: Event) -> str:
    columns = ["stamp (ns)"]
    for field, unit in fields_of(type(event)).items():
        axes = ("_x", "_y", "_z") if len(numbers(event, field)) == 3 else ("",)
        columns += [f"{field}{axis} ({unit})" for axis in axes]
    return ",".join(columns) + "\n"
