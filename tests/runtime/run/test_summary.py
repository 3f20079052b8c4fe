"""What a run says about itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console

from events import (
    Announcement,
    EstimatorAnnouncement,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseEstimate,
)
from runtime import Duration, Input, Node, NodeConfig, Output, every, on
from runtime.commit import commit
from runtime.config.model import Config, RunConfig
from runtime.run.execute import execute
from runtime.run.made_from import code_of
from runtime.run.summarise import command_line
from runtime.summary import Summary, Verdict, merged
from runtime.testing import run_nodes, spec
from runtime.time.clock import Tick
from runtime.tools.cli.brief import print_verdict, print_words, run_tables
from tests.runtime.samples import Diarist, Failing, Painter, Ping, Reader, Speaker


class Lazy(Node):
    """Reads nothing, and says what it would rather lose."""

    newest = Input(Ping, keep="latest")
    some = Input(Ping, bound=4, overflow="drop_oldest")


def run(
    tmp_path: Path, *nodes: type[Node[Any]], clock: str = "lockstep", seconds: float = 1.0
) -> Summary:
    settings = RunConfig(duration=Duration(seconds), clock=clock, seed=3)  # type: ignore[arg-type]
    specs = tuple(spec(n, n.__name__.lower()) for n in nodes)
    return execute(Config(run=settings, nodes=specs), tmp_path)


def test_everything_is_counted(tmp_path: Path) -> None:
    summary = run(tmp_path, Speaker, Lazy, Painter)
    assert summary.events == {"Image": 1, "Ping": 10}
    assert summary.outputs == {"speaker.pings": 10, "painter.images": 1}
    assert summary.drops == {"lazy.newest": 9, "lazy.some": 6}
    assert (summary.streams["lazy.some"].bound, summary.streams["lazy.some"].peak) == (4, 4)
    assert summary.ticks["speaker.speak"].calls == 10
    assert (summary.seed, summary.reason, summary.sim_seconds) == (3, "duration", 1.0)
    assert summary.environment["python"]


def test_the_written_summary_is_the_returned_one(tmp_path: Path) -> None:
    summary = run(tmp_path, Speaker, Reader)
    written = (tmp_path / "summary.json").read_bytes()
    assert msgspec.json.decode(written, type=Summary) == summary


def test_announcements_are_kept(tmp_path: Path) -> None:
    summary = run(tmp_path, Diarist)
    assert summary.announcements == [{"type": "Offer", "stamp": 0, "source": "diarist"}]


def test_a_failed_run_leaves_its_summary(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="out of order"):
        run(tmp_path, Speaker, Failing)
    summary = msgspec.json.decode((tmp_path / "summary.json").read_bytes(), type=Summary)
    assert summary.error == "failing: RuntimeError: out of order"
    assert summary.events["Ping"] in {5, 6}  # one is due as it fails


def test_real_time_is_measured(tmp_path: Path) -> None:
    summary = run(tmp_path, Speaker, clock="real", seconds=0.2)
    assert 0.2 <= summary.sim_seconds < 30  # at which a busy machine may get round to it
    assert 0.2 <= summary.wall_seconds < 30
    tick = summary.ticks["speaker.speak"]
    assert 0 < tick.late_p50_us <= tick.late_p99_us <= tick.late_max_us


def test_the_tables_show_every_output_input_and_tick(tmp_path: Path) -> None:
    summary = run(tmp_path, Speaker, Lazy)
    cells = {cell for t in run_tables(summary) for c in t.columns for cell in c.cells}
    assert {"speaker.pings", "10.0", "lazy.some", "6", "speaker.speak"} <= cells


@pytest.mark.slow
def test_the_digest_is_of_what_was_said(tmp_path: Path) -> None:
    one, two = run(tmp_path, Speaker), run(tmp_path, Speaker)
    assert one.digest == two.digest
    assert one.digest != run(tmp_path, Speaker, Painter).digest


class RigConfig(NodeConfig, frozen=True):
    """Settings of the rig of the inputs."""

    noise: float = 0.0
    announced_noise: float = 0.0


class Rig(Node[RigConfig]):
    """A vehicle with an IMU and a camera."""

    imu = Output(Imu)
    images = Output(Image)
    odometry = Output(Odometry)

    def announce(self) -> Iterator[Announcement]:
        noise = self.config.announced_noise
        yield ImuAnnouncement(
            stamp=0,
            source="rig/imu",
            rate=10.0,
            frame_id="imu",
            gyroscope_noise_density=noise,
            gyroscope_random_walk=0.0,
            accelerometer_noise_density=0.0,
            accelerometer_random_walk=0.0,
        )
        yield Announcement(stamp=0, source="rig")

    @every(hz=10)
    def measure(self, tick: Tick) -> None:
        zero = (0.0, 0.0, 0.0)
        self.imu.send(
            Imu(
                stamp=tick.stamp,
                source="rig/imu",
                frame_id="imu",
                angular_velocity=zero,
                linear_acceleration=zero,
            )
        )
        self.odometry.send(
            Odometry(
                stamp=tick.stamp,
                source="rig",
                position=zero,
                orientation=(1.0, 0.0, 0.0, 0.0),
                linear_velocity=zero,
                angular_velocity=zero,
            )
        )
        grey = np.uint8(abs(self.rng.normal()) * self.config.noise % 256)
        self.images.send(
            Image(stamp=tick.stamp, source="rig", frame_id="lens", data=np.full((2, 2), grey))
        )


class TrackerConfig(NodeConfig, frozen=True):
    """Settings of the estimator of the inputs."""

    gain: float = 1.0


class Tracker(Node[TrackerConfig]):
    """An estimator, which sends its images on in its own name."""

    estimates = Output(PoseEstimate)
    views = Output(Image)

    def announce(self) -> Iterator[Announcement]:
        method = f"gain {self.config.gain}"
        yield EstimatorAnnouncement(stamp=0, source=self.name, method=method)
        yield Announcement(stamp=0, source=f"{self.name}/view")

    @on(Image, source="rig")
    def track(self, image: Image) -> None:
        seen = image.data + np.uint8(self.config.gain)
        self.views.send(replace(image, source=f"{self.name}/view", data=seen))


def rigged(gain: float = 1.0, digest: bool | None = None, **rig: float) -> Summary:
    nodes = (spec(Rig, "rig", rig), spec(Tracker, "tracker", {"gain": gain}))
    settings = RunConfig(duration=Duration(0.5), clock="lockstep", digest=digest)
    return execute(Config(run=settings, nodes=nodes))


def test_the_inputs_are_what_estimators_are_fed_and_not_what_they_answer() -> None:
    summary = rigged()
    assert set(summary.inputs) == {
        *("rig Announcement", "rig/imu ImuAnnouncement"),
        *("rig.images", "rig.imu", "rig.odometry"),
    }
    other = rigged(gain=2.0)
    assert summary.digests["tracker.views"] != other.digests["tracker.views"]
    assert (summary.inputs_digest, summary.inputs) == (other.inputs_digest, other.inputs)
    assert summary.digest != other.digest


@pytest.mark.slow
@pytest.mark.parametrize("rig", [{"noise": 50.0}, {"announced_noise": 0.1}], ids=str)
def test_a_changed_sensor_changes_the_digest_of_the_inputs(rig: dict[str, Any]) -> None:
    assert rigged(**rig).inputs_digest != rigged().inputs_digest


def test_without_a_digest_the_inputs_have_none() -> None:
    summary = rigged(digest=False)
    assert (summary.digest, summary.inputs_digest, summary.inputs) == (None, None, {})


def test_joined_runs_have_the_inputs_of_one() -> None:
    summary = rigged()
    announced = {name: value for name, value in summary.inputs.items() if "." not in name}
    there = {name: value for name, value in summary.inputs.items() if name == "rig.imu"}
    here = {name: value for name, value in summary.inputs.items() if name not in there}
    parts = [replace(summary, inputs=here), replace(summary, inputs=announced | there)]
    assert merged(parts, []).inputs_digest == summary.inputs_digest
    assert merged([summary, replace(summary, digest=None)], []).inputs_digest is None


def test_a_result_for_tests_counts_drops_too() -> None:
    result = run_nodes([spec(Speaker, "s"), spec(Lazy, "lazy")])
    assert result.drops["lazy.some"].dropped == 6


def test_the_command_line_is_kept_without_secrets(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["run", "a b.toml", "--set", "network.secret=abc", "network.secret=file:key"]
    monkeypatch.setattr(sys, "orig_argv", ["/opt/bin/python3", "-m", "runtime", *arguments])
    shown = command_line()
    assert shown.startswith("python3 -m runtime run 'a b.toml' --set ")
    assert "abc" not in shown
    assert "network.secret=file:key" in shown


def test_the_code_of_estimators_is_told_as_it_was_when_the_run_began(tmp_path: Path) -> None:
    nodes = (spec(Rig, "rig"), spec(Tracker, "tracker"))
    settings = RunConfig(duration=Duration(0.1), clock="lockstep")
    summary = execute(Config(run=settings, nodes=nodes), tmp_path / "run")
    assert summary.code == {"tracker": code_of(nodes[1])}
    assert summary.environment["commit"] == commit()
    assert merged([summary, replace(summary, code={"other": "1"})], []).code.keys() == {
        *("tracker", "other")
    }


@pytest.mark.parametrize("terminal", [False, True])
def test_a_terminal_shows_whole_words_and_a_pipe_whole_lines(terminal: bool) -> None:
    shown = StringIO()
    console = Console(file=shown, force_terminal=terminal, width=40, color_system=None)
    print_words(
        ["[bold]a[/bold] not judged: the user ended the run before its plan was flown"], console
    )
    rows = shown.getvalue().splitlines()
    assert " ".join(row.strip() for row in rows) == (
        "a not judged: the user ended the run before its plan was flown"
    )
    assert len(rows) == (2 if terminal else 1)


@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        ({}, []),
        (
            {"final_ate_rmse_m": 0.20234, "final_ate_percent": 3.94, "final_poses": 80},
            ["  final ATE 0.202 m (3.9 %) of 80 poses after all corrections"],
        ),
        (
            {"final_ate_rmse_m": 0.2, "final_ate_percent": None, "final_poses": 3},
            ["  final ATE 0.2 m of 3 poses after all corrections"],
        ),
        ({"why_not_final": "no [x]"}, ["  final trajectory not judged: no [x]"]),
    ],
)
def test_a_final_trajectory_has_a_line_of_its_own(
    figures: dict[str, Any], expected: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    print_verdict(Verdict(passed=True, estimators={"est": {"passed": True, **figures}}))
    assert capsys.readouterr().out.splitlines()[1:] == expected
