"""Trajectories, poses in time: checked arrays, interpolation, matrices; and rows for nodes."""

from __future__ import annotations

import tempfile
from bisect import bisect_left
from collections.abc import Iterable
from typing import IO, Any

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from events import Quaternion, Vector3
from events.frames import slerp
from events.geometry import Pose

__all__ = ["PoseRows", "RecentPoses", "Trajectory", "associate", "bridged", "is_sparser", "pair"]


Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

UNIT_LENGTH = 0.01  # tolerated deviation of a quaternion's length from 1, for files of few decimals


_UNITS = {"seconds": 1e9, "milliseconds": 1e6, "microseconds": 1e3}  # nanoseconds of each
_CALENDAR = 10**17  # least stamp (ns) taken for Unix time (1973)
_ROW = np.dtype([("stamp", "i8"), ("position", "f8", 3), ("orientation", "f8", 4)])
_BLOCK = 1024  # rows of a pose, and how many are written at once: 64 KiB take the loop 30 µs


class Trajectory(msgspec.Struct, frozen=True, eq=False):
    """Poses of a body in a frame, in order of time. The arrays are read-only copies.

    Raises:
        ValueError: The arrays differ; the message names the first row.
    """

    stamps: Stamps  # nanoseconds, int64, shape (n,), n ≥ 1, strictly rising
    positions: Floats  # metres in the parent frame, float64, shape (n, 3)
    orientations: Floats  # unit quaternions w, x, y, z, child to parent, float64, shape (n, 4)

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps)
        if stamps.dtype.kind not in "iu":
            raise ValueError(
                f"trajectory: stamps: expected whole nanoseconds, found {stamps.dtype} "
                f"of shape {stamps.shape}"
            )
        if stamps.ndim != 1 or not len(stamps):
            raise ValueError(
                f"trajectory: stamps: expected one or more in a row, found shape {stamps.shape}"
            )
        n = len(stamps)
        positions = _floats("positions", self.positions, (n, 3))
        orientations = _floats("orientations", self.orientations, (n, 4))
        if back := np.flatnonzero(np.diff(stamps) <= 0).tolist():
            row = back[0] + 1
            raise ValueError(
                f"trajectory: row {row}: expected a stamp above {stamps[row - 1]} ns, "
                f"found {stamps[row]} ns"
            )
        norms = np.linalg.norm(orientations, axis=1)
        if odd := np.flatnonzero(abs(norms - 1.0) > UNIT_LENGTH).tolist():
            row = odd[0]
            raise ValueError(
                f"trajectory: row {row}: expected a quaternion of length 1, "
                f"found {orientations[row].tolist()} of length {norms[row]:.6g}"
            )
        if abs(norms - 1.0).max() > 1e-12:
            orientations /= norms[:, None]
        for name, array in (
            ("stamps", stamps.astype(np.int64)),
            ("positions", positions),
            ("orientations", orientations),
        ):
            array.setflags(write=False)
            msgspec.structs.force_setattr(self, name, array)

    @classmethod
    def from_matrices(cls, stamps: Stamps, matrices: Floats) -> Trajectory:
        """Make a trajectory of rigid transforms child to parent, metres, (n, 4, 4), at stamps."""
        matrices = np.asarray(matrices, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
            raise ValueError(
                f"trajectory: matrices: expected shape (n, 4, 4), found {matrices.shape}"
            )
        return cls(stamps, matrices[:, :3, 3], quaternions(matrices[:, :3, :3]))

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def seconds(self) -> float:
        """Time from the first pose to the last."""
        return int(self.stamps[-1] - self.stamps[0]) / 1e9

    def length(self) -> float:
        """Return the length of the path in metres, pose to pose."""
        return float(self.distances()[-1])

    def distances(self, hole: int | None = None) -> Floats:
        """Return the path's length from the start to each pose, metres, shape (n,).

        Args:
            hole: Nanoseconds: what lies between poses farther apart has no length.
        """
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        if hole is not None:
            steps[np.diff(self.stamps) > hole] = 0.0
        return np.concatenate([[0.0], np.cumsum(steps)])

    def near(self, stamps: Stamps) -> Trajectory:
        """Return the rows near stamps (ns), two on each side: `velocities` between are the same."""
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, max(len(self) - 1, 1))
        rows = np.zeros(len(self), np.bool_)
        rows[np.clip(after[:, None] + np.arange(-2, 2), 0, len(self) - 1)] = True
        return self.take(rows)

    def velocities(self) -> Floats:
        """Return velocities by differences, m/s in the parent frame, (n, 3); zero for one pose."""
        if len(self) < 2:
            return np.zeros((len(self), 3))
        # As np.gradient, whose seconds since the start cannot tell stamps of nanoseconds apart.
        steps = np.diff(self.stamps)[:, None] / 1e9
        slopes = np.diff(self.positions, axis=0) / steps
        inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[:-1] + steps[1:])
        return np.concatenate([slopes[:1], inner, slopes[-1:]])

    def poses(self) -> Iterable[tuple[int, Vector3, Quaternion]]:
        """Return stamps (ns), positions (m) and orientations (w, x, y, z), pose by pose."""
        rows = (self.stamps.tolist(), self.positions.tolist(), self.orientations.tolist())
        return zip(*rows, strict=True)

    def rotations(self) -> Any:
        """Return the orientations as a `scipy.spatial.transform.Rotation` of n rotations."""
        return Rotation.from_quat(self.orientations, scalar_first=True)

    def matrices(self) -> Floats:
        """Return the poses as transforms from child to parent, shape (n, 4, 4)."""
        matrices = np.zeros((len(self), 4, 4))
        matrices[:, :3, :3] = self.rotations().as_matrix()
        matrices[:, :3, 3] = self.positions
        matrices[:, 3, 3] = 1.0
        return matrices

    def take(self, rows: npt.NDArray[Any] | slice) -> Trajectory:
        """Return rows by mask (n,), rising numbers or slice; a `ValueError` if none are left."""
        return Trajectory(self.stamps[rows], self.positions[rows], self.orientations[rows])

    def covers(self, stamps: Stamps, hole: int | None = None) -> npt.NDArray[np.bool_]:
        """Return a mask of the stamps (ns) from the first pose to the last, shape as given.

        Args:
            hole: Nanoseconds: between poses farther apart nothing is covered.
        """
        stamps = np.asarray(stamps)
        inside = (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1])
        if hole is not None:
            after = np.searchsorted(self.stamps, stamps).clip(max=len(self) - 1)
            step = self.stamps[after] - self.stamps[after - (after > 0)]
            inside &= (step <= hole) | (self.stamps[after] == stamps)
        return np.asarray(inside)

    def pieces(self, stamps: Stamps, hole: int) -> Stamps:
        """Return the number of the piece that covered stamps (ns) lie in, shape as given.

        Args:
            hole: As of `covers`: a piece ends where the next pose is farther away.
        """
        ends = self.stamps[:-1][np.diff(self.stamps) > hole]
        return np.searchsorted(ends, stamps)

    def moved(self, lever: npt.ArrayLike) -> Trajectory:
        """Return the poses of a point fixed to the body, metres in its frame, shape (3,)."""
        if not np.any(lever):
            return self
        positions = self.positions + self.rotations().apply(lever)
        return Trajectory(self.stamps, positions, self.orientations)

    def step(self) -> int:
        """Return the median time from a pose to the next, nanoseconds; 0 for one pose."""
        return int(np.median(np.diff(self.stamps))) if len(self) > 1 else 0

    def at(self, stamps: Stamps) -> Trajectory:
        """Return the poses at other times: positions linear, orientations by slerp.

        A stamp of the trajectory gives that very row. (K. Shoemake, "Animating rotation with
        quaternion curves", 1985.)

        Args:
            stamps: Nanoseconds, strictly rising, all of them covered; see `covers`.

        Raises:
            ValueError: A stamp lies before the first pose or after the last.
        """
        stamps = np.asarray(stamps)
        outside = np.flatnonzero(~self.covers(stamps)).tolist()
        if outside:
            raise ValueError(
                f"trajectory: expected stamps between {self.stamps[0]} and {self.stamps[-1]} ns, "
                f"found {stamps[outside[0]]} ns ({len(outside)} such)"
            )
        if len(self) == 1:
            return self
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self) - 1)
        before = after - 1
        share = (stamps - self.stamps[before]) / (self.stamps[after] - self.stamps[before])
        a, b = self.positions[before], self.positions[after]
        positions = a + share[:, None] * (b - a)
        orientations = _slerp(self.orientations[before], self.orientations[after], share)
        same = self.stamps[after] == stamps
        positions[same], orientations[same] = b[same], self.orientations[after[same]]
        if stamps[0] == self.stamps[0]:
            orientations[0] = self.orientations[0]
        return Trajectory(stamps, positions, orientations)


