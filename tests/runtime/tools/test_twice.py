"""A run that is run twice: whether it repeats, and who differs first."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import msgspec
import pytest

from events import Odometry
from nodes.outside.process import Process
from runtime import Node, NodeConfig, Output, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.errors import ConfigError
from runtime.summary import Summary
from runtime.testing import spec
from runtime.tools.twice import run_twice
from runtime.units import Duration
from tests.nodes.outside.process.rig import Eyes, program
from tests.runtime.tools.samples_cli import command_here


class DriftConfig(NodeConfig):
    """Settings of a vehicle that may not repeat."""

    differs_at: int = 1000


class Drift(Node[DriftConfig]):
    """A vehicle that from some tick on is where nobody knows."""

    poses = Output(Odometry)

    @every(hz=10)
    def move(self, tick: Tick) -> None:
        off = random.uniform(1, 2) * 1e-6 if tick.index >= self.config.differs_at else 0.0
        self.poses.send(
            Odometry(
                stamp=self.clock.now(),
                source=self.name,
                frame_id="map",
                child_frame_id="base_link",
                position=(float(tick.index), off, 0.0),
                orientation=(1.0, 0.0, 0.0, 0.0),
                linear_velocity=(0.0, 0.0, 0.0),
                angular_velocity=(0.0, 0.0, 0.0),
            )
        )


def twice(out: Path, *nodes: Any, clock: Any = "lockstep") -> Summary:
    settings = RunConfig(duration=Duration(0.5), seed=3, clock=clock)
    summary = run_twice(Config(run=settings, nodes=nodes), out, [])
    written = msgspec.json.decode((out / "summary.json").read_bytes(), type=Summary)
    assert written.twice == summary.twice
    return summary


def test_what_repeats_is_said_to(tmp_path: Path) -> None:
    comparison = twice(tmp_path, spec(Drift, "drone")).twice
    assert comparison is not None
    assert (comparison.repeats, comparison.first, comparison.outputs) == (True, "", [])


@pytest.mark.slow
def test_the_rig_that_differs_is_named_with_when_and_by_how_much(tmp_path: Path) -> None:
    vehicles = spec(Drift, "a", {"differs_at": 3}), spec(Drift, "b", {"differs_at": 2})
    comparison = twice(tmp_path, *vehicles).twice
    assert comparison is not None
    assert not comparison.repeats
    assert comparison.first.startswith("the rig, b, in b.poses: Odometry of b, 0.200000 s, ")
    assert 0.0 <= float(comparison.first.split()[-3]) < 2e-6
    assert comparison.outputs == ["a.poses", "b.poses"]


@pytest.mark.slow
@pytest.mark.parametrize("unsteady", [False, True])
def test_a_system_is_unknown_until_it_was_run_twice(unsteady: bool, tmp_path: Path) -> None:
    node = program(*(["unsteady"] if unsteady else []))
    assert node.node is Process
    summary = twice(tmp_path, spec(Eyes, "drone"), node)
    slam, comparison = summary.outside["slam"], summary.twice
    assert comparison is not None
    assert slam.reproducible  # its inputs: those are the run's to promise
    assert (slam.repeats, comparison.repeats) == (not unsteady, not unsteady)
    if unsteady:
        assert comparison.first.startswith(
            "the system slam, in slam.estimates: PoseEstimate of slam, 0.1"
        )
        assert 0.0 < float(comparison.first.split()[-3]) < 1e-6
        assert comparison.outputs == ["slam.estimates"]


def test_in_real_time_nothing_can_be_compared(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match='--twice: expected one process and clock = "lockstep"'):
        twice(tmp_path, spec(Drift, "drone"), clock="real")


FILE = """
[run]
duration = "0.4s"
[[nodes]]
name = "drone"
type = "tests.runtime.tools.test_twice:Drift"
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("differs_at", "code", "said"),
    [(1000, 0, "run twice, it repeats"), (2, 1, "run twice, it differs: the rig, drone, in")],
)
def test_the_exit_code_says_it(differs_at: int, code: int, said: str, tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text(f"{FILE}differs_at = {differs_at}\n")
    done = command_here("run", "run.toml", "--twice", folder=tmp_path)
    assert (done.returncode, said in done.stdout) == (code, True), done
