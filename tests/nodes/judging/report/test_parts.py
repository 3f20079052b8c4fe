"""The report's parts, each on its own: lenient reading, gaps, relative errors, hiding, numbers."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nodes.judging.evaluation.record import Interval
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.judging.report.clouds import Shown, View, paint
from nodes.judging.report.curves import draw_axes, draw_latency
from nodes.judging.report.folder import broken, gaps, holes, read_poses, read_run
from nodes.judging.report.page import render
from nodes.judging.report.tables import drawing, label, number
from nodes.judging.report.trajectories import draw_trajectories
from nodes.mapping import read_ply
from nodes.trajectory import Trajectory
from nodes.trajectory_files import read_tum, write_tum
from tests.nodes.judging.report.folders import SECOND, evaluated, ply, recorded, summary, walk


def test_poses_are_read_as_the_strict_reader_reads_them(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", walk(1))
    ours, theirs = read_poses(tmp_path / "a.tum"), read_tum(tmp_path / "a.tum")
    assert (ours.stamps == theirs.stamps).all()
    assert (ours.positions == theirs.positions).all()
    assert (ours.orientations == theirs.orientations).all()


def test_a_last_line_that_is_cut_off_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    write_tum(path, walk(1))
    path.write_bytes(path.read_bytes()[:-60])
    assert len(read_poses(path)) == len(walk(1)) - 1


def test_calendar_stamps_keep_their_nanoseconds(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("1403636579.763555527 0 0 0 0 0 0 1\n1403636579.8 0 0 0 0 0 0 1\n")
    assert read_poses(path).stamps.tolist() == [1403636579763555527, 1403636579800000000]


@pytest.mark.parametrize("text", ["", "# only\n", "1 2 3\n", "a b c d e f g h\n"])
def test_what_holds_no_poses_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(ValueError, match=r"."):
        read_poses(tmp_path / "a.tum")


def test_errors_along_axes_are_those_of_the_point_compared(tmp_path: Path) -> None:
    """Of a camera at its true place, on a body that is turned too far."""
    truth, lever = walk(10), [0.2, -0.1, 0.3]
    verdict = evaluated(tmp_path, truth, {"vo": recorded(truth)}, Thresholds())
    verdict["estimators"]["vo"] |= {"compared_at": "drone/eye", "alignment": "sim3"}
    (tmp_path / "evaluation" / "verdict.json").write_bytes(msgspec.json.encode(verdict))
    eye = {"type": "CameraAnnouncement", "source": "drone/eye", "position": lever}
    summary(tmp_path, verdict, announcements=[eye | {"source": "drone/other"}, eye])
    turned = (Rotation.from_rotvec([0.0, 0.0, 0.3]) * truth.rotations()).as_quat(scalar_first=True)
    camera = Trajectory(truth.stamps, truth.moved(lever).positions, turned)
    write_tum(tmp_path / "evaluation" / "vo.aligned.tum", camera.moved([-x for x in lever]))
    run = read_run(tmp_path)
    with drawing():
        plot = draw_axes(run)
    assert plot is not None
    lines = [line for axis in plot.figure.axes for line in axis.lines]
    assert len(lines) == 3
    assert max(np.nanmax(abs(np.asarray(line.get_ydata()))) for line in lines) < 1e-5
    assert "with scale (Sim3), compared at drone/eye" in render(run, [], [], [])


def test_gaps_are_where_no_pose_is_and_lines_break_there() -> None:
    truth = walk(10)
    said = recorded(truth, silent=(4.0, 6.0)).longest.rows.trajectory()
    (lost,) = gaps(said, truth)
    assert (lost.start / SECOND, lost.end / SECOND) == pytest.approx((4.0, 6.0), abs=0.04)
    line = broken(said.positions, said.stamps, [lost])
    assert np.isnan(line[:, 0]).sum() == 1
    inside = broken(said.positions, said.stamps, [Interval(SECOND, 2 * SECOND)])
    within = (said.stamps > SECOND) & (said.stamps < 2 * SECOND)
    assert (np.isnan(inside[:, 0]) == within).all()


def test_lines_break_where_no_truth_is_known(tmp_path: Path) -> None:
    whole = walk(10)
    known = (whole.stamps <= 3 * SECOND) | (whole.stamps >= 6 * SECOND)
    truth = whole.take(known)
    (hole,) = holes(truth)
    assert (hole.start / SECOND, hole.end / SECOND) == (3.0, 6.0)
    sparse = whole.take(whole.stamps % SECOND == 0)
    assert not any(map(holes, (whole, sparse, truth.take(slice(1)), None)))
    evaluated(tmp_path, truth, {"vo": recorded(whole)}, Thresholds())
    with drawing():
        plot = draw_trajectories(read_run(tmp_path))
    assert plot is not None
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in plot.figure.axes[0].lines}
    assert all(np.isnan(lines[name]).any() for name in ("truth", "vo"))


def test_an_end_in_silence_is_a_gap() -> None:
    truth = walk(10)
    said = recorded(truth).longest.rows.trajectory()
    (lost,) = gaps(said.take(said.stamps <= 7 * SECOND), truth)
    assert lost.end == truth.stamps[-1]


def test_of_points_on_one_pixel_the_nearest_is_seen() -> None:
    view = View("", np.eye(3), np.zeros(2), np.ones(2))
    points = np.array([[0.5, 0.5, z] for z in (0.1, 0.9, 0.5)], np.float32)
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    image, _ = paint(Shown("", points, colors, 3), view, 11.0, 1)
    assert image.shape == (11, 11, 3)
    assert image[5, 5].tolist() == [0, 255, 0]
    assert (image.reshape(-1, 3) != image[0, 0]).any(axis=1).sum() == 1


def test_where_dots_overlap_the_nearer_is_seen() -> None:
    view = View("", np.eye(3), np.zeros(2), np.ones(2))
    points = np.array([[0.5, 0.5, 0.9], [0.6, 0.5, 0.1]], np.float32)
    colors = np.array([[255, 0, 0], [0, 255, 0]], np.uint8)
    image, _ = paint(Shown("", points, colors, 2), view, 11.0, 3)
    assert (image == [255, 0, 0]).all(axis=2).sum() == 9
    assert (image == [0, 255, 0]).all(axis=2).sum() == 3


def test_a_name_that_matplotlib_would_hide_is_shown() -> None:
    assert label("_a").strip() == "_a"
    assert not label("_a").startswith("_")
    assert len(label("long" * 20)) == 40


def test_up_on_the_image_is_north_and_right_is_east() -> None:
    view = View("", np.eye(3), np.zeros(2), np.ones(2))
    points = np.array([[0.95, 0.95, 0.0]], np.float32)
    image, _ = paint(Shown("", points, np.zeros((1, 3), np.uint8), 1), view, 10.0, 1)
    assert image[0, 9].tolist() == [0, 0, 0]


def test_clouds_are_read_whole_and_sampled(tmp_path: Path) -> None:
    points = np.arange(300, dtype=float).reshape(100, 3)
    points[7] = np.nan
    colors = np.arange(300).reshape(100, 3) % 256
    ply(tmp_path / "a.ply", points, colors)
    cloud = read_ply(tmp_path / "a.ply", 1000)
    assert cloud.total == 100
    assert cloud.colors is not None
    assert cloud.points.tolist() == np.delete(points, 7, 0).tolist()
    assert cloud.colors.tolist() == np.delete(colors, 7, 0).tolist()
    assert len(read_ply(tmp_path / "a.ply", 10).points) in (9, 10)
    ply(tmp_path / "b.ply", points)
    assert read_ply(tmp_path / "b.ply", 10).colors is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a PLY file"),
        (b"ply\nformat ascii 1.0\nend_header\n", "format ascii"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 2\nend_header\n", "element face"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nend_header\n", "x, y and z"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"
            b"property float y\nproperty float z\nend_header\n1234",
            "2 points in",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
            b"property list uchar int x\nend_header\n",
            "property list",
        ),
    ],
)
def test_what_is_no_such_cloud_is_said(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "a.ply", 10)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.012345, "0.0123"),
        (0.9996, "1.00"),
        (123.456, "123"),
        (54321.0, "54321"),
        (-1.5, "−1.50"),
        (1.234e-7, "1.23e−07"),
        (3e9, "3.00e+09"),
        (float("inf"), "∞"),
        (float("-inf"), "−∞"),
        (float("nan"), "–"),
    ],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_a_fixed_latency_and_ages_in_steps_of_a_tick_give_lines_that_only_rise(
    tmp_path: Path,
) -> None:
    truth = walk(20)
    evaluated(tmp_path, truth, {"vo": recorded(truth)}, Thresholds())
    with drawing():
        plot = draw_latency(read_run(tmp_path))
        assert plot is not None
        for axis in plot.figure.axes:
            (line,) = axis.get_lines()
            x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
            assert (np.diff(x) >= 0).all()
            assert (np.diff(y) >= 0).all()
            assert (y[0], y[-1]) == (0.0, 100.0)


def test_the_start_is_seen_around_an_end_on_the_same_spot(tmp_path: Path) -> None:
    """A ring around a square, not one mark on the other: a round trip has both on one spot."""
    truth = walk(20)
    home = truth.positions - np.linspace(0, 1, len(truth))[:, None] * (
        truth.positions[-1] - truth.positions[0]
    )
    (tmp_path / "trajectories").mkdir()
    write_tum(
        tmp_path / "trajectories" / "truth.tum", Trajectory(truth.stamps, home, truth.orientations)
    )
    with drawing():
        plot = draw_trajectories(read_run(tmp_path))
    assert plot is not None
    marks = {line.get_label(): line for line in plot.figure.axes[0].get_lines()}
    start, end = marks["start"], marks["end"]
    assert np.allclose(start.get_xydata(), end.get_xydata())
    assert start.get_markerfacecolor() == "none"
    assert start.get_markersize() > 2 * end.get_markersize()
