"""What nodes hand over for the summary is checked there; what is wrong costs nobody else's."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from events import Announcement
from runtime import Duration, Input, Node, Tick, every
from runtime.channels.links import LinkConfig
from runtime.config.model import Config, RunConfig
from runtime.config.reading import find_node
from runtime.errors import ConfigError, NodeError
from runtime.run.execute import execute
from runtime.summary import Summary
from runtime.testing import run_node, spec
from tests.runtime.samples import Ping, Speaker


def run(tmp_path: Path, *nodes: Any, clock: str = "lockstep", seconds: float = 1.0) -> Summary:
    settings = RunConfig(duration=Duration(seconds), clock=clock)  # type: ignore[arg-type]
    specs = tuple(spec(n, n.__name__.lower()) if isinstance(n, type) else n for n in nodes)
    return execute(Config(run=settings, nodes=specs), tmp_path)


class Numpy(Node):
    """Concludes with what numpy gives, and announces an array."""

    class Grid(Announcement):
        values: Any

    def announce(self) -> Iterable[Announcement]:
        return [self.Grid(stamp=0, source=self.name, values=np.eye(2))]

    async def on_shutdown(self) -> None:
        figures = {"rmse": np.float32(0.5), "count": np.int64(3), "all": np.arange(3), "at": {1: 2}}
        self.conclude("vo", figures, passed=np.float64(0.5) < 1.0)  # type: ignore[arg-type]


def test_numbers_and_arrays_of_numpy_are_written_as_numbers_and_lists(tmp_path: Path) -> None:
    summary = run(tmp_path, Numpy)
    written = json.loads((tmp_path / "summary.json").read_text())
    expected = {"passed": True, "rmse": 0.5, "count": 3, "all": [0, 1, 2], "at": {"1": 2}}
    assert written["verdict"] == {"passed": True, "estimators": {"vo": expected}, "flights": {}}
    assert summary.announcements[0]["values"] == [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("figures", "passed", "message"),
    [
        ({"rmse": object()}, True, r"conclude\('vo'\): rmse: expected what JSON knows"),
        ({"in": [{"it": object()}]}, True, r"conclude\('vo'\): in: expected what JSON knows"),
        ({}, "yes", r"conclude\('vo'\): passed: expected True, False or None, found 'yes' \(str\)"),
        ({}, np.zeros(2) < 1, r"conclude\('vo'\): passed: expected True, False or None"),
    ],
)
def test_what_json_does_not_know_is_refused_and_the_summary_is_there(
    tmp_path: Path, figures: dict[str, Any], passed: Any, message: str
) -> None:
    class Judge(Node):
        async def run(self) -> None:
            self.conclude("vo", figures, passed=passed)

    with pytest.raises(NodeError, match=rf"^judge: TypeError: {message}"):
        run(tmp_path, Speaker, Judge)
    assert json.loads((tmp_path / "summary.json").read_text())["reason"] == "judge failed"


class Odd(Announcement):
    """Holds what no file can."""

    thing: Any


@pytest.mark.slow
@pytest.mark.parametrize(
    ("said", "message"),
    [
        (["camera"], r"announcer: announce\(\): expected announcements, found 'camera' \(str\)"),
        (None, r"announcer: announce\(\): expected announcements, found None"),
        ([Ping(stamp=0, source="a")], r"announcer: announce\(\): expected announcements, found Pi"),
        (
            [Odd(stamp=0, source="a", thing=object())],
            r"announcer: .*announce\(\): Odd: expected what JSON knows",
        ),
    ],
)
def test_only_announcements_are_announced(said: Any, message: str, tmp_path: Path) -> None:
    class Announcer(Node):
        def announce(self) -> Iterable[Announcement]:
            return said  # type: ignore[no-any-return]

    with pytest.raises(NodeError, match=message):
        run(tmp_path, Announcer)
    assert (tmp_path / "summary.json").is_file()


class TwoTicks(Node):
    """Asks twice for ticks of one name, and once for those of a method."""

    async def on_startup(self) -> None:
        self.every(10, self.tick, "tick")
        self.every(20, self.slow, "tick")

    def tick(self, _: Tick) -> None:
        pass

    async def slow(self, _: Tick) -> None:
        await self.clock.sleep(0.12)

    @every(hz=5)
    def again(self, _: Tick) -> None:
        pass


def test_two_ticks_of_one_name_have_figures_of_their_own() -> None:
    ticks = run_node(TwoTicks, duration=1.0).ticks
    assert {name: (t.hz, t.calls) for name, t in ticks.items()} == {
        "node.tick": (10.0, 10),
        "node.tick_2": (20.0, 20),
        "node.again": (5.0, 5),
    }
    assert ticks["node.tick"].missed == 0
    assert ticks["node.tick_2"].missed > 5


class Weak(Node):
    """Fails twice a second."""

    pings = Input(Ping)

    async def run(self) -> None:
        await self.clock.sleep(0.5)
        raise RuntimeError("out of order")


def test_what_links_lost_before_a_restart_is_counted(tmp_path: Path) -> None:
    link = LinkConfig(loss=1.0)
    weak = spec(Weak, "weak", on_error="restart", links={"pings": {"loss": 1.0}})
    assert weak.links["pings"] == link
    summary = run(tmp_path, Speaker, weak, seconds=6.0)
    # It is there four times for half a second; while it is away, nothing is on its way to it.
    assert 20 <= summary.links["weak.pings"].lost <= 24


@pytest.mark.slow
def test_a_run_in_real_time_takes_as_long_on_both_clocks(tmp_path: Path) -> None:
    class Lingering(Node):
        async def on_shutdown(self) -> None:
            await self.clock.sleep(0.4)

    summary = run(tmp_path, Speaker, Lingering, clock="real", seconds=0.3)
    assert summary.sim_seconds == pytest.approx(summary.wall_seconds, abs=0.05)
    assert summary.outputs["speaker.pings"] / summary.sim_seconds == pytest.approx(10.0, rel=0.5)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("def run(self): pass", "B.run: expected `async def run`, found `def run`"),
        ("async def run(self): yield 1", "expected `async def run`, found `async def run with a y"),
        ("def on_startup(self): pass", "expected `async def on_startup`"),
        ("async def announce(self): return ()", "expected `def announce`, found `async def ann"),
        ("async def on_change(self, before): pass", "expected `def on_change`"),
        ('pings = Input(Event, keep="some")', 'Input: keep: expected "every" or "latest", found'),
    ],
)
def test_a_wrong_declaration_is_one_line_that_names_node_and_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, message: str
) -> None:
    name = f"wrong_{abs(hash(body))}"
    head = "from events import Event\nfrom runtime import Input, Node\n\n\nclass B(Node):\n"
    (tmp_path / f"{name}.py").write_text(f"{head}    {body}\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as caught:
        find_node(f"{name}:B", "c.toml: nodes[0] (b)")
    text = str(caught.value)
    assert text.startswith("c.toml: nodes[0] (b): ")
    assert message in text
    assert f"{name}.py, line " in text
    assert "\n" not in text
