"""Folders as runs leave them: a random walk, noisy estimates of it, small images and clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from events import PoseEstimate
from nodes.judging.evaluation.files import write_results
from nodes.judging.evaluation.judging import Judgement, judge
from nodes.judging.evaluation.record import EstimatorRecord
from nodes.judging.evaluation.thresholds import Thresholds
from nodes.trajectory import Trajectory
from nodes.trajectory_files import write_tum
from runtime.source_files import source_file

SECOND = 1_000_000_000


def walk(seconds: float, seed: int = 1) -> Trajectory:
    """A smooth random flight at 200 Hz, about 1 m/s."""
    random = np.random.default_rng(seed)
    n = round(seconds * 200) + 1
    kernel = np.hanning(400) / np.hanning(400).sum()
    pace = np.stack(
        [np.convolve(random.normal(0, s, n + 399), kernel, "valid") for s in (14, 14, 2)], axis=1
    )
    positions = np.cumsum(pace, axis=0) / 200 + [0.0, 0.0, -1.5]
    yaw = np.cumsum(np.convolve(random.normal(0, 4, n + 399), kernel, "valid")) / 200
    turns = Rotation.from_euler("z", yaw[:, None]).as_quat(scalar_first=True)
    return Trajectory(np.arange(n) * (SECOND // 200), positions, turns)


def recorded(
    truth: Trajectory,
    *,
    noise: float = 0.002,
    rate: int = 30,
    latency: float = 0.08,
    silent: tuple[float, float] = (0.0, 0.0),
    source: str = "vo",
    seed: int = 2,
    **said: Any,
) -> EstimatorRecord:
    """What an estimator that drifts says of a flight; nothing in an interval (s)."""
    random = np.random.default_rng(seed)
    stamps = np.arange(0, truth.stamps[-1], SECOND // rate)
    there = truth.at(stamps)
    drift = np.cumsum(random.normal(0, noise, (len(stamps), 3)), axis=0)
    turns = Rotation.from_rotvec(np.cumsum(random.normal(0, noise / 5, (len(stamps), 3)), axis=0))
    poses = zip(
        stamps.tolist(),
        (there.positions + drift).tolist(),
        (turns * there.rotations()).as_quat(scalar_first=True).tolist(),
        random.gamma(4.0, latency / 4, len(stamps)).tolist(),
        strict=True,
    )
    record = EstimatorRecord(False, "noise on the truth")
    for stamp, (x, y, z), (qw, qx, qy, qz), late in poses:
        if silent[0] <= stamp / SECOND < silent[1]:
            continue
        event = PoseEstimate(
            stamp=stamp,
            source=source,
            frame_id="odom",
            position=(x, y, z),
            orientation=(qw, qx, qy, qz),
            **said,
        )
        if stamp + round(late * SECOND) <= truth.stamps[-1]:
            record.add(event, stamp + round(late * SECOND))
    return record


def evaluated(
    out: Path,
    truth: Trajectory,
    records: dict[str, EstimatorRecord],
    thresholds: Thresholds,
    plan: Trajectory | None = None,
) -> dict[str, Any]:
    """Write what an evaluation writes; return the verdict."""
    judgements: dict[str, Judgement] = {name: judge(r, truth) for name, r in records.items()}
    figures = {
        name: {
            "passed": not (failed := thresholds.missed(j.figures)),
            **j.figures,
            "failed": failed,
        }
        for name, j in judgements.items()
    }
    verdict = {
        "passed": all(f["passed"] for f in figures.values()),
        "estimators": figures,
        "thresholds": msgspec.to_builtins(thresholds),
    }
    (out / "trajectories").mkdir(exist_ok=True)
    write_tum(out / "trajectories" / "truth.tum", truth)
    for name, judgement in judgements.items():
        if judgement.estimate is not None:
            write_tum(out / "trajectories" / f"{source_file(name)}.tum", judgement.estimate)
    write_results(out, {"plan": plan}, judgements, verdict)
    return verdict


def summary(out: Path, verdict: dict[str, Any] | None = None, **changes: Any) -> None:
    """Write a summary as a run does."""
    content = {
        "name": "sample",
        "clock": "lockstep",
        "seed": 7,
        "reason": "tour: tour flown",
        "error": None,
        "sim_seconds": 20.0,
        "wall_seconds": 4.0,
        "digest": "0123456789abcdef",
        "not_deterministic": [],
        "verdict": verdict and {k: verdict[k] for k in ("passed", "estimators")},
        "events": {"Odometry": 4001},
        "outputs": {"drone.odometry": 4001},
        "drops": {"vo.frames": 3},
        "streams": {
            "vo.frames": {"bound": 2, "peak": 2, "dropped": 3, "missed": {"depth": 5}},
        },
        "links": {"vo.frames": {"lost": 11, "thinned": 4}},
        "ticks": {
            "drone.control": {
                "hz": 400.0,
                "calls": 8000,
                "late_p50_us": 12.0,
                "late_p99_us": 80.0,
                "late_max_us": 431.0,
                "missed": 1,
            }
        },
        "workers": {
            "vo.make_tracker": {
                "latency_ms": 80.0,
                "calls": 600,
                "peak_rss_mb": 123.4,
                "processes": 1,
                "wall_p50_ms": 6.1,
                "wall_p95_ms": 9.7,
                "wall_max_ms": 131.0,
                "cpu_p50_ms": 5.9,
                "cpu_p95_ms": 8.8,
                "cpu_max_ms": 77.7,
            }
        },
        "stalls": {},
        "longest_stalls": {},
        "announcements": [],
        "environment": {"system": "Linux 6", "python": "3.11.7", "numpy": "2.4.6"},
    }
    (out / "summary.json").write_bytes(msgspec.json.encode(content | changes))


def ply(path: Path, points: np.ndarray, colors: np.ndarray | None = None) -> None:
    """Write a cloud as the maps do: x y z, and red green blue if there are colours."""
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    kinds = ["float x", "float y", "float z"]
    if colors is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
        kinds += ["uchar red", "uchar green", "uchar blue"]
    rows = np.zeros(len(points), fields)
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        if colors is not None:
            rows[name] = colors[:, k]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head = "\n".join([*lines, *(f"property {kind}" for kind in kinds), "end_header\n"])
    path.write_bytes(head.encode("ascii") + rows.tobytes())


def frame(path: Path, seed: int = 0) -> None:
    """Write a small image."""
    noise = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)
    cv2.imwrite(str(path), noise)
