"""A run in a thread of its own, as a notebook has it: its results, its errors, and Ctrl-C."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from runtime import Duration, Node
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError
from runtime.run.results import Folder
from runtime.run.supervisor import Supervisor
from runtime.run.threaded_run import ThreadedRun
from runtime.testing import spec
from tests.runtime.samples import Failing, Speaker
from tests.runtime.samples_logs import Lines

pytestmark = pytest.mark.timeout(20)
CTRL_C = threading.Event()
"""Set once the waiting thread is interrupted."""


def press_ctrl_c() -> None:
    """Interrupt the main thread, from the thread of the run, once it waits for the run."""
    while not CTRL_C.wait(0.001):  # real: another thread is about to wait
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    def interrupt(number: int, frame: Any) -> None:
        in_wait = frame.f_code.co_filename == threading.__file__ and any(
            outer.f_code is ThreadedRun.wait.__code__ for outer, _ in traceback.walk_stack(frame)
        )
        if in_wait and not CTRL_C.is_set():
            CTRL_C.set()
            signal.default_int_handler(number, frame)

    CTRL_C.clear()
    before = signal.signal(signal.SIGINT, interrupt)
    yield
    signal.signal(signal.SIGINT, before)


class Flight(Node):
    """Lasts until Ctrl-C, which is pressed while the run is in a phase."""

    phase: ClassVar[str] = ""

    async def run(self) -> None:
        if self.phase == "run":
            press_ctrl_c()
        if self.phase == "after the run":
            self.after_run(lambda _: press_ctrl_c())
            self.stop("enough")
        await self.clock.sleep(3600.0)


class EarlyFolder(Folder):
    """Is being made when Ctrl-C is pressed: the run has no loop yet."""

    def __enter__(self) -> Folder:
        press_ctrl_c()
        return super().__enter__()


class Watch:
    """Notes the run that is watched, and for how long."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    @contextlib.contextmanager
    def __call__(self, supervisor: Supervisor) -> Iterator[None]:
        self.seen += supervisor.state.runners
        yield
        self.seen.append(f"{supervisor.state.reason}")


def threaded(node: type[Node[Any]], folder: Folder, lines: Lines, watch: Watch) -> ThreadedRun:
    run = RunConfig(name="flight", duration=Duration(3600 if node is Flight else 0.75))
    return ThreadedRun(Config(run=run, nodes=(spec(node, "node"),)), folder, [lines], watch)


def reason(folder: Path) -> str:
    return str(json.loads((folder / "summary.json").read_text())["reason"])


def test_the_results_are_there_once_it_is_awaited(tmp_path: Path) -> None:
    watch, lines = Watch(), Lines()
    thread = threaded(Speaker, Folder(tmp_path / "out"), lines, watch)
    assert (thread.name, thread.daemon) == ("run flight", True)
    thread.start()
    thread.wait()
    assert reason(tmp_path / "out") == "duration"
    assert watch.seen == ["node", "duration"]


def test_what_goes_wrong_is_raised_where_it_is_awaited(tmp_path: Path) -> None:
    watch, lines = Watch(), Lines()
    thread = threaded(Failing, Folder(tmp_path / "out"), lines, watch)
    thread.start()
    with pytest.raises(NodeError, match="node: RuntimeError: out of order"):
        thread.wait()
    assert watch.seen == ["node", "node failed"]
    assert any("out of order" in line for line in lines.messages)


@pytest.mark.parametrize(
    ("phase", "why"), [("run", "Ctrl-C"), ("start", "Ctrl-C"), ("after the run", "enough")]
)
def test_ctrl_c_ends_the_run_in_order_and_then_the_program(
    phase: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Flight, "phase", phase)
    folder = (EarlyFolder if phase == "start" else Folder)(tmp_path / "out")
    thread = threaded(Flight, folder, Lines(), Watch())
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        thread.wait()
    assert reason(tmp_path / "out") == why
    thread.join()
