"""All runs of a plan on several executors, interrupted and taken up again; no run is real."""

from __future__ import annotations

import io
import multiprocessing
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from runtime.errors import ConfigError
from runtime.run.made_from import made_from
from runtime.tools.sweep import Children, Job, Plan, Row, Watch, make_plan, run_here, sweep
from runtime.tools.sweep.console import Display, listed
from runtime.tools.sweep.tables import Rows, crashed, decode_rows
from tests.runtime.tools.sweep.samples import (
    BESIDE,
    die,
    figures_of,
    judge_file,
    plan_in,
    pretend,
    refuse,
)


@contextmanager
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as executor:
        yield executor


@contextmanager
def processes() -> Iterator[Executor]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as executor:
        yield executor


@contextmanager
def dask() -> Iterator[Executor]:
    distributed = pytest.importorskip("dask.distributed")
    with distributed.Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as client:
        yield client.get_executor(pure=False)


EXECUTORS = [
    threads,
    pytest.param(processes, marks=pytest.mark.slow),
    pytest.param(dask, marks=pytest.mark.slow),
]


class Diary(Watch):
    """Writes down what it is told."""

    def __init__(self) -> None:
        self.missing: list[Job] = []
        self.finished = 0
        self.rows: list[Row] = []
        self.interruptions = 0
        self.changed: dict[str, list[str]] = {}

    def again(self, changed: Mapping[Job, Sequence[str]]) -> None:
        self.changed = {str(job): [*why] for job, why in changed.items()}

    def begin(self, missing: Sequence[Job], finished: int) -> None:
        self.missing, self.finished = list(missing), finished

    def done(self, job: Job, row: Row) -> None:
        assert job.id == row["id"]
        self.rows.append(row)

    def interrupted(self) -> None:
        self.interruptions += 1


@pytest.mark.parametrize("executor", EXECUTORS)
def test_every_executor_gives_the_same_rows_in_the_order_of_the_plan(
    tmp_path: Path, executor: Callable[[], AbstractContextManager[Executor]]
) -> None:
    plan, diary = plan_in(tmp_path, "judge.rate=5,4,6", seeds=2), Diary()
    with executor() as pool:
        rows = sweep(plan, pool, run=pretend, watch=diary)
        assert sweep(plan, pool, run=refuse) == rows
    assert figures_of(rows) == [pretend(job) for job in plan.jobs]
    assert (len(diary.missing), diary.finished, len(diary.rows)) == (6, 0, 6)


