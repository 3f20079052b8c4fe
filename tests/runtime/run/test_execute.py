"""A run from its settings to its end: what its log says, and which loop it gets."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from events import Event
from runtime import Node, Output, every
from runtime.config.reading import parse
from runtime.errors import VisnavError
from runtime.run.execute import execute, make_loop
from runtime.time.clock import Tick
from runtime.time.lockstep import LockstepLoop


class Sample(Event):
    """Event with a value of each kind."""

    image: npt.NDArray[np.uint8]
    position: tuple[float, float]
    height: float
    text: str


class Sensor(Node):
    """Sends one sample a second."""

    samples = Output(Sample)

    @every(hz=1)
    def measure(self, tick: Tick) -> None:
        image = np.zeros((2, 3), np.uint8)
        self.samples.send(
            Sample(
                stamp=tick.stamp,
                source="sensor/a",
                image=image,
                position=(1.23456, -2.0),
                height=1.23456789,
                text="up",
            )
        )


class Lines(logging.Handler):
    """Handler that keeps the messages."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


def table(node: str, **run: Any) -> dict[str, Any]:
    return {"run": {"duration": 0.5} | run, "nodes": [{"name": "sensor", "type": node}]}


def messages(
    out: Path | None = None, node: str = f"{__name__}:Sensor", **options: Any
) -> list[str]:
    lines = Lines()
    execute(parse(table(node), "c.toml"), out, handlers=[lines], **options)
    return lines.messages


def test_events_are_logged_with_sender_values_and_shapes() -> None:
    line = (
        "sensor.samples Sample sensor/a: image=uint8[2, 3] position=(1.235, -2) height=1.23457 "
        "text='up'"
    )
    assert line in messages(log_events=True)
    assert line not in messages()


def test_announcements_are_logged_as_such() -> None:
    logged = messages(node="tests.runtime.samples:Diarist", log_events=True)
    assert any(line.startswith("announced Offer sensor:") for line in logged)


def test_an_error_that_ends_a_run_is_logged(tmp_path: Path) -> None:
    lines = Lines()
    config = parse(table("tests.runtime.samples:Failing", duration=2.0), "c.toml")
    with pytest.raises(VisnavError) as caught:
        execute(config, tmp_path / "run", handlers=[lines])
    assert any(str(caught.value) in line for line in lines.messages)


def test_the_folder_of_an_earlier_run_is_named(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert not any("earlier run" in line for line in messages(out))
    moved = [line for line in messages(out) if "the folder of the earlier run is now" in line]
    assert len(moved) == 1
    assert Path(moved[0].rpartition(" ")[2]).is_dir()


@pytest.mark.parametrize(("speed", "pace"), [(None, 0.0), ("max", 0.0), (4.0, 0.25e-9)])
def test_lockstep_has_the_pace_of_the_file(speed: float | str | None, pace: float) -> None:
    run = {} if speed is None else {"speed": speed}
    loop = make_loop(parse(table(f"{__name__}:Sensor", **run), "c.toml").run)
    try:
        assert isinstance(loop, LockstepLoop)
        assert loop._pace == pytest.approx(pace)
    finally:
        loop.close()
