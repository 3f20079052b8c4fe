"""The standard tour with its estimator: judged, reported, and the same however slow the machine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from events import Command, Event, Land, Odometry, PoseEstimate
from nodes.estimators import TrackingResult
from nodes.estimators.visual_odometry import VisualOdometry
from runtime import Node, Output, on
from tests.runtime.tools.samples_cli import ROOT, command

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
CONFIG = ROOT / "config.toml"


def fly(folder: Path, config: Path, *settings: str, code: int | None = 0) -> dict[str, Any]:
    """Run a file and return its summary; `code` is that of its end, or `None` for 0 or 1."""
    changes = [word for setting in settings for word in ("--set", setting)]
    done = command("run", config, "-q", "--out", "out", *changes, folder=folder, limit=280)
    assert done.returncode in ({0, 1} if code is None else {code}), done.stderr
    summary: dict[str, Any] = json.loads((folder / "out" / "summary.json").read_text())
    return summary


@pytest.mark.parametrize("world", ["config.toml", "examples/yard.toml"])
def test_odometry_keeps_within_a_third_of_a_percent(world: str, tmp_path: Path) -> None:
    summary = fly(tmp_path, ROOT / world, "report.figures=[]")
    assert summary["reason"] == "pilot: flight completed"
    # Armed, taken off, landed, disarmed: no collision among what happened.
    assert summary["outputs"]["drone.vehicle_events"] == 4
    verdict = summary["verdict"]
    figures = verdict["estimators"]["odometry"]
    assert verdict["passed"]
    assert figures["alignment"] == "none"
    assert figures["ate_percent"] < 0.3
    assert figures["lost_seconds"] == 0.0
    assert figures["path_m"] > 45


def test_a_scene_too_heavy_for_the_machine_gives_the_same_estimates(tmp_path: Path) -> None:
    """Two real seconds an image, or as fast as it goes: the same events, to the byte."""
    short = ["run.duration=5s", "camera.rate=5", "camera.width=256", "camera.height=256"]
    short.append("report.figures=[]")
    outcomes = []
    for render_time in ("0s", "2s"):
        folder = tmp_path / render_time
        folder.mkdir()
        summary = fly(folder, CONFIG, *short, f"camera.render_time={render_time}", code=None)
        outcomes.append((summary["digest"], summary["verdict"]))
        assert summary["verdict"]["estimators"]["odometry"]["estimates"] == 25
    assert outcomes[0] == outcomes[1]


def test_a_threshold_that_is_missed_is_the_exit_code(tmp_path: Path) -> None:
    summary = fly(
        tmp_path,
        CONFIG,
        *("run.duration=6s", "evaluation.thresholds.ate_percent=0.0001", "camera.rate=10"),
        code=1,
    )
    [reason] = summary["verdict"]["estimators"]["odometry"]["failed"]
    assert reason.startswith("ate_percent: expected at most 0.0001, found ")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "ate_percent" in page
    assert 'src="http' not in page


class Mute(Node):
    """Could estimate, and neither announces nor says anything."""

    estimates = Output(PoseEstimate)


def test_thresholds_that_nobody_meets_are_exit_code_1(tmp_path: Path) -> None:
    config = tmp_path / "nobody.toml"
    node = '[[nodes]]\nname = "evaluation"\ntype = "Evaluation"\n'
    mute = '[[nodes]]\nname = "mute"\ntype = "tests.runs.test_verdict:Mute"\n'
    asked = "thresholds = { ate_percent = 1.0 }\n"
    config.write_text(f'[run]\nduration = "1s"\n{node}{asked}{mute}')
    verdict = fly(tmp_path, config, code=1)["verdict"]
    assert verdict["passed"] is False
    assert "found none that announced itself" in verdict["estimators"]["evaluation"]["failed"][0]


class NeverTurns(VisualOdometry):
    """Has the orientation of the start in all poses."""

    def publish(self, image: Event, result: TrackingResult, origin: int | None = None) -> None:
        pose = np.eye(4)
        pose[:3, 3] = result.pose[:3, 3]
        super().publish(image, msgspec.structs.replace(result, pose=pose), origin)


class StampsItsArrival(VisualOdometry):
    """Stamps poses when it sends them."""

    def exposed_at(self, image: Event) -> int:
        return self.clock.now()


class SaysToFly(VisualOdometry):
    """Listens to the truth as a part of the flight."""

    flies = True

    @on(Odometry)
    def odometry(self, event: Odometry) -> None: ...


class Lands(VisualOdometry):
    """Lands once it has flown for a second, before it gets difficult."""

    flies = True
    commands = Output(Command)

    async def on_ready(self) -> None:
        await super().on_ready()
        self.start(self.land())

    async def land(self) -> None:
        await self.clock.sleep(3.5)
        self.commands.send(Land(stamp=self.clock.now(), source=self.name))


RIG = """
[run]
clock = "lockstep"
duration = "16s"
[[nodes]]
name = "drone"
type = "Multirotor"
world = "hall"
[[nodes.cameras]]
name = "camera"
images = ["rgb", "depth"]
width = 256
height = 256
fov = 90
rate = 20
latency = "40ms"
[[nodes]]
name = "pilot"
type = "WaypointFollower"
speed = 1.0
waypoints = [[0.0, 0.0, -1.5], [4.4, 0.2, -1.5], [6.0, -2.0, -1.7]]
[[nodes]]
name = "evaluation"
type = "Evaluation"
thresholds = { ate_percent = 2.0, lost_seconds = 0.5 }
"""


def flown(folder: Path, *kinds: type[Node[Any]]) -> dict[str, Any]:
    """Fly with estimators of these classes beside a good one; return their figures."""
    file = folder / "zoo.toml"
    nodes = [("good", "VisualOdometry")] + [(k.__name__, f"{__name__}:{k.__name__}") for k in kinds]
    file.write_text(RIG + "".join(f'[[nodes]]\nname = "{n}"\ntype = "{t}"\n' for n, t in nodes))
    estimators: dict[str, Any] = fly(folder, file, code=1)["verdict"]["estimators"]
    return estimators


def test_bad_estimators_fail_beside_a_good_one(tmp_path: Path) -> None:
    figures = flown(tmp_path, NeverTurns, StampsItsArrival, SaysToFly)
    assert figures["good"]["passed"], figures["good"]["failed"]
    assert figures["good"]["camera"] == "drone/camera"
    expected = {
        "NeverTurns": "rot_rmse_deg: expected at most 15, found",
        "StampsItsArrival": "stamped_at_images_percent: expected at least 90, found",
        "SaysToFly": "reads_truth: expected it to announce that it reads the truth",
    }
    for name, reason in expected.items():
        assert figures[name]["ate_percent"] < 2.0
        assert any(text.startswith(reason) for text in figures[name]["failed"]), figures[name]


def test_who_lands_the_vehicle_before_its_pilot_does_fails(tmp_path: Path) -> None:
    figures = flown(tmp_path, Lands)
    assert figures["Lands"]["commands"] == "land at 3.5 s"
    reason = "commands: expected it not to end the flight, found land at 3.5 s"
    assert reason in figures["Lands"]["failed"]
    assert "commands" not in figures["good"]