class PoseRows:
    """Poses of events, in any order, until a trajectory is made of them.

    All but the newest wait in a nameless temporary file, if there is room, to save memory.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[int, Vector3, Quaternion]] = []
        self._blocks: list[npt.NDArray[np.void]] = []
        self._file: IO[bytes] | None = None
        self._written = 0
        self._whole: Trajectory | None = None

    def __len__(self) -> int:
        made = 0 if self._whole is None else len(self._whole)
        return made + self._written + sum(map(len, self._blocks)) + len(self._rows)

    def add(self, stamp: int, position: Vector3, orientation: Quaternion) -> None:
        """Add a pose: nanoseconds, metres, quaternion w, x, y, z."""
        self._rows.append((stamp, position, orientation))
        if len(self._rows) == _BLOCK:
            self._spill()

    def trajectory(self) -> Trajectory:
        """Return the poses so far in order, of equal stamps the latest; may raise `ValueError`."""
        made, written = self._whole, self._written
        parts = [*self._blocks, np.array(self._rows, _ROW)]
        if made is not None and not (written or any(map(len, parts))):
            return made
        known = 0 if made is None else len(made)
        rows = np.empty(known + written + sum(map(len, parts)), _ROW)
        if made is not None:
            rows["stamp"][:known], rows["position"][:known] = made.stamps, made.positions
            rows["orientation"][:known] = made.orientations
        if self._file is not None:
            with self._file as file:
                file.seek(0)
                room = rows[known : known + written].view(np.uint8)
                room[:] = np.frombuffer(file.read(room.nbytes), np.uint8)
        rows[known + written :] = np.concatenate(parts)
        self._blocks, self._rows, self._file, self._written = [], [], None, 0
        if not (np.diff(rows["stamp"]) > 0).all():
            rows = rows[np.argsort(rows["stamp"], kind="stable")]
            rows = rows[np.append(np.diff(rows["stamp"]) > 0, True)]
        self._whole = Trajectory(rows["stamp"], rows["position"], rows["orientation"])
        return self._whole

    def _spill(self) -> None:
        block = np.array(self._rows, _ROW)
        self._rows = []
        try:
            if self._file is None and not self._blocks:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
            if (
                self._blocks
                or self._file is None
                or self._file.write(block.tobytes()) != block.nbytes
            ):
                raise OSError
            self._written += len(block)
        except OSError:
            self._blocks.append(block)


def _slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Return unit quaternions between others: shapes (n, 4), (n, 4) and (n,) to (n, 4)."""
    second = np.where(np.sum(first * second, axis=1, keepdims=True) < 0.0, -second, second)
    away, along = (np.linalg.norm(q, axis=1) for q in (second - first, second + first))
    angle = 2.0 * np.arctan2(away, along)[:, None]
    part, still = share[:, None], angle < 1e-8
    sine = np.where(still, 1.0, np.sin(angle))
    a = np.where(still, 1.0 - part, np.sin((1.0 - part) * angle) / sine)
    b = np.where(still, part, np.sin(part * angle) / sine)
    return np.asarray(a * first + b * second)


