"""All runs of a plan, on any executor; those that are finished already are not run again."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Sequence

from runtime.tools.sweep.plan import Job, Plan
from runtime.tools.sweep.process import run_job
from runtime.tools.sweep.rows import Row, Rows, failed


class Watch:
    """Is told how a sweep gets on; this one does nothing."""

    def begin(self, missing: Sequence[Job], finished: int) -> None:
        """Hear what will be run, and how many runs are finished from earlier on."""

    def done(self, job: Job, row: Row) -> None:
        """Hear that a run has ended, well or not."""

    def interrupted(self) -> None:
        """Hear that the sweep ends as soon as what is running has ended; make that soon."""


def sweep(
    plan: Plan,
    executor: concurrent.futures.Executor,
    *,
    run: Callable[[Job], Row] = run_job,
    watch: Watch | None = None,
    fresh: bool = False,
) -> list[Row]:
    """Run what is missing, and what has failed before; called in one thread.

    Each row is in ``rows.jsonl`` before the next one is looked at, so whatever ends a sweep, the
    next call takes up where it ended. A run that fails is a row with an error.

    Args:
        plan: What to run.
        executor: Where. Stays open.
        run: Runs one job; must be picklable if the executor needs that.
        watch: Is told how it gets on.
        fresh: Forget rows of earlier sweeps in the same folder.

    Returns:
        The rows in the order of the plan's jobs.

    Raises:
        ConfigError: Another sweep writes into the same folder.
        BaseException: Whatever interrupts it, such as KeyboardInterrupt, once the running jobs
            have ended; those that ended well are kept. A second one is not waited for.
    """
    watch = watch or Watch()
    with Rows(plan.out / "rows.jsonl", fresh=fresh) as rows:
        missing = [job for job in plan.jobs if (row := rows.get(job)) is None or row["error"]]
        watch.begin(missing, len(plan.jobs) - len(missing))
        futures: dict[concurrent.futures.Future[Row], Job] = {}
        noted: set[concurrent.futures.Future[Row]] = set()
        try:
            for job in missing:
                futures[_submit(executor, run, job)] = job
            for future in concurrent.futures.as_completed(futures):
                row = rows.add(_row(future, futures[future]))
                noted.add(future)
                watch.done(futures[future], row)
        except BaseException:
            left = [f for f in futures if f not in noted and not f.cancel()]
            watch.interrupted()
            for row in [_row(future, futures[future]) for future in left]:  # waits
                if not row["error"]:
                    rows.add(row)
            raise
        return [row for job in plan.jobs if (row := rows.get(job)) is not None]


def _submit(
    executor: concurrent.futures.Executor, run: Callable[[Job], Row], job: Job
) -> concurrent.futures.Future[Row]:
    try:
        return executor.submit(run, job)
    except concurrent.futures.BrokenExecutor as error:  # by a job before this one
        broken: concurrent.futures.Future[Row] = concurrent.futures.Future()
        broken.set_exception(error)
        return broken


def _row(future: concurrent.futures.Future[Row], job: Job) -> Row:
    try:
        return future.result()
    except Exception as error:
        return failed(job, f"{type(error).__name__}: {error}")
