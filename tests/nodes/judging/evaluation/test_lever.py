"""A camera beside the body's origin, whose poses are in a unit of their own."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events import (
    CameraAnnouncement,
    CameraInfo,
    EstimatorAnnouncement,
    Event,
    TrackedFeatures,
    TrajectoryEstimate,
)
from events.geometry import pose_matrix
from nodes.estimators import Mount, TrackingResult
from nodes.judging import judgement
from nodes.judging.evaluation import Evaluation
from nodes.judging.readers import read, read_truth
from nodes.trajectory_files import read_tum
from runtime.testing import run_nodes, spec
from tests.nodes.judging.evaluation.flights import MS, SECOND, announced, place
from tests.nodes.judging.evaluation.flights import truth as level

FRAMES = range(0, 10 * SECOND + 1, 100 * MS)
UNIT = 4.0  # metres of an estimator's unit of length
LEVER = (0.3, -0.1, 0.05)


def attitude(stamp: int) -> tuple[float, float, float, float]:
    """Return an orientation that turns otherwise than the path, which would hide the lever."""
    angles = 40.0 * np.sin(np.array([0.9, 1.3, 0.7]) * stamp / SECOND)
    w, x, y, z = Rotation.from_euler("xyz", angles, degrees=True).as_quat(scalar_first=True)
    return float(w), float(x), float(y), float(z)


@cache
def truth(duration: float) -> list[Event]:
    return [
        msgspec.structs.replace(event, orientation=attitude(event.stamp))
        for event in level(duration)
    ]


def camera() -> CameraAnnouncement:
    turn = Rotation.from_euler("xyz", [85, 5, 80], degrees=True).as_quat(scalar_first=True)
    return CameraAnnouncement(
        stamp=0,
        source="drone/eye",
        frame_id="drone/eye_optical",
        parent_frame_id="drone/base_link",
        position=LEVER,
        orientation=tuple(turn.tolist()),
        images=("grey",),
        info=CameraInfo.from_fov(64, 48, 1.5),
        rate=10.0,
        latency=0.0,
    )


def as_sent(
    reads: tuple[str, ...], shift: float = 0.0, turn: float = 0.0
) -> tuple[list[Event], list[Event]]:
    """Return announcements, and what an estimator sends that knows the camera's poses.

    Args:
        shift: Standard deviation of the camera's position, metres; with a covariance, if above 0.
        turn: The same of its orientation, radians.
    """
    eye = camera()
    on_body = pose_matrix(eye.position, eye.orientation)
    seen = np.array([pose_matrix(place(s), attitude(s)) @ on_body for s in FRAMES])
    start, covariance = np.linalg.inv(seen[0]), None
    if shift:
        random = np.random.default_rng(1)
        seen[:, :3, 3] += random.normal(0.0, shift, (len(seen), 3))
        turns = Rotation.from_rotvec(random.normal(0.0, turn, (len(seen), 3)))
        seen[:, :3, :3] = turns.as_matrix() @ seen[:, :3, :3]
        covariance = np.diag([(shift / UNIT) ** 2] * 3 + [turn**2] * 3)
    poses = start @ seen
    poses[:, :3, 3] /= UNIT
    mount = Mount.of(eye, None)
    sent: list[Event] = [
        mount.estimate(s, "est", TrackingResult(pose=pose, covariance=covariance))
        for s, pose in zip(FRAMES, poses, strict=True)
    ]
    last = mount.trajectory(10 * SECOND, "est", np.array(FRAMES), poses)
    assert isinstance(last, TrajectoryEstimate)
    vehicle = announced()[0]
    said = EstimatorAnnouncement(
        stamp=0,
        source="est",
        method="test",
        scale_free=True,
        reads=reads,
        cameras=("drone/eye",),
    )
    return [vehicle, eye, said], [*sent, last]


def judged(out: Path, *groups: list[Event]) -> dict[str, Any]:
    script = sorted((e for group in groups for e in group), key=lambda e: e.stamp)
    run_nodes([spec(Evaluation, "evaluation", {})], inputs=script, duration=11.0, out=out)
    verdict = json.loads((out / "evaluation" / "verdict.json").read_text())
    figures: dict[str, Any] = verdict["estimators"]["est"]
    return figures


@pytest.mark.parametrize("kind", ["grey", "rgb"])
def test_a_unit_of_its_own_is_judged_at_the_camera(tmp_path: Path, kind: str) -> None:
    said, sent = as_sent((kind,))
    figures = judged(tmp_path, said, truth(10), sent)
    assert figures["alignment"] == "sim3"
    assert figures["scale"] == pytest.approx(UNIT, rel=1e-6)
    assert figures["ate_rmse_m"] < 1e-5
    assert figures["final_ate_rmse_m"] < 1e-5


def test_of_several_cameras_it_is_that_of_the_features(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    other = msgspec.structs.replace(
        camera(), source="drone/other", frame_id="drone/other_optical", position=(-1.0, 0.0, 0.0)
    )
    said[-1] = msgspec.structs.replace(said[-1], cameras=("drone/other", "drone/eye"))
    features = TrackedFeatures(
        stamp=0,
        source="est",
        frame_id="drone/eye_optical",
        points=np.empty((0, 2), np.float32),
        inliers=np.empty(0, np.bool_),
    )
    figures = judged(tmp_path, [*said, other], truth(10), [features, *sent])
    assert figures["ate_rmse_m"] < 1e-5


def test_a_covariance_is_held_against_the_error_of_the_camera(tmp_path: Path) -> None:
    """The turn of a radian would move a body by as many metres as the lever has."""
    said, sent = as_sent(("grey",), shift=0.05, turn=0.1)
    figures = judged(tmp_path, said, truth(10), sent)
    assert figures["nees_position"] == pytest.approx(3.0, abs=0.8)
    assert figures["nees_pose"] == pytest.approx(6.0, abs=1.2)


def test_what_is_written_is_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    judged(tmp_path, said, truth(10), sent)
    for kind in ("aligned", "final"):
        body = read_tum(tmp_path / "evaluation" / f"est.{kind}.tum")
        there = np.array([place(int(stamp)) for stamp in body.stamps])
        assert abs(body.positions - there).max() < 1e-5


def test_a_file_of_the_run_is_judged_as_in_the_run(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    assert judged(tmp_path, said, truth(10), sent)["compared_at"] == "drone/eye"
    announcements = [{"type": "CameraAnnouncement", **msgspec.to_builtins(said[1])}]
    (tmp_path / "summary.json").write_text(json.dumps({"announcements": announcements}))
    folder = tmp_path / "trajectories"
    source, true = read(str(folder / "est.tum")), read_truth(str(folder / "truth.tum"))
    config = judgement.JudgeConfig(scale_free=True)
    _, judgements, _, _ = judgement.judge_all(true, [source], None, config)
    assert judgements["est"].figures["ate_rmse_m"] < 1e-5


def test_who_does_not_say_what_it_reads_is_judged_as_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(())  # such as a bridge: nobody knows what its poses are those of
    assert judged(tmp_path, said, truth(10), sent)["ate_rmse_m"] > 0.05


def test_at_the_origin_of_the_body_nothing_is_said(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    said[1] = msgspec.structs.replace(said[1], position=(0.0, 0.0, 0.0))
    assert "compared_at" not in judged(tmp_path, said, truth(10), sent)


def test_metres_are_judged_at_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    said[-1] = msgspec.structs.replace(said[-1], scale_free=False)
    figures = judged(tmp_path, said, truth(10), sent)
    assert figures["alignment"] == "origin"
    assert figures["scale"] != pytest.approx(UNIT, rel=1e-3)
