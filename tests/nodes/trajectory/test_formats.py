"""Trajectory files: read as written, read by evo as they are, and errors that name the line.

Files that grow with a run: on the disk within half a second, and whole at its end.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given, settings

from nodes.trajectory import Trajectory
from nodes.trajectory_files import (
    GrowingFile,
    part_name,
    read_euroc,
    read_kitti,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)
from runtime import Node, Tick, every
from runtime.errors import NodeError
from runtime.testing import run_node, run_nodes, spec
from tests.nodes.trajectory.samples import angle, as_evo, walk

STAMPS = st.integers(-(10**12), 2 * 10**18)
NUMBERS = st.floats(-1e5, 1e5)


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    stamps = sorted(draw(st.sets(STAMPS, min_size=1, max_size=8)))
    n = len(stamps)
    positions = draw(hnp.arrays(np.float64, (n, 3), elements=NUMBERS))
    quaternions = draw(hnp.arrays(np.float64, (n, 4), elements=st.floats(-1.0, 1.0)))
    quaternions[np.linalg.norm(quaternions, axis=1) < 0.1] = [0.5, 0.5, 0.5, 0.5]
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    return Trajectory(np.array(stamps), positions, quaternions)


def read_kitti_with_stamps(path: Path, stamps: Any) -> Trajectory:
    return Trajectory.from_matrices(stamps, read_kitti(path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "read"),
    [
        (write_tum, lambda path, _: read_tum(path)),
        (write_euroc, lambda path, _: read_euroc(path)),
        (write_kitti, read_kitti_with_stamps),
    ],
)
@given(trajectory=trajectories())
@settings(max_examples=30, deadline=None)
def test_what_is_written_is_read(
    write: Callable[[Path, Trajectory], None],
    read: Callable[[Path, Any], Trajectory],
    trajectory: Trajectory,
) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        write(path, trajectory)
        back = read(path, trajectory.stamps)
    assert (back.stamps == trajectory.stamps).all()
    assert abs(back.positions - trajectory.positions).max() <= 0.6e-9
    assert angle(back, trajectory) < 1e-9


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (write_tum, file_interface.read_tum_trajectory_file),
        (write_euroc, file_interface.read_euroc_csv_trajectory),
        (write_kitti, file_interface.read_kitti_poses_file),
    ],
)
def test_evo_reads_it_as_it_is(
    write: Callable[[Path, Trajectory], None], read: Callable[[str], Any], tmp_path: Path
) -> None:
    path = walk(50, start=1_403_636_579_758_555_392)
    write(tmp_path / "file", path)
    by_evo, expected = read(str(tmp_path / "file")), as_evo(path)
    assert by_evo.check()[0], by_evo.check()
    assert by_evo.positions_xyz == pytest.approx(expected.positions_xyz, abs=1e-9)
    assert np.array(by_evo.poses_se3) == pytest.approx(np.array(expected.poses_se3), abs=1e-9)
    if hasattr(by_evo, "timestamps"):
        assert by_evo.timestamps == pytest.approx(expected.timestamps, rel=1e-15)


def test_evos_own_tum_file_is_read(tmp_path: Path) -> None:
    path = walk(20, start=123_456_789)
    file_interface.write_tum_trajectory_file(str(tmp_path / "t"), as_evo(path))
    back = read_tum(tmp_path / "t")
    assert abs(back.stamps - path.stamps).max() <= 1  # theirs are floats
    assert back.positions == pytest.approx(path.positions)


def test_a_tum_file_has_exact_stamps_and_comments(tmp_path: Path) -> None:
    path = Trajectory(
        np.array([-1_500_000_001, 7, 12_000_000_001]), np.zeros((3, 3)), walk(3).orientations
    )
    write_tum(tmp_path / "t", path, "frames:\nNED")
    lines = (tmp_path / "t").read_text().splitlines()
    assert lines[:3] == ["# frames:", "# NED", "# timestamp[s] tx ty tz[m] qx qy qz qw"]
    stamps = [line.split()[0] for line in lines[3:]]
    assert stamps == ["-1.500000001", "0.000000007", "12.000000001"]


def test_euroc_files_have_17_columns_and_the_velocity_of_the_path(tmp_path: Path) -> None:
    n = 5
    positions = np.outer(np.arange(n), [0.1, 0.0, -0.2])  # a tenth of a second apart
    path = Trajectory(100_000_000 * np.arange(n), positions, np.tile([1.0, 0, 0, 0], (n, 1)))
    write_euroc(tmp_path / "t.csv", path)
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert len(lines[0].split(",")) == 17
    rows = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    assert rows.shape == (n, 17)
    assert rows[:, 8:11] == pytest.approx(np.tile([1.0, 0.0, -2.0], (n, 1)))


def test_a_single_pose_has_no_velocity(tmp_path: Path) -> None:
    write_euroc(tmp_path / "t.csv", walk(1))
    assert (tmp_path / "t.csv").read_text().endswith(",0.000000000" * 3 + ",0" * 6 + "\n")


def test_comments_blank_lines_and_marks_of_windows_are_passed_over(tmp_path: Path) -> None:
    text = "\ufeff# head\r\n\r\n1.5 1 2 3 0 0 0 1  # tail\r\n  2e0\t1 2 3 0 0 0 1 \r\n"
    (tmp_path / "t").write_bytes(text.encode())
    assert read_tum(tmp_path / "t").stamps.tolist() == [1_500_000_000, 2_000_000_000]


def test_the_first_eight_columns_of_euroc_are_enough(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("#timestamp\n7,1,2,3,0.5,0.5,0.5,0.5\n")
    assert read_euroc(tmp_path / "t").orientations.tolist() == [[0.5, 0.5, 0.5, 0.5]]


GOOD = "0.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_tum, GOOD + "1.0 0 0 0 0 0 0\n", r"t:2: expected 8 fields \(timestamp tx .* '7: 1"),
        (read_tum, "#\n" + GOOD + "1.0 0 x 0 0 0 0 1\n", r"t:3: expected finite num.* '0 x 0 0 0"),
        (read_tum, "1.0 0 nan 0 0 0 0 1\n", r"t:1: expected finite numbers"),
        (read_tum, "now 0 0 0 0 0 0 1\n", r"t:1: expected a stamp in seconds, found 'now'"),
        (read_tum, "nan 0 0 0 0 0 0 1\n", r"t:1: expected a stamp in seconds, found 'nan'"),
        (read_tum, "1e12 0 0 0 0 0 0 1\n", r"t:1: expected a stamp in seconds, found '1e12'"),
        (read_tum, GOOD + GOOD, r"t:2: expected a stamp above 0 ns, found '0 ns'"),
        (read_tum, "1 0 0 0 0 0 0 3\n", r"t:1: expected a quaternion of length 1, found 'w x y z"),
        (read_tum, "# nothing\n", r"t: expected rows of timestamp tx .*, found none"),
        (read_euroc, "1,2,3\n", r"t:1: expected 17 or 8 fields .* found '3: 1,2,3'"),
        (read_euroc, "1.5,0,0,0,1,0,0,0\n", r"t:1: expected a stamp in whole nanosec.* '1.5'"),
        (read_euroc, "1" * 25 + ",0,0,0,1,0,0,0\n", r"t:1: expected a stamp in whole nanosec"),
        (read_euroc, "1,0,0,0,1,0,0,\n", r"t:1: expected finite numbers"),
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 1\n", r"t:1: expected 12 fields .* found '11: 1 0"),
        (read_kitti, "\n2 0 0 0 0 1 0 0 0 0 1 0\n", r"t:2: expected a rotation matrix"),
    ],
)
def test_errors_name_the_file_the_line_and_what_is_there(
    read: Callable[[Path], Any], text: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "t").write_text(text)
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "t")


@pytest.mark.parametrize("read", [read_tum, read_euroc, read_kitti])
def test_files_that_cannot_be_read_are_named(read: Callable[[Path], Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"missing: expected a text file .* No such file"):
        read(tmp_path / "missing")
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match=r"image\.png: expected a text file"):
        read(tmp_path / "image.png")


def test_a_long_line_is_shown_in_part(tmp_path: Path) -> None:
    (tmp_path / "t").write_text("7 " * 1000)
    with pytest.raises(ValueError, match="…") as error:
        read_tum(tmp_path / "t")
    assert len(str(error.value)) < 250


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "read"), [(write_tum, read_tum), (write_euroc, read_euroc), (write_kitti, read_kitti)]
)
@given(trajectory=trajectories(), data=st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_files_are_errors_of_one_line(
    write: Callable[[Path, Trajectory], None],
    read: Callable[[Path], Any],
    trajectory: Trajectory,
    data: st.DataObject,
) -> None:
    """Cut anywhere, with any bytes changed."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        write(path, trajectory)
        content = bytearray(path.read_bytes())
        del content[data.draw(st.integers(0, len(content))) :]
        for place in data.draw(st.lists(st.integers(0, max(len(content) - 1, 0)), max_size=4)):
            content[place : place + 1] = bytes([data.draw(st.integers(0, 255))])
        path.write_bytes(content)
        wrong = ""
        try:
            read(path)
        except ValueError as error:
            wrong = str(error)
            assert_names(wrong, path)


