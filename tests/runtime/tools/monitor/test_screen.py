"""The screen, driven by keys; the run is none."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from textual.pilot import Pilot
from textual.widgets import DataTable, Input, Static

from runtime.errors import CommandError
from runtime.tools.monitor.protocol import (
    SLOWEST,
    Answer,
    Command,
    Pause,
    Points,
    Restart,
    Resume,
    Set,
    Snapshot,
    Speed,
    Step,
    Stop,
)
from runtime.tools.monitor.screen import Screen, drawn
from tests.runtime.tools.monitor.samples import FakeClient, snapshot


@asynccontextmanager
async def shown(
    stand: FakeClient, size: tuple[int, int] = (140, 40), **options: Any
) -> AsyncIterator[tuple[Screen, Pilot[Any]]]:
    screen = Screen(stand, **options)  # type: ignore[arg-type]  # it stands for a client
    async with screen.run_test(size=size) as pilot:
        await pilot.pause()
        yield screen, pilot


@pytest.mark.slow
async def test_a_usual_terminal_shows_estimators_nodes_outputs_and_the_log() -> None:
    async with shown(FakeClient(snapshot()), size=(80, 24)) as (screen, _):
        image = screen.export_screenshot().replace("&#160;", " ")
        for words in ("0.31", "drone ", "pilot ", "drone.images", "[b]wind[/b]"):
            assert words in image


def text(screen: Screen, name: str) -> str:
    return str(screen.query_one(f"#{name}", Static).content)


@pytest.mark.slow
async def test_it_shows_what_there_is_and_keeps_the_cursor() -> None:
    stand = FakeClient(snapshot())
    async with shown(stand) as (screen, pilot):
        assert text(screen, "head").startswith("sample   1.500 of 60 s")
        nodes: DataTable[Any] = screen.query_one("#nodes", DataTable)
        assert [str(cell) for cell in nodes.get_row("drone")][:3] == ["drone", "running", "25.0%"]
        await pilot.press("down")
        stand.coming.put_nowait(snapshot(headline="sample   2.000 of 60 s"))
        await pilot.pause()
        assert "2.000" in text(screen, "head")
        assert nodes.cursor_row == 1
        image = screen.export_screenshot()
        for words in (
            "tracking",
            "0.31",
            "drone: truth",
            "drone.images",
            "vo.images",
            "drone.control",
            "[b]wind[/b]",
            "quit",
        ):
            assert words in image.replace("&#160;", " ")
        stand.coming.put_nowait(snapshot(tables=snapshot().tables | {"links": []}))
        await pilot.pause()
        assert not screen.query_one("#links").display
        assert screen.query_one("#ticks").display


@pytest.mark.slow
async def test_keys_ask_the_run() -> None:
    stand = FakeClient(snapshot())
    presses: list[tuple[list[str], list[Any]]] = [
        (["space"], [Pause()]),
        (["full_stop", "s"], [Step(), Step(seconds=1.0)]),
        (["plus", "minus"], [Speed(factor=4.0), Speed(factor=2.0)]),
        (["m"], [Speed(factor=None)]),
        (["down", "r"], [Restart(node="pilot")]),
        (["x"], []),
        (["x"], [Stop()]),
    ]
    async with shown(stand) as (_, pilot):
        for keys, commands in presses:
            stand.asked.clear()
            await pilot.press(*keys)
            await pilot.pause()
            assert stand.asked == commands
        stand.asked.clear()
        stand.coming.put_nowait(snapshot(paused=True, speed=SLOWEST))
        await pilot.pause()
        await pilot.press("minus", "space", "space")
        await pilot.pause()
        assert stand.asked == [Speed(factor=SLOWEST), Resume(), Pause()]


async def test_a_run_that_does_not_answer_does_not_hold_up_the_keys() -> None:
    class Deaf(FakeClient):
        async def ask(self, command: Command) -> Answer:
            await super().ask(command)
            return await asyncio.Event().wait()  # type: ignore[return-value]

    stand = Deaf(snapshot())
    async with shown(stand) as (screen, pilot):
        async with asyncio.timeout(10):
            await pilot.press("s", "m", "q")
        assert stand.asked == [Step(seconds=1.0), Speed(factor=None)]
        assert not screen.is_running


async def test_what_is_not_to_be_understood_is_told() -> None:
    class Foreign(FakeClient):
        async def snapshots(self) -> AsyncIterator[Snapshot]:
            raise CommandError("expected a run of this version")
            yield

    async with shown(Foreign()) as (screen, _):
        assert text(screen, "head") == "the run is over: expected a run of this version"


@pytest.mark.slow
async def test_a_parameter_is_asked_for_below() -> None:
    stand = FakeClient(snapshot())
    async with shown(stand) as (screen, pilot):
        await pilot.press("down", "p")
        prompt = screen.query_one("#prompt", Input)
        assert (prompt.value, prompt.display) == ("pilot.gain=", True)
        await pilot.press("escape")
        assert not prompt.display
        await pilot.press("p", "3", "enter")
        await pilot.pause()
        assert not prompt.display
    assert stand.asked == [Set(text="pilot.gain=3")]


async def test_it_says_when_the_run_is_over_and_leaves_if_it_should() -> None:
    stand = FakeClient(snapshot(ended="duration"), None)
    async with shown(stand) as (screen, _):
        assert text(screen, "head") == "the run is over: duration"
        assert screen.is_running
    stand = FakeClient(None)
    async with shown(stand, leave=True) as (screen, pilot):
        await pilot.pause()
        assert not screen.is_running


def test_paths_are_drawn_to_scale_with_north_up() -> None:
    east: Points = [(0.0, 0.0), (8.0, 0.0)]
    north: Points = [(8.0, 0.0), (8.0, 4.0)]
    names, *lines = drawn({"truth": east, "vo": north}, 9, 4).plain.split("\n")
    assert names == "━ truth  ━ vo  "
    assert lines == ["        ⢰", "        ⢸", "⠤⠤⠤⠤⠤⠤⠤⠤⠼"]
    assert drawn({"truth": []}, 9, 4).plain == "━ truth  "
    assert set("".join(drawn({"truth": [(3.0, 3.0)]}, 9, 4).plain.split("\n")[1:])) == {" ", "⠄"}
