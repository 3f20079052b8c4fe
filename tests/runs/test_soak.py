"""An hour of simulated flight needs no more memory than its first minutes."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import pytest

from events import Announcement, EstimatorAnnouncement, Odometry, PoseEstimate
from runtime import Node, Output, Tick, every, on
from tests.runtime.tools.samples_cli import command

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

MOST_GROWTH = 50.0
"""Megabytes."""

RUN = """\
[run]
name = "soak"
duration = "3600s"
digest = true

[[nodes]]
name = "drone"
type = "Multirotor"
control_rate = 100

[[nodes]]
name = "echo"
type = "tests.runs.test_soak:Echo"

[[nodes]]
name = "evaluation"
type = "Evaluation"

[[nodes]]
name = "scale"
type = "tests.runs.test_soak:Scale"
"""


class Echo(Node):
    """Estimates the truth, 30 times a second."""

    estimates = Output(PoseEstimate)

    _last: Odometry | None = None

    def announce(self) -> Iterable[Announcement]:
        yield EstimatorAnnouncement(stamp=0, source=self.name, method="echo", reads=("truth",))

    @on(Odometry)
    def moved(self, event: Odometry) -> None:
        self._last = event

    @every(hz=30)
    def say(self, _: Tick) -> None:
        if (last := self._last) is not None:
            self.estimates.send(
                PoseEstimate(
                    stamp=last.stamp,
                    source=self.name,
                    frame_id="map",
                    position=last.position,
                    orientation=last.orientation,
                )
            )


class Scale(Node):
    """Weighs its process once a minute of the run's clock."""

    megabytes: ClassVar[list[float]] = []

    @every(hz=1 / 60)
    def weigh(self, _: Tick) -> None:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        (line,) = (line for line in status.splitlines() if line.startswith("VmRSS"))
        self.megabytes.append(int(line.split()[1]) / 1024)

    async def on_shutdown(self) -> None:
        assert self.out is not None
        (self.out / "weights.json").write_text(json.dumps(self.megabytes), encoding="ascii")


def test_an_hours_flight_grows_by_no_more_than_fifty_megabytes(tmp_path: Path) -> None:
    file = tmp_path / "soak.toml"
    file.write_text(RUN, encoding="utf-8")
    done = command("run", file, "-q", "--out", "out", folder=tmp_path, limit=850)
    assert done.returncode == 0, done.stderr
    weights = json.loads((tmp_path / "out" / "weights.json").read_text())
    assert len(weights) >= 60
    after_five_minutes = weights[5]
    growth = [weight - after_five_minutes for weight in weights[5:]]
    assert max(growth) <= MOST_GROWTH, list(itertools.islice(growth, 0, None, 6))
    verdict = json.loads((tmp_path / "out" / "evaluation" / "verdict.json").read_text())
    assert verdict["estimators"]["echo"]["estimates"] == 30 * 3600
