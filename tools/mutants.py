"""Mutation testing of a module: one small fault at a time, which a quick test has to notice.

    python -m tools.mutants runtime.channels.hold --sample 40

The tests are the quick ones of the mirrored folder, of these the ones that run the changed line.
They run in a copy of the checkout, in processes forked from one that has imported the libraries.
For each mutant of a module that runs only in processes started by tests, all of them are run, since
nothing there says which run its lines.
`tools/mutants.toml` lists equivalent mutants, which no test can kill, each with a reason, and under
``[tests]`` the modules with tests in other folders, too.

Neither mutmut nor cosmic-ray fit. The wrappers of mutmut add a frame to each call, which senders
look at (`HandlerCircleError`), and leave out decorated functions and class bodies. Cosmic-ray
changes the files of the checkout itself, and needs a web server for each parallel worker.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Collection, Generator, Iterator, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import FrameType
from typing import Any

import msgspec
import pytest

from tools.mutations import Mutant, mutants

ROOT = Path(__file__).parents[1]
LIST = ROOT / "tools" / "mutants.toml"
NOT_COPIED = (".git", ".venv*", ".*cache", ".hypothesis", "runs", "sweeps", "build", "dist")
ENVIRONMENT = {"CI": "1", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONHASHSEED": "0"}
OPTIONS = ("-qx", "-n0", "--assert=plain", "-pno:cacheprovider", "--timeout=0", "-mnot slow")
KILLED = ("killed", "timed out")
MOST_LINES = 10_000  # of a module
MOST_BYTES = 8 << 30  # of memory
PATIENCE = 15  # real seconds for a test, and as often as `SLOWER` those of the slowest
SLOWER = 3


class Baseline(msgspec.Struct):
    """The tests without a fault: lines of the module by test, libraries, processor time (s).

    Attributes:
        slowest: Real seconds of the slowest test: on a busy machine others may be as slow later.
    """

    tests: dict[str, set[int]] = {}
    libraries: list[str] = []
    seconds: float = 0.0
    slowest: float = 0.0


class Plugin:
    """Plugin of pytest that runs the chosen tests only or, without any, records a `Baseline`."""

    def __init__(self, file: Path, chosen: Collection[str] = (), patience: int = PATIENCE) -> None:
        self.file, self.chosen, self.patience = str(file), chosen, patience
        self.baseline = Baseline()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out what is not chosen."""
        if self.chosen:
            items[:] = [item for item in items if item.nodeid in self.chosen]

    @pytest.hookimpl(optionalhook=True)
    def pytest_timeout_set_timer(self) -> bool:
        """Replace the timer of pytest-timeout: there is but one alarm, and a test may catch its."""
        return True

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Record the lines that a test runs, in all threads."""
        if self.chosen:
            signal.alarm(self.patience)  # which ends the process
            return (yield)
        lines = self.baseline.tests.setdefault(item.nodeid, set())

        def trace(frame: FrameType, _event: str, _: object) -> Any:
            if frame.f_code.co_filename != self.file:
                return None
            lines.add(frame.f_lineno)
            return trace

        threading.settrace(trace)
        sys.settrace(trace)
        begin = time.monotonic()
        try:
            return (yield)
        finally:
            self.baseline.slowest = max(self.baseline.slowest, time.monotonic() - begin)
            if sys.gettrace() is None:  # Python has given up, as where the stack is full
                lines.update(range(MOST_LINES))
            sys.settrace(None)
            threading.settrace(None)


def start(copy: Path, module: str, places: Sequence[str], plugin: Plugin, seconds: int) -> int:
    """Run tests in a forked process with so much processor time; return the process's id.

    It leaves its ``output`` and, without chosen tests, the ``baseline`` in the copy.
    """
    if child := os.fork():
        return child
    code = 3  # of pytest, for errors of its own
    try:
        code = run_tests(copy, module, places, plugin, seconds)
        sys.stdout.flush()
    finally:
        os._exit(code)  # whatever happened: it is a copy of a process that has more to do


def run_tests(copy: Path, module: str, places: Sequence[str], plugin: Plugin, seconds: int) -> int:
    """Run tests in this process, and return pytest's exit code; 99 if they use another file."""
    os.setsid()
    os.chdir(copy)
    output = os.open("output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    os.environ.update(ENVIRONMENT, PYTHONPATH=str(copy))
    sys.dont_write_bytecode = True
    sys.path[:] = [str(copy), *(path for path in sys.path if path not in {"", str(ROOT)})]
    code = int(pytest.main([*OPTIONS, f"--rootdir={copy}", *places], plugins=[plugin]))
    if not plugin.chosen:
        used = resource.getrusage(resource.RUSAGE_SELF)
        plugin.baseline.seconds = used.ru_utime + used.ru_stime
        plugin.baseline.libraries = [
            name for name, loaded in sys.modules.items()
            if "site-packages" in str(getattr(loaded, "__file__", "")) and "pytest" not in name
        ]  # fmt: skip
        Path("baseline").write_bytes(msgspec.json.encode(plugin.baseline))
    spec = importlib.util.find_spec(module)  # of what is imported, or would be by a process
    return 99 if code == 0 and (spec is None or spec.origin != plugin.file) else code


def run_baseline(copy: Path, module: str, places: Sequence[str]) -> Baseline:
    """Run all quick tests, and import the libraries that they need."""
    _, status = os.waitpid(start(copy, module, places, Plugin(copy / path_of(module)), 3600), 0)
    if (code := os.waitstatus_to_exitcode(status)) == 99:
        raise SystemExit(f"expected tests that run {copy / path_of(module)}, found another file")
    if code:
        raise SystemExit(f"expected tests that pass, found:\n{(copy / 'output').read_text()}")
    baseline = msgspec.json.decode((copy / "baseline").read_bytes(), type=Baseline)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in baseline.libraries:
        with contextlib.suppress(Exception):  # one that only works when imported by another
            importlib.import_module(name)
    return baseline


def run_mutant(
    module: str, folder: Path, seconds: int, patience: int, task: tuple[Mutant, set[str]]
) -> str:
    """Run the tests of a mutant in this process's copy; return ``killed``, or another result."""
    mutant, chosen = task
    copy = folder / str(os.getpid())
    if not copy.exists():
        shutil.copytree(folder / "baseline", copy, symlinks=True)
    file = copy / path_of(module)
    file.write_bytes(mutant.source)
    own = f"test_{file.stem}"
    places = sorted({test.partition("::")[0] for test in chosen},
                    key=lambda name: (not Path(name).name.startswith(own), name))  # fmt: skip
    child = start(copy, module, places, Plugin(file, chosen, patience), seconds)
    deadline = time.monotonic() + 20 * seconds  # a test may sleep, and others need processors, too
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        time.sleep(0.02)
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
    end_session(child)
    code = os.waitstatus_to_exitcode(ended[1])
    if code in {0, 5, 99}:
        return {0: "survived"}.get(code, f"error: {(copy / 'output').read_text()}")
    return "timed out" if code in {-signal.SIGALRM, -signal.SIGXCPU, -signal.SIGKILL} else "killed"


def end_session(leader: int) -> None:
    """End what is left of a session: the processes that its tests have started."""
    for pid in [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]:
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if os.getsid(pid) == leader:
                os.kill(pid, signal.SIGKILL)


def run_mutants(
    module: str, sample: Sequence[Mutant], places: Sequence[str], jobs: int
) -> Iterator[tuple[Mutant, str]]:
    """Yield each mutant with its result, in order."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        left_out = shutil.ignore_patterns(*NOT_COPIED)
        shutil.copytree(ROOT, folder / "baseline", symlinks=True, ignore=left_out)
        baseline = run_baseline(folder / "baseline", module, places)
        print(
            f"{len(baseline.tests)} tests, {baseline.seconds:.0f} s of processor time", flush=True
        )
        elsewhere = not any(baseline.tests.values())
        if elsewhere:
            print("no test runs the module in its own process: all are run for each mutant")
        tests = [
            {test for test, lines in baseline.tests.items()
             if elsewhere or not mutant.lines or lines.intersection(mutant.lines)}
            for mutant in sample
        ]  # fmt: skip
        tasks = [task for task in zip(sample, tests, strict=True) if task[1]]
        patience = PATIENCE + round(SLOWER * baseline.slowest)
        work = partial(run_mutant, module, folder, 10 + round(2 * baseline.seconds), patience)
        with get_context("fork").Pool(jobs) as pool:
            results = pool.imap(work, tasks)
            for mutant, chosen in zip(sample, tests, strict=True):
                yield mutant, next(results) if chosen else "not reached"


def path_of(module: str) -> Path:
    """Return a module's file, from the root."""
    return Path(*module.split(".")).with_suffix(".py")


def listed() -> dict[str, Any]:
    """Return what is listed: rows of equivalent mutants by module, and ``tests``."""
    return tomllib.loads(LIST.read_text(encoding="utf-8"))


def equivalents(module: str) -> set[tuple[str, str, str]]:
    """Return function, line before and line after of the listed mutants of a module."""
    rows = listed().get(module, [])
    return {(row["function"], row["was"], row["becomes"]) for row in rows}


def places_of(module: str) -> list[str]:
    """Return where the tests of a module are: the mirrored folder, and what is listed."""
    return [str(Path("tests", *module.split(".")[:-1])), *listed()["tests"].get(module, [])]


def main() -> None:
    """Judge the tests of a module by its mutants."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("module", help="such as runtime.channels.hold")
    parser.add_argument(
        "--tests", nargs="*", default=[], help="beside those of its folder and those listed"
    )
    parser.add_argument("--only", nargs="+", metavar="TESTS", help="instead of all those")
    parser.add_argument("--sample", type=int, default=0, help="so many, at random; 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--removes", help="only removed statements of a kind, such as Raise")
    parser.add_argument("--function", default="", help="only of functions whose name begins so")
    asked = parser.parse_args()
    left_out = equivalents(asked.module)
    chosen = [
        mutant for mutant in mutants((ROOT / path_of(asked.module)).read_bytes())
        if asked.removes in {None, mutant.removes} and mutant.function.startswith(asked.function)
        and mutant[:3] not in left_out
    ]  # fmt: skip
    count = len(chosen)
    if 0 < asked.sample < count:
        chosen = random.Random(asked.seed).sample(chosen, asked.sample)  # noqa: S311
    places = asked.only or [*places_of(asked.module), *asked.tests]
    results = Counter[str]()
    for mutant, result in run_mutants(asked.module, chosen, places, asked.jobs):
        results[result] += 1
        if result not in KILLED:
            where = f"{asked.module}:{mutant.line} {mutant.function}"
            print(f"{result}: {where}\n  - {mutant.was}\n  + {mutant.becomes}", flush=True)
    killed = sum(results[result] for result in KILLED)
    percent = 100 * killed / max(len(chosen), 1)
    print(
        f"{asked.module}: {killed} of {len(chosen)} killed ({percent:.0f} %; "
        f"{count} mutants and {len(left_out)} listed): {dict(results)}"
    )


if __name__ == "__main__":
    main()