HOLE = 200_000_000  # nanoseconds from a true pose to the next over which none is made up


def associate(
    truth: Trajectory, estimate: Trajectory, hole: int = HOLE, *, name: str = ""
) -> tuple[Trajectory, Trajectory]:
    """Return the truth at the estimate's stamps, and the estimate where there is a truth.

    Args:
        truth: Dense, as it is interpolated; estimates before its start, after its end or in a hole
            are left out.
        hole: As of `Trajectory.covers`.
        name: Beginning of errors' messages, such as the estimate's file.

    Raises:
        ValueError: They have no time in common; the message says if their units or clocks differ.
    """
    known = truth.covers(estimate.stamps, hole)
    if not known.any():
        if truth.covers(estimate.stamps).any():
            usual = np.median(np.diff(truth.stamps)) / 1e9
            raise ValueError(
                f"{name}{name and ': '}expected estimates between true poses at most "
                f"{hole / 1e9:g} s apart, found none: the truth's are {usual:.3g} s apart "
                f"(median); max_difference ({hole / 2e9:g} s) is half of what is bridged"
            )
        first, second = int(truth.stamps[-1]), int(estimate.stamps[-1])
        why = ""
        ratio = max(first, second) / max(min(first, second), 1)
        if min(first, second) == 0:
            why = ": all stamps of one are zero"
        elif unit := next((u for u, r in _UNITS.items() if 0.5 * r < ratio < 2.0 * r), ""):
            why = f": is one in {unit} and the other in nanoseconds?"
        elif (first > _CALENDAR) != (second > _CALENDAR):
            why = ": one is Unix time, the other counts from a run's beginning"
        raise ValueError(
            f"{name}{name and ': '}expected estimates within the truth's time, found the truth "
            f"from {truth.stamps[0]} to {first} ns and the estimate from {estimate.stamps[0]} to "
            f"{second} ns{why}"
        )
    kept = estimate.take(known)
    return truth.at(kept.stamps), kept


