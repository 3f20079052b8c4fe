"""What the flight log leaves: a trajectory that other tools read, and images."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from events import Collision, Event, Image, Odometry
from nodes.flight_log import FlightLog
from runtime import Duration, Tick, every
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError
from runtime.execute import execute
from runtime.testing import run_node, run_nodes, spec
from tests.nodes.pilots.test_waypoint_follower import Vehicle


def odometry(stamp: int, x: float = 0.0, yaw: float = 0.0) -> Odometry:
    return Odometry(
        stamp=stamp,
        source="drone",
        position=(x, 2.0, -1.5),
        orientation=(math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)),
        linear_velocity=(1.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
    )


def image(stamp: int, *, grey: bool = False) -> Image:
    data = np.full((30, 40) if grey else (30, 40, 3), 80, np.uint8)
    encoding = "mono8" if grey else "rgb8"
    return Image(stamp=stamp, source="drone/front", frame_id="f", encoding=encoding, data=data)


def collision(stamp: int) -> Collision:
    where, normal = (0.1, 2.0, -1.5), (0.0, 0.0, -1.0)
    return Collision(
        stamp=stamp, source="drone", other="wall", position=where, normal=normal, speed=1.0
    )


def log(out: Path, inputs: list[Event], **config: object) -> None:
    run_node(FlightLog, inputs=inputs, out=out, config=config, duration=20)


def trajectory(path: Path) -> list[list[float]]:
    """Read a TUM file as any tool does: numbers between blanks, # for comments."""
    text = path.read_text(encoding="ascii")
    assert text.endswith("\n")
    return [[float(v) for v in line.split()] for line in text.splitlines() if line[0] != "#"]


def test_the_trajectory_is_in_tums_format(tmp_path: Path) -> None:
    log(tmp_path, [odometry(5_000_000 * k, 0.1 * k, yaw=0.2 * k) for k in range(4)])
    rows = trajectory(tmp_path / "trajectory.tum")
    assert [row[0] for row in rows] == [0.0, 0.005, 0.01, 0.015]
    assert [len(row) for row in rows] == [8] * 4
    assert rows[3][1:4] == [0.3, 2.0, -1.5]
    assert rows[3][4:] == pytest.approx([0, 0, math.sin(0.3), math.cos(0.3)], abs=1e-9)


def test_stamps_keep_their_nanoseconds(tmp_path: Path) -> None:
    log(tmp_path, [odometry(12_000_000_001)])
    assert "\n12.000000001 " in (tmp_path / "trajectory.tum").read_text()


@pytest.mark.slow
def test_images_are_drawn(tmp_path: Path) -> None:
    inputs: list[Event] = [odometry(500_000_000 * k, k) for k in range(20)]
    inputs += [image(500_000_000 * k, grey=k % 2 == 1) for k in range(20)]
    inputs.append(collision(9_000_000_000))
    log(tmp_path, sorted(inputs, key=lambda e: e.stamp), interval="500ms")
    for name in ("flight.png", "images.png"):
        drawn = cv2.imread(str(tmp_path / name))
        assert drawn is not None
        assert min(drawn.shape[:2]) > 300
        assert drawn.std() > 5


@pytest.mark.parametrize(("east", "seconds"), [(0.0, 20), (1.0, 20), (0.0, 1)])
def test_a_straight_flight_and_one_on_the_spot_are_drawn_as_large(
    tmp_path: Path, east: float, seconds: int
) -> None:
    """Axes without breadth would be a line: half of the plot's height is the view from above."""
    log(tmp_path, [odometry(500_000_000 * k, east * k) for k in range(2 * seconds)])
    image = cv2.imread(str(tmp_path / "flight.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    left = image[:, : image.shape[1] * 2 // 5]
    rows = np.flatnonzero((left < 200).any(axis=1))
    assert rows[-1] - rows[0] > image.shape[0] // 3


def test_the_sheet_never_holds_more_than_it_should() -> None:
    """A long flight halves what the sheet holds and doubles the interval."""
    kept: list[int] = []

    class Peeking(FlightLog):
        async def on_shutdown(self) -> None:
            kept.extend(stamp for stamp, *_ in self._thumbnails)
            await super().on_shutdown()

    frames = [image(100_000_000 * k) for k in range(150)]
    run_node(Peeking, inputs=frames, config={"image_count": 4, "interval": "1s"}, duration=20)
    assert len(kept) <= 4
    assert kept[0] == 0
    assert kept[-1] >= 8_000_000_000


def test_a_flight_without_images_or_movement_leaves_what_there_is(tmp_path: Path) -> None:
    log(tmp_path, [odometry(0)])
    assert {p.name for p in tmp_path.iterdir()} == {"trajectory.tum", "flight.png"}
    other = tmp_path / "other"
    other.mkdir()
    log(other, [])
    assert [p.name for p in other.iterdir()] == ["trajectory.tum"]
    assert trajectory(other / "trajectory.tum") == []


def test_without_a_folder_it_writes_nothing() -> None:
    before = set(Path.cwd().iterdir())
    run_node(FlightLog, inputs=[odometry(0), image(0)])
    assert set(Path.cwd().iterdir()) == before


def test_folders_and_files_may_have_any_name(tmp_path: Path) -> None:
    out = tmp_path / "Flug über Köln 飛行"
    out.mkdir()
    log(out, [odometry(0), image(0)], trajectory="Weg ä.tum", plot="Flug ß.png", sheet="絵.png")
    assert {p.name for p in out.iterdir()} == {"Weg ä.tum", "Flug ß.png", "絵.png"}


def test_a_file_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match=r"node: FileNotFoundError: .*missing/t\.tum"):
        log(tmp_path, [], trajectory="missing/t.tum")


def test_a_run_that_is_stopped_leaves_a_whole_file(tmp_path: Path) -> None:
    run = RunConfig(duration=Duration(2.011))
    execute(Config(run=run, nodes=(spec(Vehicle, "v"), spec(FlightLog, "log"))), tmp_path)
    rows = trajectory(tmp_path / "trajectory.tum")
    assert len(rows) == 101
    assert all(len(row) == 8 for row in rows)
    assert (tmp_path / "flight.png").exists()


class Failing(FlightLog):
    """Fails now and then, and is brought up again."""

    @every(hz=1)
    def fail(self, tick: Tick) -> None:
        if tick.index == 2:
            raise RuntimeError("now")


@pytest.mark.slow
def test_a_restart_keeps_what_was_written_before(tmp_path: Path) -> None:
    """The trajectory goes on, whatever was said while it was down; images are drawn by part."""
    inputs: list[Event] = [odometry(100_000_000 * k, 0.1 * k) for k in range(60)]
    inputs += [image(500_000_000 * k) for k in range(12)]
    node = spec(Failing, "log", on_error="restart")
    run_nodes([node], inputs=sorted(inputs, key=lambda e: e.stamp), out=tmp_path, duration=6.0)
    text = (tmp_path / "trajectory.tum").read_text()
    assert text.count("#") == 1
    stamps = [row[0] for row in trajectory(tmp_path / "trajectory.tum")]
    assert stamps == sorted(set(stamps))
    assert stamps[0] == 0.0
    assert stamps[-1] == 5.9
    assert len(stamps) > 40
    assert {p.name for p in tmp_path.iterdir()} == {
        "trajectory.tum",
        *(f"{name}{part}.png" for name in ("flight", "images") for part in ("", "-2", "-3")),
    }
