"""What `check` says before a run: of the file alone, and of nodes that are brought up dry."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from events import Announcement, EstimatorAnnouncement, Image, Score
from runtime import Input, Node, NodeConfig, Output
from runtime.config.model import Config, RunConfig
from runtime.errors import UncheckableError
from runtime.paths import OutputPath
from runtime.testing import run_nodes, spec
from runtime.tools import preflight
from runtime.tools.preflight import Findings


class Giving(Node):
    """Announces an estimator below its name, and sends images."""

    images = Output(Image)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=f"{self.name}/front", method="none")


class Reading(Node):
    """Reads images."""

    images = Input(Image)

    async def run(self) -> None:
        async for _ in self.images:
            pass


class ReadingInATask(Node):
    """Reads images in a coroutine of its own, under another name."""

    images = Input(Image)

    async def run(self) -> None:
        self.start(self._read("images"))

    async def _read(self, port: str) -> None:
        async for _ in getattr(self, port):
            pass


class Forgetful(Node):
    """Declares an input and forgets to read it."""

    images = Input(Image)

    async def run(self) -> None:
        pass


class WritingConfig(NodeConfig):
    """Names a file."""

    plot: OutputPath = "plot.png"


class Writing(Node[WritingConfig]):
    """Writes two files."""

    files = ("fixed.txt",)


class Lacking(Node):
    """Lacks two things."""

    def check(self) -> Iterable[str]:
        yield "expected a camera, found none"
        yield "expected a map, found none"


class Broken(Node):
    """Cannot even be made."""

    def __init__(self) -> None:
        raise RuntimeError("out of order")


class Heavy:
    """What a worker would hold."""

    def weigh(self) -> float:
        raise AssertionError("no worker is started by a check")


class Asking(Node):
    """Asks its worker in start-up, and what follows depends on the answer."""

    async def on_startup(self) -> None:
        worker = await self.worker(Heavy)
        self.weight = await worker.call(Heavy.weigh)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method=str(self.weight))


class Outside(Node):
    """Knows only in a run what it will announce."""

    async def on_startup(self) -> None:
        if self.checking:
            raise UncheckableError("not now")


class Journal(Node):
    """Notes its phases, and warns in each."""

    phases: list[str]

    async def on_startup(self) -> None:
        Journal.phases = [f"on_startup, checking: {self.checking}, out: {self.out}"]
        self.log.warning("in start-up")
        self.every(10, lambda _: None, "tick")
        self.conclude("nothing", {})
        self.after_run(lambda _: None)
        assert await self.offload(sum, [1, 2]) == 3

    def announce(self) -> Iterable[Announcement]:
        Journal.phases.append("announce")
        return ()

    async def run(self) -> None:
        raise AssertionError("a check does not run")

    async def on_shutdown(self) -> None:
        Journal.phases.append("on_shutdown")
        self.log.warning("nothing came")


def config(
    *nodes: tuple[type[Node[Any]], str], inputs: dict[str, str] | None = None, **run: Any
) -> Config:
    specs = [spec(cls, name, inputs=inputs if name == "r" else None) for cls, name in nodes]
    return Config(run=RunConfig(**run), nodes=tuple(specs))


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_nodes_go_through_all_phases_but_the_run(clock: str) -> None:
    findings = preflight.of_nodes(config((Journal, "j"), clock=clock))
    assert findings == Findings([], ["j: in start-up"])
    assert Journal.phases == ["on_startup, checking: True, out: None", "announce", "on_shutdown"]


def test_all_that_fail_in_start_up_are_told_and_nothing_that_follows_from_it() -> None:
    findings = preflight.of_nodes(config((Broken, "b"), (Broken, "c"), (Lacking, "l")))
    assert findings.errors == ["b: RuntimeError: out of order", "c: RuntimeError: out of order"]


def test_what_a_node_lacks_is_told_by_the_check_and_refused_by_the_run() -> None:
    told = "l: expected a camera, found none; expected a map, found none"
    assert preflight.of_nodes(config((Lacking, "l"))).errors == [told]
    with pytest.raises(Exception, match=told):
        run_nodes([spec(Lacking, "l")])


def test_a_node_that_asks_its_worker_is_looked_at_as_far_as_that_goes() -> None:
    assert preflight.of_nodes(config((Asking, "a"), (Journal, "j"))).errors == []


def test_what_may_yet_come_from_outside_is_no_error() -> None:
    findings = preflight.of_nodes(config((Outside, "o"), (Lacking, "l")))
    assert findings.errors == []
    reason, lacks = findings.warnings
    assert reason == "o: not now: not all can be checked"
    assert "l: expected a camera, found none" in lacks


def test_two_nodes_do_not_announce_the_same() -> None:
    class Double(Giving):
        def announce(self) -> Iterable[Announcement]:
            yield EstimatorAnnouncement(stamp=0, source="a/front", method="none")

    (told,) = preflight.of_nodes(config((Giving, "a"), (Double, "b"))).errors
    assert told == (
        "b: expected a source that is 'b', below it, or announced by this node, "
        "found EstimatorAnnouncement of 'a/front', which is a's"
    )


SOURCES = [
    ("a", None),
    ("a/front", None),
    ("a/front/grey", None),
    ("a/frnt", "expected one of a/front, found a/frnt (did you mean 'a/front'?)"),
    ("b/front", "expected one of a, r, j, a/front, found b/front (did you mean 'a/front'?)"),
    ("j", "expected a source of Image, found j: j sends none"),
]


@pytest.mark.parametrize(("source", "told"), SOURCES)
def test_inputs_name_what_is_there(source: str, told: str | None) -> None:
    nodes = config((Giving, "a"), (Reading, "r"), (Lacking, "j"), inputs={"images": source})
    errors = [e for e in preflight.of_nodes(nodes).errors if e.startswith("r: ")]
    assert errors == ([] if told is None else [f"r: inputs.images: {told}"])


def test_a_node_that_announces_nothing_may_send_from_anywhere_below() -> None:
    class Silent(Giving):
        def announce(self) -> Iterable[Announcement]:
            return ()

    nodes = config((Silent, "a"), (Reading, "r"), inputs={"images": "a/any"})
    assert preflight.of_nodes(nodes).warnings == []


def test_an_input_that_nobody_reads_is_odd() -> None:
    nodes = config((Giving, "a"), (Reading, "r"), (ReadingInATask, "t"), (Forgetful, "f"))
    (told,) = preflight.of_file(nodes).warnings
    assert told.startswith("f.images: no method of ")


def test_no_two_nodes_of_a_process_write_one_file(tmp_path: Path) -> None:
    two = config((Writing, "v"), (Writing, "w"))
    assert preflight.of_file(two).errors == [
        "w: expected files of its own in the run's folder, found fixed.txt, which v writes, too",
        "w: expected files of its own in the run's folder, found plot.png, which v writes, too",
    ]
    assert preflight.of_file(two, ["w"]).errors == []
    own = Config(run=RunConfig(), nodes=(spec(Writing, "w", {"plot": "./log.txt"}),))
    (told,) = preflight.of_file(own).errors
    assert told.endswith("found log.txt, which the run itself writes, too")
    for path in ("/dev/null", "../plot.png"):
        away = Config(run=RunConfig(), nodes=(spec(Writing, "w", {"plot": path}),))
        (told,) = preflight.of_file(away).errors
        assert told == f"w: expected a file in the run's folder, found {path}"


def test_an_input_without_a_sender_is_odd() -> None:
    class Judge(Node):
        scores = Input(Score)

        async def run(self) -> None:
            async for _ in self.scores:
                pass

    assert preflight.of_file(config((Judge, "j"))).warnings == [
        "j.scores: expects Score, and no node sends it"
    ]
