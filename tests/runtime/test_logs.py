"""Log records: whose they are, at what time of the run, and that none is lost."""

from __future__ import annotations

import asyncio
import io
import logging
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

import pytest
from rich.console import Console

from runtime import Duration, Node, NodeConfig, Tick, every, logs
from runtime.config.model import Config, RunConfig
from runtime.errors import FatalError
from runtime.logs import LEVELS, NodeLogger, file_handler, logging_to, terminal_handler
from runtime.run.execute import execute
from runtime.testing import run_node, spec


class Keeper(logging.Handler):
    """Keeps records."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


class ChattyConfig(NodeConfig):
    """Settings of the chatty node."""

    hz: float = 10.0


class Chatty(Node[ChattyConfig]):
    """Says something at each tick."""

    @every(hz="hz")
    def talk(self, tick: Tick) -> None:
        self.log.info("tick %d", tick.index)


def chat(tmp_path: Path, hz: float, level: str = "info", duration: float = 1.0) -> Keeper:
    keeper = Keeper()
    run = RunConfig(duration=Duration(duration), log=level)  # type: ignore[arg-type]
    config = Config(run=run, nodes=(spec(Chatty, "chatty", {"hz": hz}),))
    execute(config, tmp_path, handlers=[keeper])
    return keeper


def test_records_carry_the_runs_clock_and_the_node(tmp_path: Path) -> None:
    records = chat(tmp_path, 4).records
    said = [(vars(r)["seconds"], vars(r)["logger_name"], r.getMessage()) for r in records]
    assert said == [(k / 4, "chatty", f"tick {k}") for k in range(4)]


@pytest.mark.slow
def test_the_file_is_complete_when_the_run_is_over(tmp_path: Path) -> None:
    chat(tmp_path, 5000)
    lines = (tmp_path / "log.txt").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 5000
    assert lines[-1] == "    0.999800 INFO     chatty: tick 4999"


def test_the_level_is_the_runs(tmp_path: Path) -> None:
    before = logging.getLogger("visnav").level
    assert chat(tmp_path, 10, level="warning").records == []
    assert logging.getLogger("visnav").level == before
    assert not [h for h in logging.getLogger().handlers if isinstance(h, Keeper)]


def test_fatal_logs_and_raises_with_the_nodes_name() -> None:
    keeper = Keeper()
    with logging_to([keeper], "info", lambda: 0), pytest.raises(FatalError, match="n: no 3 of x"):
        NodeLogger("n").fatal("no %d of %s", 3, "x")
    assert [r.levelno for r in keeper.records] == [LEVELS["fatal"]]


def test_trace_is_below_debug() -> None:
    for level, count in [("trace", 1), ("debug", 0)]:
        keeper = Keeper()
        with logging_to([keeper], level, lambda: 0):
            NodeLogger("n").trace("there were %d", 3)
        assert [r.getMessage() for r in keeper.records] == ["there were 3"] * count


def test_a_node_may_end_its_test_with_fatal() -> None:
    class Doomed(Node):
        async def run(self) -> None:
            self.log.fatal("100% done")

    with pytest.raises(FatalError, match="node: 100% done"):
        run_node(Doomed)


def test_libraries_log_warnings_only(tmp_path: Path) -> None:
    handler = file_handler(tmp_path / "log.txt")
    with logging_to([handler], "trace", lambda: 1_500_000_000):
        logging.getLogger("some.library").info("chatter")
        logging.getLogger("some.library").warning("größer als erwartet")
    text = (tmp_path / "log.txt").read_text(encoding="utf-8")
    assert text == "    1.500000 WARNING  some.library: größer als erwartet\n"


def shown(*messages: str, level: int = logging.INFO) -> list[str]:
    """Return what a terminal shows of these messages."""
    text = io.StringIO()
    with logging_to([terminal_handler(Console(file=text, width=10_000))], "info", lambda: 0):
        for message in messages:
            logging.getLogger("visnav.n").log(level, "%s", message)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def test_a_line_of_three_megabytes_is_cut_and_says_how_long_it_is(tmp_path: Path) -> None:
    begin = time.monotonic()
    (line,) = shown("x" * 3_000_000)
    assert len(line) < 2 * logs.LONGEST_SHOWN
    assert line.endswith("x… (3,000,000 characters)")
    with logging_to([file_handler(tmp_path / "log.txt")], "info", lambda: 0):
        logging.getLogger("visnav.n").info("%s", "x" * 3_000_000)
    written = (tmp_path / "log.txt").read_text(encoding="utf-8")
    assert written.endswith("x… (3,000,000 characters)\n")
    assert len(written) < logs.LONGEST + 100
    assert time.monotonic() - begin < 10


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("\x1b[2J\x07 gone", r"\x1b[2J\x07 gone"),
        ("one\r\ntwo", "one\\x0d\n    | two"),
        ("\x9b31m \u202e evil \u2028", r"\x9b31m \u202e evil \u2028"),
        ("Grüße\t\U0001f681", "Grüße\t\U0001f681"),
    ],
)
def test_what_steers_a_terminal_is_made_visible(message: str, expected: str) -> None:
    keeper = Keeper()
    with logging_to([keeper], "info", lambda: 0):
        logging.getLogger("visnav.n").info("%s", message)
    assert [record.getMessage() for record in keeper.records] == [expected]


def test_what_cannot_be_encoded_is_made_visible() -> None:
    assert logs.harmless("a\udc80b").encode() == rb"a\udc80b"


def test_a_flood_is_bounded_and_what_is_dropped_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MOST_WAITING", 50_000)
    gate = threading.Event()

    class Slow(Keeper):
        def emit(self, record: logging.LogRecord) -> None:
            gate.wait()
            super().emit(record)

    keeper = Slow()
    with logging_to([keeper], "info", lambda: 0):
        for _ in range(1000):
            logging.getLogger("visnav.n").info("%s", "x" * 700)
        logging.getLogger("visnav.n").error("the end")
        gate.set()
    *_, error, last = [record.getMessage() for record in keeper.records]
    assert error == "the end"
    assert last == f"{1002 - len(keeper.records)} log lines were dropped: they came too fast"
    assert 40 < len(keeper.records) < 60


def test_a_terminal_does_not_keep_a_run_from_ending(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "PATIENCE", -1.0)
    terminal, keeper = Keeper(), Keeper()
    terminal.setFormatter(logs._OneLine())
    gate = threading.Event()
    keeper.addFilter(lambda _: gate.wait())
    with logging_to([keeper, terminal], "info", lambda: 0):
        for number in range(10):
            logging.getLogger("visnav.n").info("%d", number)
        threading.Timer(0.05, gate.set).start()  # when the block is over
    assert len(keeper.records) == 11
    said = [record.getMessage() for record in terminal.records]
    assert said[-1] == f"{11 - len(said)} log lines are not shown here: they came too fast"


class TalkerConfig(NodeConfig):
    """What it says, and how often."""

    word: str = ""
    worker: bool = False


class Prints:
    """Object of a worker, that prints."""

    def say(self, word: str) -> None:
        print(word, flush=True)


class Talker(Node[TalkerConfig]):
    """Logs from everywhere, once the other runs are there too."""

    meeting: ClassVar[threading.Barrier]

    def say(self, where: str) -> None:
        self.log.info("%s in %s", self.config.word, where)
        logging.getLogger("visnav.runtime").info(
            "%s for the runtime in %s", self.config.word, where
        )
        logging.getLogger("somebody").warning("%s by a library in %s", self.config.word, where)

    async def run(self) -> None:
        worker = await self.worker(Prints) if self.config.worker else None
        await self.offload(self.meeting.wait)
        for _ in range(20):
            self.say("run")
            await self.offload(self.say, "offload")
            await asyncio.to_thread(self.say, "a thread of asyncio")
            await asyncio.get_running_loop().run_in_executor(None, self.say, "an executor")
            thread = threading.Thread(
                target=self.log.info, args=("%s in its own thread", self.config.word)
            )
            thread.start()
            await self.offload(thread.join)
        if worker is not None:
            await worker.call(Prints.say, f"{self.config.word} in a worker")
        await self.offload(self.meeting.wait)
        self.stop("all is said")


@pytest.mark.parametrize("worker", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_runs_of_one_process_have_logs_of_their_own(worker: bool, tmp_path: Path) -> None:
    """The levels, too, are each run's own; afterwards it is as before."""
    words: dict[str, Any] = {"alpha": "info", "beta": "debug", "gamma": "warning"}
    Talker.meeting = threading.Barrier(len(words))
    usual = logging.getLogger("visnav").level

    def fly(word: str) -> None:
        run = RunConfig(log=words[word], clock="real" if word == "beta" else "lockstep")
        nodes = (spec(Talker, word, {"word": word, "worker": worker}),)
        execute(Config(run=run, nodes=nodes), tmp_path / word)

    threads = [threading.Thread(target=fly, args=(word,)) for word in words]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for word, level in words.items():
        text = (tmp_path / word / "log.txt").read_text()
        others = words.keys() - {word}
        assert not [line for line in text.splitlines() if any(other in line for other in others)]
        # In three threads and the loop; in all of them by node, runtime and library.
        assert text.count(f"{word} by a library in") == 4 * 20
        told = level != "warning"
        assert text.count(f" {word}: {word} in ") == (4 * 20 + 20) * told
        assert text.count(f"{word} for the runtime in") == 4 * 20 * told
        assert text.count(f"Prints: {word} in a worker") == (told and worker)
    assert logging.getLogger("visnav").level == usual
