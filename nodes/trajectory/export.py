"""A run's trajectories, as files for evo and for the tools of other data sets.

A run leaves them as ``trajectories/truth.tum`` and ``trajectories/<estimator>.tum``, in ``map``
(NED) or the estimator's own frame, just as the estimator said them; nothing here aligns them.
"""

from __future__ import annotations

from pathlib import Path

from nodes.trajectory.formats import read_tum, write_euroc, write_kitti, write_tum
from nodes.trajectory.trajectory import Trajectory

FORMATS = ("tum", "euroc", "kitti")

TRUTH = "truth"
PLAN = "plan"
"""Names of those files that hold no estimate."""

_COMMENT = {
    TRUTH: "ground truth: base_link (FRD) in map (NED: x north, y east, z down)",
    "": "estimate, as it was said: base_link (FRD) in the estimator's frame",
}


def export(run: Path, form: str, out: Path | None = None) -> list[Path]:
    """Write a run's true trajectory and its estimates in another format.

    ``tum`` and ``euroc`` give a file each for the truth and every estimator. As evo compares a
    EuRoC truth with an estimate in TUM's format, ``euroc`` adds the latter. ``kitti``, whose files
    go together line by line, gives a pair for every estimator, at the estimator's stamps.

    Args:
        run: The run's folder.
        form: One of `FORMATS`.
        out: Folder for the files, made if need be; ``export`` in the run's folder if None.

    Returns:
        What was written, the truth first.

    Raises:
        ValueError: The run left no trajectories, or one of them is none.
        OSError: A file cannot be written.
    """
    if form not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, found {form!r}")
    truth, estimates = load(run)
    if form == "kitti" and not estimates:
        raise ValueError(
            f"{run / 'trajectories'}: expected an estimate to give KITTI's poses their times, "
            f"found {TRUTH}.tum only"
        )
    # Before anything is written: a run that has no such pair leaves no half of an export.
    pairs = {
        name: together(truth, estimate, f"{run / 'trajectories' / name}.tum")
        for name, estimate in (estimates.items() if form == "kitti" else ())
    }
    folder = out or run / "export"
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, (true, said) in pairs.items():
        for path, poses in (
            (folder / f"{name}.{TRUTH}.kitti.txt", true),
            (folder / f"{name}.kitti.txt", said),
        ):
            write_kitti(path, poses)
            written.append(path)
    if form == "kitti":
        return written
    for name, trajectory in ({TRUTH: truth} | estimates).items():
        comment = _COMMENT.get(name, _COMMENT[""])
        if form == "euroc":
            written.append(folder / f"{name}.csv")
            write_euroc(written[-1], trajectory, comment)
        if form == "tum" or name != TRUTH:
            written.append(folder / f"{name}.tum")
            write_tum(written[-1], trajectory, comment)
    return written


def load(run: Path) -> tuple[Trajectory, dict[str, Trajectory]]:
    """Read a run's true trajectory and its estimates, by name of the estimator.

    Raises:
        ValueError: The run left no trajectories, or one of them is none.
    """
    if not run.is_dir():
        raise ValueError(f"{run}: expected the folder of a run, found none")
    folder = run / "trajectories"
    if not (folder / f"{TRUTH}.tum").is_file():
        found = ", ".join(sorted(p.name for p in folder.glob("*.tum"))) or "no trajectories"
        raise ValueError(
            f"{folder / TRUTH}.tum: expected the run's true trajectory, found {found}: "
            "a run leaves its trajectories if a node of type nodes.evaluation:Evaluation is in it"
        )
    truth = read_tum(folder / f"{TRUTH}.tum")
    estimates = {
        path.stem: read_tum(path)
        for path in sorted(folder.glob("*.tum"))
        if path.stem not in {TRUTH, PLAN}
    }
    return truth, estimates


def together(
    truth: Trajectory, estimate: Trajectory, name: str = "estimate"
) -> tuple[Trajectory, Trajectory]:
    """Return the truth at the estimate's stamps, and the estimate where there is a truth.

    Raises:
        ValueError: They have no time in common.
    """
    known = truth.covers(estimate.stamps)
    if not known.any():
        raise ValueError(
            f"{name}: expected estimates between {truth.stamps[0]} and {truth.stamps[-1]} ns, "
            f"found them between {estimate.stamps[0]} and {estimate.stamps[-1]} ns"
        )
    kept = estimate.take(known)
    return truth.at(kept.stamps), kept