def assert_names(message: str, path: Path) -> None:
    """Check that a message is of one line and begins with the file."""
    assert message.startswith(str(path))
    assert "\n" not in message


class Writing(Node):
    """Adds a line each quarter of a second, and looks at the file before that."""

    seen: list[str]

    async def on_startup(self) -> None:
        assert self.out is not None
        type(self).seen = []
        self.path = self.out / "a.txt"
        self.file = GrowingFile(self, self.path, "# head\n")

    @every(hz=4)
    def add(self, tick: Tick) -> None:
        if self.path.is_file():
            self.seen.append(self.path.read_text())
        self.file.add(f"{tick.index}\n")

    async def on_shutdown(self) -> None:
        self.file.close()


def test_a_line_is_written_within_half_a_second(tmp_path: Path) -> None:
    """Should the run be killed, it is there."""
    run_node(Writing, duration=1.1, out=tmp_path)
    assert Writing.seen == [
        "",
        "# head\n0\n",
        "# head\n0\n",
        "# head\n0\n1\n2\n",
        "# head\n0\n1\n2\n",
    ]
    assert (tmp_path / "a.txt").read_text() == "# head\n0\n1\n2\n3\n4\n"


def test_a_disk_that_is_full_ends_the_run(tmp_path: Path) -> None:
    """Rather than that what is lost goes unseen."""
    (tmp_path / "a.txt").symlink_to("/dev/full")
    with pytest.raises(NodeError, match="No space left"):
        run_node(Writing, duration=1.1, out=tmp_path)


class Restarted(Writing):
    """Fails once, and is brought up again."""

    names: ClassVar[list[str]] = []

    async def run(self) -> None:
        self.names.append(part_name(self, "v1.2/clouds.tar/a.ply"))
        if not self.restarts:
            await self.clock.sleep(0.6)
            raise RuntimeError("now")


def test_a_restart_goes_on_in_the_file_and_gives_others_a_number(tmp_path: Path) -> None:
    """What was written before is still there."""
    run_nodes([spec(Restarted, "node", on_error="restart")], duration=2.1, out=tmp_path)
    head, *lines = (tmp_path / "a.txt").read_text().splitlines()
    assert head == "# head"
    assert lines[:3] == ["0", "1", "2"]
    assert "0" in lines[3:]
    assert Restarted.names == ["v1.2/clouds.tar/a.ply", "v1.2/clouds.tar/a-2.ply"]