def is_sparser(truth: Trajectory, estimate: Trajectory) -> bool:
    """Return whether true poses are farther apart in time than estimates, by their medians."""
    return truth.step() > 1.05 * estimate.step() > 0.0


def bridged(trajectory: Trajectory, hole: int) -> int:
    """Return the longest time (ns) over which a trajectory is interpolated.

    At least two and a half of its usual steps: what is regular has no holes.
    """
    return max(hole, 5 * trajectory.step() // 2)


def pair(
    truth: Trajectory, estimate: Trajectory, hole: int = HOLE
) -> tuple[Trajectory, Trajectory]:
    """Return the truth and the estimate at the stamps of the one whose poses are farther apart.

    The denser one is interpolated: a chord over a second of a sparse truth, as of GNSS or a total
    station, would be off the path by more than many an estimate.

    Args:
        hole: As of `Trajectory.covers`, of the denser one; see `bridged` for a dense estimate.

    Raises:
        ValueError: As of `associate`.
    """
    if not is_sparser(truth, estimate):
        return associate(truth, estimate, hole)
    known = estimate.covers(truth.stamps, bridged(estimate, hole))
    if not known.any():
        return associate(truth, estimate, hole)  # raises, and says why
    kept = truth.take(known)
    return kept, estimate.at(kept.stamps)


def quaternions(rotations: Floats) -> Floats:
    """Return rotation matrices (n, 3, 3) as w, x, y, z (n, 4); a `ValueError` if one is none."""
    if wrong := not_rotations(rotations):
        raise ValueError(
            f"trajectory: row {wrong[0]}: expected a rotation matrix, "
            f"found {rotations[wrong[0]].tolist()}"
        )
    return np.asarray(Rotation.from_matrix(rotations).as_quat(scalar_first=True))


def not_rotations(matrices: Floats) -> list[int]:
    """Return the indices of matrices, shape (n, 3, 3), not rotations to 1e-4 (few decimals)."""
    finite = np.isfinite(matrices).all(axis=(1, 2), keepdims=True)
    matrices = np.where(finite, matrices, 0.0)
    odd = abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong: list[int] = np.flatnonzero((odd > 1e-4) | (np.linalg.det(matrices) < 0.0)).tolist()
    return wrong


def _floats(name: str, array: Any, shape: tuple[int, int]) -> Floats:
    """Return a float64 copy; raise `ValueError` unless finite and of this shape."""
    copy = np.array(array, dtype=np.float64)
    if copy.shape != shape:
        raise ValueError(
            f"trajectory: {name}: expected shape {shape}, as many rows as stamps, "
            f"found {copy.shape}"
        )
    if wrong := np.flatnonzero(~np.isfinite(copy).all(axis=1)).tolist():
        raise ValueError(
            f"trajectory: row {wrong[0]}: {name}: expected finite numbers, "
            f"found {copy[wrong[0]].tolist()}"
        )
    return copy


HISTORY = 10_000_000_000  # nanoseconds of recent poses to keep, back from the newest


class RecentPoses:
    """Recent poses of a frame in another, by time."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def add(self, stamp: int, position: Vector3, orientation: Quaternion) -> None:
        """Add a pose (ns, metres, w x y z), in any order; a pose of the same stamp is replaced."""
        stamps, poses = self._stamps, self._poses
        place = bisect_left(stamps, stamp)
        if place < len(stamps) and stamps[place] == stamp:
            poses[place] = position, orientation
            return
        stamps.insert(place, stamp)
        poses.insert(place, (position, orientation))
        old = bisect_left(stamps, stamps[-1] - HISTORY)
        del stamps[:old], poses[:old]

    def at(self, stamp: int, hole: int = HISTORY) -> Pose | None:
        """Return the pose at a time (ns), by slerp; `None` outside of those kept or in a hole."""
        stamps, poses = self._stamps, self._poses
        after = bisect_left(stamps, stamp)
        if after == len(stamps):
            return None
        if stamps[after] == stamp:
            return poses[after]
        if after == 0 or stamps[after] - stamps[after - 1] > hole:
            return None
        (p, q), (r, s) = poses[after - 1 : after + 1]
        share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        x, y, z = (a + share * (b - a) for a, b in zip(p, r, strict=True))
        return (x, y, z), slerp(q, s, share)
