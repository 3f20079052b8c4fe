"""What is remembered of each run: ``rows.jsonl``, one line a run, added when the run ends."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO, Any, NotRequired, TypedDict

import msgspec

from runtime.errors import ConfigError
from runtime.tools.sweep.plan import Job


class Row(TypedDict):
    """One run. All of it goes through JSON, so figures that are no numbers become `None`.

    Keys:
        id: Of the job.
        parameters: Path to value, as they were written.
        seed: Of the run's random numbers.
        exit_code: Of the process; negative for the signal that ended it, `None` if there was no
            process.
        error: What went wrong, in one line; empty for a run that is finished.
        passed: The run's verdict; `None` if it has none.
        repeat: Which of the runs with equal settings and seed it is.
        digest: Of all events; `None` if off, or if equal runs may differ in it.
        digests: Name of an estimator to the digest of all that it has sent.
        sim_seconds: Seconds of the run's clock.
        run_seconds: Real seconds from the first update to the end.
        wall_seconds: Real seconds of the whole process.
        estimators: Name to figures, as the run's verdict has them.
        workers: Name to what its calls cost, as the run's summary has it.
    """

    id: str
    parameters: dict[str, str]
    seed: int
    exit_code: int | None
    error: str
    passed: bool | None
    digest: str | None
    sim_seconds: float | None
    run_seconds: float | None
    wall_seconds: float | None
    estimators: dict[str, dict[str, Any]]
    repeat: NotRequired[int]
    digests: NotRequired[dict[str, str]]
    workers: NotRequired[dict[str, dict[str, float | None]]]


def failed(job: Job, error: str) -> Row:
    """Return the row of a run that came to nothing."""
    return Row(
        id=job.id,
        parameters=dict(job.settings),
        seed=job.seed,
        repeat=job.repeat,
        exit_code=None,
        error=error,
        passed=None,
        digest=None,
        sim_seconds=None,
        run_seconds=None,
        wall_seconds=None,
        estimators={},
    )


class Rows:
    """A file of rows, open for adding; a context manager.

    Of several rows of one job the last one counts. A line that was cut short, by a full disk or
    a power cut, is as if it were not there.

    Args:
        path: The file; its folder is made if missing.
        fresh: Forget what it holds.

    Raises:
        ConfigError: Another sweep has it open.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise ConfigError(f"{path}: expected it free, found another sweep writing it") from None
        if fresh:
            self._file.truncate(0)
        self._file.seek(0)
        self._rows: dict[str, Row] = {}
        text = self._file.read()
        for line in text.splitlines():
            try:
                row = msgspec.json.decode(line, type=Row)
            except msgspec.MsgspecError:
                continue
            self._rows[row["id"]] = row
        if text and not text.endswith(b"\n"):
            self._file.write(b"\n")

    def __enter__(self) -> Rows:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def get(self, job: Job) -> Row | None:
        """Return a job's row, finished or failed, or `None`."""
        return self._rows.get(job.id)

    def add(self, row: Row) -> Row:
        """Write a row, and return it as it will be read."""
        line = msgspec.json.encode(row)
        self._file.write(line + b"\n")
        self._file.flush()
        row = msgspec.json.decode(line, type=Row)
        self._rows[row["id"]] = row
        return row