@pytest.mark.slow
def test_a_process_that_takes_its_pool_along_is_a_row(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=5,4,6")
    with processes() as pool:
        rows = sweep(plan, pool, run=die)
    errors = [row["error"] for row in rows]
    assert [error.partition(":")[0] for error in errors] == ["BrokenProcessPool"] * 3
    with threads() as pool:
        again = sweep(plan, pool, run=pretend)
    assert [row.pop("crashes") for row in again] == [[error] for error in errors]
    assert figures_of(again) == [pretend(job) for job in plan.jobs]


def test_what_failed_is_run_again_and_what_is_finished_is_not(tmp_path: Path) -> None:
    plan, calls = plan_in(tmp_path, "judge.rate=1,2,3"), []

    def run(job: Job) -> Row:
        calls.append(str(job))
        if len(calls) == 2:
            raise OSError("disk full")
        return pretend(job) if len(calls) != 3 else crashed(job, "out of order")

    with ThreadPoolExecutor(1) as pool:
        rows = sweep(plan, pool, run=run)
        assert [row["error"] for row in rows] == ["", "OSError: disk full", "out of order"]
        diary = Diary()
        rows = sweep(plan, pool, run=run, watch=diary)
        assert [row["error"] for row in rows] == ["", "", ""]
        crashes = [row.get("crashes") for row in rows]
        assert crashes == [None, ["OSError: disk full"], ["out of order"]]
        assert diary.finished == 1
        more = plan_in(tmp_path, "judge.rate=4,1,2,3")
        assert len(sweep(more, pool, run=run)) == 4
        assert len(calls) == 3 + 2 + 1
        assert len(sweep(plan, pool, run=run, fresh=True)) == 3
    assert len(calls) == 6 + 3


class Impatient(Diary):
    """Presses Ctrl-C when the first run has ended, and lets the others go on after that."""

    def __init__(self, go_on: threading.Event) -> None:
        super().__init__()
        self.go_on = go_on

    def done(self, job: Job, row: Row) -> None:
        raise KeyboardInterrupt

    def interrupted(self) -> None:
        super().interrupted()
        self.go_on.set()


@pytest.mark.parametrize("ends_well", [True, False])
def test_an_interruption_keeps_what_is_finished_and_waits_for_what_runs(
    tmp_path: Path, ends_well: bool
) -> None:
    plan, calls = plan_in(tmp_path, "judge.rate=1,2,3,4"), []
    go_on, second = threading.Event(), threading.Event()

    def run(job: Job) -> Row:
        calls.append(job)
        if "judge.rate=1" in str(job):
            second.wait()
            return pretend(job)
        second.set()
        go_on.wait()
        return pretend(job) if ends_well else crashed(job, "interrupted")

    watch = Impatient(go_on)
    with ThreadPoolExecutor(2) as pool, pytest.raises(KeyboardInterrupt):
        sweep(plan, pool, run=run, watch=watch)
    assert watch.interruptions == 1
    ran = len(calls)
    assert 2 <= ran <= 3  # the first one's thread may have taken up another
    calls.clear()
    with ThreadPoolExecutor(2) as pool:
        rows = sweep(plan, pool, run=run)
    assert [row["error"] for row in rows] == ["", *["" if ends_well else "interrupted"] * 3]
    assert len(calls) == 4 - (ran if ends_well else 1)


def test_only_one_sweep_writes_into_a_folder(tmp_path: Path) -> None:
    plan = plan_in(tmp_path)
    wrong = r"rows.jsonl: expected it free, found another sweep .* name another folder with --out"
    with (
        Rows(plan.out / "rows.jsonl"),
        ThreadPoolExecutor(1) as pool,
        pytest.raises(ConfigError, match=wrong),
    ):
        sweep(plan, pool, run=pretend)


def test_a_line_that_was_cut_short_is_run_again(tmp_path: Path) -> None:
    plan, diary = plan_in(tmp_path, "judge.rate=1,2,3"), Diary()
    with ThreadPoolExecutor(1) as pool:
        rows = sweep(plan, pool, run=pretend)
        path = plan.out / "rows.jsonl"
        path.write_bytes(path.read_bytes()[:-10])
        assert sweep(plan, pool, run=pretend, watch=diary) == rows
        assert [str(job) for job in diary.missing] == ["judge.rate=3 seed=3"]
        assert sweep(plan, pool, run=refuse) == rows


def test_a_figure_that_is_no_number_is_none(tmp_path: Path) -> None:
    plan = plan_in(tmp_path)

    def run(job: Job) -> Row:
        return pretend(job) | {"estimators": {"vo": {"ate_percent": float("nan")}}}

    with ThreadPoolExecutor(1) as pool:
        (row,) = sweep(plan, pool, run=run)
    assert row["estimators"] == {"vo": {"ate_percent": None}}


class Shown(Diary):
    """Shows the beginning in a terminal, too."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.display = Display(console)

    def again(self, changed: Mapping[Job, Sequence[str]]) -> None:
        super().again(changed)
        self.display.again(changed)

    def begin(self, missing: Sequence[Job], finished: int) -> None:
        super().begin(missing, finished)
        self.display.begin(missing, finished)


def swept(plan: Plan, run: Callable[[Job], Row] = pretend) -> tuple[Diary, str]:
    """Sweep, and return what its observers are told, and what a terminal shows."""
    output = io.StringIO()
    diary = Shown(Console(file=output, width=200))
    with ThreadPoolExecutor(1) as pool:
        sweep(plan, pool, run=run, watch=diary)
    return diary, output.getvalue()


def plan_of_own(folder: Path, name: str, rates: str = "1,2") -> Plan:
    """Plan a sweep of a node beside the file, which imports a helper."""
    if not (folder / f"{name}.py").exists():
        (folder / f"{name}.py").write_text(f"import {name}_helper\n{BESIDE}", encoding="utf-8")
        (folder / f"{name}_helper.py").write_text("", encoding="utf-8")
    config = judge_file(folder, type_=f"{name}:Own")
    return make_plan(config, [f"judge.rate={rates}"], out=folder / "out")


def test_finished_runs_are_run_again_if_what_they_were_made_from_has_changed(
    tmp_path: Path,
) -> None:
    plan = plan_of_own(tmp_path, "judge_edited")
    assert swept(plan)[1] == ""
    assert swept(plan, refuse)[1] == "2 runs are finished already, 0 to do\n"
    with (tmp_path / "judge_edited_helper.py").open("a") as file:
        file.write("# another\n")
    more = plan_of_own(tmp_path, "judge_edited", "1,2,3")
    diary, shown = swept(more)
    assert diary.changed == {
        f"judge.rate={n} seed=3": ["judge_edited_helper.py changed"] for n in (1, 2)
    }
    what = "judge_edited_helper.py changed"
    assert shown == f"0 runs are finished already, 1 to do, 2 are run again: {what}\n"
    assert swept(more, refuse)[0].finished == 3
    (tmp_path / "unrelated.py").write_text("")
    assert swept(more, refuse)[0].finished == 3


def test_a_crash_of_what_was_mended_since_is_forgotten(tmp_path: Path) -> None:
    job = plan_in(tmp_path, "judge.rate=1").jobs[0]

    def row(error: str, made_from: str = "") -> Row:
        result = crashed(job, error)
        if made_from:
            result["made_from"] = made_from
        return result

    def crashes(*rows: Row) -> object:
        return decode_rows(b"\n".join(map(msgspec.json.encode, rows)))[job.id].get("crashes")

    assert crashes(row("a", "old"), row("", "old")) == ["a"]
    assert crashes(row("a"), row("", "new")) == ["a"]  # it died before anybody could look
    assert crashes(row("a", "old"), row("b", "new"), row("", "new")) == ["b"]
    assert crashes(row("a", "old"), row("", "new")) is None


def test_runs_of_which_nothing_says_what_they_were_made_from_are_run_again(tmp_path: Path) -> None:
    """As those of earlier versions, or those whose parts a full disk has cut."""
    plan = plan_of_own(tmp_path, "judge_unknown")
    for name in ("made_from.jsonl", "rows.jsonl"):
        swept(plan)
        path = plan.out / name
        text = re.sub(r',"made_from":"\w+"', "", path.read_text())
        path.write_text(text if name == "rows.jsonl" else text[:-20])
        told = "nothing says what they were made from"
        assert swept(plan)[1] == f"0 runs are finished already, 2 are run again: {told}\n"
        assert swept(plan, refuse)[0].finished == 2


def test_a_run_during_which_a_file_was_edited_is_run_again(tmp_path: Path) -> None:
    """Nobody knows which of the two it has read, even where the file is as before by now."""
    plan = plan_of_own(tmp_path, "judge_meanwhile")

    def run(job: Job) -> Row:
        row = pretend(job)
        row["parts"] = made_from(job.roots)
        row["edited"] = ["judge_meanwhile.py changed"] * ("rate=2" in str(job))
        return row

    swept(plan, run)
    diary, shown = swept(plan)
    why = "judge_meanwhile.py changed while it ran"
    assert diary.changed == {"judge.rate=2 seed=3": [why]}
    assert shown == f"1 runs are finished already, 1 is run again: {why}\n"
    assert swept(plan, refuse)[0].finished == 2


def test_from_python_it_is_logged_what_is_run_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Children, "run", lambda _, job: pretend(job))
    plan = plan_of_own(tmp_path, "judge_logged")
    run_here(plan)
    assert caplog.text == ""
    (tmp_path / "judge_logged_helper.py").unlink()
    run_here(plan)
    assert caplog.messages == ["2 are run again: judge_logged_helper.py is gone"]


def test_many_changes_are_counted() -> None:
    assert listed(["a changed", "b changed"]) == "a changed, b changed"
    assert listed(map(str, range(9))) == "0, 1, 2, 3 and 5 more"
