"""Trajectory files of other tools: TUM, EuRoC and KITTI, read and written; VSLAM-LAB, read.

- TUM (cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats): ``timestamp tx ty tz qx qy qz qw``
  in seconds and metres, the scalar last.
- EuRoC's ground truth (M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016):
  nanoseconds, position, quaternion with the scalar first, velocity, biases; with commas.
- VSLAM-LAB (github.com/VSLAM-LAB/VSLAM-LAB): nanoseconds, position, the scalar last; with commas.
- KITTI (cvlibs.net/datasets/kitti/eval_odometry.php): the first three rows of the transform from
  child to parent, row by row; no stamps, so two such files go together line by line.

Written with nanoseconds, nanometres and 12 decimals of a quaternion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import Quaternion, Vector3
from nodes.trajectory.table import Row, read_rows, seconds_text
from nodes.trajectory.trajectory import UNIT_LENGTH, Trajectory, not_rotations

Floats = npt.NDArray[np.float64]

EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]"
)
"""First line of EuRoC's files."""


def read_tum(path: Path, *, whole: bool = True, in_order: bool = True) -> Trajectory:
    """Read a TUM file; stamps keep every nanosecond written.

    Args:
        whole: Whether a last line without its end counts; a killed run's may be cut off.
        in_order: Whether stamps have to rise; else rows are sorted, and the first of equal stamps
            counts.

    Raises:
        ValueError: It cannot be read or holds something else; the message names the line.
    """
    rows = read_rows(path, None, (8,), "timestamp tx ty tz qx qy qz qw", whole=whole)
    poses = [(row, row.seconds(), row.numbers(1, 8)) for row in rows]
    if not in_order:
        poses = list({pose[1]: pose for pose in reversed(poses)}.values())
        poses.sort(key=lambda pose: pose[1])
    return _trajectory([(row, stamp, [*v[:3], v[6], *v[3:6]]) for row, stamp, v in poses])


def write_tum(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, with the lines of a comment before; may raise `OSError`."""
    header = "timestamp[s] tx ty tz[m] qx qy qz qw"
    rows = (tum_row(*pose) for pose in trajectory.poses())
    _write(path, [*_comment(comment), f"# {header}\n", *rows])


def tum_row(stamp: int, position: Vector3, orientation: Quaternion) -> str:
    """Return a pose (ns, metres, w x y z) as a line of a TUM file."""
    (x, y, z), (qw, qx, qy, qz) = position, orientation
    return (
        f"{seconds_text(stamp)} {x:.9f} {y:.9f} {z:.9f} {qx:.12f} {qy:.12f} {qz:.12f} {qw:.12f}\n"
    )


def read_euroc(path: Path) -> Trajectory:
    """Read a EuRoC ground truth of 17 or 8 (TUM VI) columns; a `ValueError` names a wrong line."""
    return _trajectory([(row, stamp, v[:7]) for row, stamp, v in euroc_rows(path, (17, 8))])


def euroc_rows(
    path: Path, columns: tuple[int, ...] = (17,), tolerance: float = UNIT_LENGTH
) -> Iterator[tuple[Row, int, list[float]]]:
    """Yield a EuRoC ground truth's rows, stamps (ns), values; a `ValueError` names a wrong line."""
    for row in read_rows(path, ",", columns, "timestamp, p x 3, q x 4, v x 3, b_w x 3, b_a x 3"):
        values = row.numbers(1, 17)
        _check_quaternion(row, values[3:7], tolerance)
        yield row, row.nanoseconds(), values


def read_vslamlab(path: Path) -> Trajectory:
    """Read VSLAM-LAB's ``ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw``; may raise `ValueError`."""
    rows = [
        (row, row.nanoseconds(), row.numbers(1, 8))
        for row in read_rows(path, ",", (8,), "ts, t x 3, qx, qy, qz, qw", header=True)
    ]
    return _trajectory([(row, stamp, [*v[:3], v[6], *v[3:6]]) for row, stamp, v in rows])


def write_euroc(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a EuRoC ground truth; velocities by differences, biases zero; may raise `OSError`."""
    velocities = [(x, y, z) for x, y, z in trajectory.velocities().tolist()]
    rows = (
        euroc_row(*pose, velocity)
        for pose, velocity in zip(trajectory.poses(), velocities, strict=True)
    )
    _write(path, [*_comment(comment), f"{EUROC_HEADER}\n", *rows])


def euroc_row(
    stamp: int, position: Vector3, orientation: Quaternion, velocity: Vector3 = (0.0, 0.0, 0.0)
) -> str:
    """Return a pose (ns, metres, w x y z, m/s) as a line of a EuRoC ground truth; biases zero."""
    x, y, z = position
    w, i, j, k = orientation
    u, v, s = velocity
    return (
        f"{stamp},{x:.9f},{y:.9f},{z:.9f},{w:.12f},{i:.12f},{j:.12f},{k:.12f},"
        f"{u:.9f},{v:.9f},{s:.9f},0,0,0,0,0,0\n"
    )


def read_kitti(path: Path) -> Floats:
    """Read a KITTI file: child to parent, (n, 4, 4); a `ValueError` names a wrong line."""
    rows = list(read_rows(path, None, (12,), "r11 r12 r13 tx r21 … tz"))
    matrices = np.zeros((len(rows), 4, 4))
    matrices[:, 3, 3] = 1.0
    matrices[:, :3, :] = np.reshape([row.numbers(0, 12) for row in rows], (-1, 3, 4))
    if wrong := not_rotations(matrices[:, :3, :3]):
        rows[wrong[0]].wrong("a rotation matrix", str(matrices[wrong[0], :3, :3].tolist()))
    return matrices


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a KITTI file: poses only, no stamps, no comments; may raise `OSError`."""
    rows = trajectory.matrices()[:, :3, :].reshape(-1, 12).tolist()
    _write(path, [" ".join(f"{value:.12f}" for value in row) + "\n" for row in rows])


def _trajectory(rows: list[tuple[Row, int, list[float]]]) -> Trajectory:
    """Make a trajectory of lines, stamps, and rows of x y z qw qx qy qz, checked line by line."""
    last: int | None = None
    for row, stamp, pose in rows:
        if last is not None and stamp <= last:
            row.wrong(f"a stamp above {last} ns", f"{stamp} ns")
        last = stamp
        _check_quaternion(row, pose[3:], UNIT_LENGTH)
    values = np.array([pose for _, _, pose in rows])
    stamps = np.array([stamp for _, stamp, _ in rows], dtype=np.int64)
    return Trajectory(stamps, values[:, :3], values[:, 3:])


def _check_quaternion(row: Row, quaternion: list[float], tolerance: float) -> None:
    if not abs(math.hypot(*quaternion) - 1.0) <= tolerance:
        row.wrong("a quaternion of length 1", f"w x y z = {quaternion}")


def _comment(text: str) -> list[str]:
    return [f"# {line}\n" for line in text.splitlines()]


def _write(path: Path, lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(lines)
