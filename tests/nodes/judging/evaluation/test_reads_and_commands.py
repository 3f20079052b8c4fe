"""Nodes that estimate in a run: the camera that each reads, its stamps, its commands, the truth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import (
    Announcement,
    Armed,
    Collision,
    Command,
    Disarm,
    Disarmed,
    EstimatorAnnouncement,
    Event,
    Hover,
    Image,
    Land,
    Landed,
    Odometry,
    PoseEstimate,
    Reset,
    TakenOff,
    Takeoff,
)
from nodes.judging.evaluation import Evaluation
from nodes.judging.evaluation.plausibility import CommandLog
from runtime import Input, Node, NodeConfig, Output, on
from runtime.testing import run_nodes, spec
from tests.nodes.judging.evaluation.flights import MS, SECOND, announced, heading, place, truth
from tests.nodes.judging.evaluation.test_evaluation_node import camera_of

LENGTH = 4
LATENCY = 13 * MS


class Follows(Node):
    """Says of each image where it was."""

    images = Input(Image)
    estimates = Output(PoseEstimate)

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method="test", reads=("grey",))

    async def run(self) -> None:
        async for image in self.images:
            await self.clock.sleep(LATENCY / 1e9)
            self.answer(image)

    def answer(self, image: Image) -> None:
        self.say(image.stamp, image.stamp)

    def say(self, stamp: int, at: int) -> None:
        """Send the pose of a time under a stamp."""
        pose: dict[str, Any] = {"position": place(at), "orientation": heading(at)}
        self.estimates.send(PoseEstimate(stamp=stamp, source=self.name, frame_id="map", **pose))


class ReadsSlow(Follows):
    images = Input(Image, source="drone/slow")


class ReadsQuick(Follows):
    """Reads the quick camera, and answers those of its images that the slow one has taken, too."""

    images = Input(Image, source="drone/quick")

    def answer(self, image: Image) -> None:
        if image.stamp % (100 * MS) == 0:
            super().answer(image)


class ReceivesBoth(Follows):
    """Answers the slow camera only."""

    def answer(self, image: Image) -> None:
        if image.source == "drone/slow":
            super().answer(image)


class StampsItsArrival(ReadsSlow):
    def answer(self, image: Image) -> None:
        self.say(self.clock.now(), image.stamp)


class Commands(NodeConfig):
    command: str = ""


class Orders(ReadsSlow, Node[Commands]):
    """Orders something at 2 s."""

    flies = True
    config: Commands
    commands = Output(Command)

    async def run(self) -> None:
        self.start(self.order())
        await super().run()

    async def order(self) -> None:
        await self.clock.sleep(2.0)
        kinds: dict[str, type[Command]] = {"land": Land, "disarm": Disarm, "hover": Hover}
        if kind := kinds.get(self.config.command):
            self.commands.send(kind(stamp=self.clock.now(), source=self.name))


class Peeps(ReadsSlow):
    reads_truth = "showing"

    @on(Odometry)
    def peep(self, _: Odometry) -> None: ...


class InAnotherName(Peeps):
    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source="somebody", method="test", reads=("grey",))

    def say(self, stamp: int, at: int) -> None:
        pose: dict[str, Any] = {"position": place(at), "orientation": heading(at)}
        self.estimates.send(PoseEstimate(stamp=stamp, source="somebody", frame_id="map", **pose))


def pictures() -> list[Event]:
    """Images of two cameras that are triggered together."""
    return [
        Image(
            stamp=stamp,
            source=f"drone/{name}",
            frame_id=name,
            encoding="mono8",
            data=np.zeros((2, 2), np.uint8),
        )
        for name, step in (("quick", 50), ("slow", 100))
        for stamp in range(0, LENGTH * SECOND, step * MS)
    ]


def flown(out: Path, node: type[Node[Any]], *more: Event, **config: Any) -> dict[str, Any]:
    """Fly with an estimator; return its verdict."""
    cameras = [
        msgspec.structs.replace(camera_of("drone"), source=f"drone/{name}", frame_id=name)
        for name in ("quick", "slow")
    ]
    script = sorted([*truth(LENGTH), *pictures(), *more], key=lambda event: event.stamp)
    nodes = [spec(node, "est", config), spec(Evaluation, "evaluation")]
    inputs = [announced()[0], *cameras, *script]
    run_nodes(nodes, inputs=inputs, duration=LENGTH, out=out)
    verdict = json.loads((out / "evaluation" / "verdict.json").read_text())
    (figures,) = verdict["estimators"].values()
    return dict(figures)


@pytest.mark.parametrize(
    ("node", "camera", "percent"),
    [
        (ReadsSlow, "drone/slow", 100.0),
        (ReadsQuick, "drone/quick", 50.0),
        (ReceivesBoth, "drone/slow", 100.0),
    ],
)
def test_the_images_are_those_of_the_camera_that_was_read(
    tmp_path: Path, node: type[Node[Any]], camera: str, percent: float
) -> None:
    figures = flown(tmp_path, node)
    assert figures["camera"] == camera
    assert figures["frame_coverage_percent"] == pytest.approx(percent, abs=2.0)
    assert figures["stamped_at_images_percent"] == 100.0
    assert figures["failed"] == []


def test_stamps_of_the_arrival_fail(tmp_path: Path) -> None:
    figures = flown(tmp_path, StampsItsArrival)
    assert figures["ate_percent"] < 1.0
    assert figures["failed"] == ["stamped_at_images_percent: expected at least 90, found 0"]


@pytest.mark.parametrize("node", [Peeps, InAnotherName])
def test_an_estimator_that_says_to_show_the_truth_reads_it(
    tmp_path: Path, node: type[Node[Any]]
) -> None:
    figures = flown(tmp_path, node)
    assert figures["reads_truth"] == "undeclared"
    assert "reads_truth" in figures["failed"][0]


def event(kind: type[Any], seconds: float, source: str = "drone", **fields: Any) -> Any:
    return kind(stamp=round(seconds * SECOND), source=source, **fields)


@pytest.mark.parametrize(
    ("command", "events", "failed"),
    [
        # The vehicle does what the estimator orders.
        ("land", [event(Landed, 2.5), event(Disarmed, 2.6)], True),
        ("disarm", [event(Disarmed, 2.1)], True),
        # It flies on, or is ordered to land by its pilot before that.
        ("land", [], False),
        ("land", [event(Landed, 2.5), event(TakenOff, 3.0)], False),
        ("land", [event(Land, 1.5, "pilot"), event(Landed, 2.5)], False),
        ("hover", [event(Land, 2.2, "pilot"), event(Landed, 2.5)], False),
    ],
)
def test_commands_of_an_estimator_stand_in_its_verdict(
    tmp_path: Path, command: str, events: list[Event], failed: bool
) -> None:
    takeoff = [event(Takeoff, 0.1, "pilot"), event(TakenOff, 0.5)]
    figures = flown(tmp_path, Orders, *takeoff, *events, command=command)
    assert figures["commands"] == f"{command} at 2 s"
    text = f"commands: expected it not to end the flight, found {command} at 2 s"
    assert figures["failed"] == ([text] if failed else [])


def test_an_estimator_without_commands_has_none(tmp_path: Path) -> None:
    assert "commands" not in flown(tmp_path, Orders, event(Land, 2.0, "pilot"))


def test_who_alone_commands_a_vehicle_may_land_it() -> None:
    log = CommandLog()
    for command in (
        event(Takeoff, 0.0, "est"), event(Armed, 0.1), event(TakenOff, 1.0), event(Hover, 2.0, "x"),
        event(Land, 3.0, "est"), event(Collision, 3.5, other="wall", position=(0.0,) * 3,
        normal=(1.0, 0.0, 0.0), speed=1.0), event(Landed, 4.0), event(Reset, 5.0, "est"),
    ):  # fmt: skip
        log.add(command)
    assert log.text("est".__eq__) == "takeoff at 0 s, land at 3 s, reset at 5 s"
    assert log.ended("est".__eq__, "drone") == "land at 3 s"
    assert log.ended("x".__eq__, "drone") == ""
    assert log.ended({"est", "x"}.__contains__, "drone") == ""
    assert log.ended("est".__eq__, "another") == ""
