"""A camera beside the body's origin, whose poses are in a unit of their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from events import CameraAnnouncement, CameraInfo, EstimatorAnnouncement, Event, TrajectoryEstimate
from events.geometry import pose_matrix
from nodes.estimators import Mount, TrackingResult
from nodes.judging.evaluation import Evaluation
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


def as_sent(reads: tuple[str, ...]) -> tuple[list[Event], list[Event]]:
    """Return announcements, and what an estimator sends that knows the camera's poses exactly."""
    eye = camera()
    on_body = pose_matrix(eye.position, eye.orientation)
    seen = np.array([pose_matrix(place(s), attitude(s)) @ on_body for s in FRAMES])
    poses = np.linalg.inv(seen[0]) @ seen
    poses[:, :3, 3] /= UNIT
    mount = Mount.of(eye, None)
    sent: list[Event] = [
        mount.estimate(s, "est", TrackingResult(pose=pose))
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


def test_a_unit_of_its_own_is_judged_at_the_camera(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    figures = judged(tmp_path, said, truth(10), sent)
    assert figures["alignment"] == "sim3"
    assert figures["scale"] == pytest.approx(UNIT, rel=1e-6)
    assert figures["ate_rmse_m"] < 1e-5
    assert figures["final_ate_rmse_m"] < 1e-5


def test_what_is_written_is_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    judged(tmp_path, said, truth(10), sent)
    for kind in ("aligned", "final"):
        body = read_tum(tmp_path / "evaluation" / f"est.{kind}.tum")
        there = np.array([place(int(stamp)) for stamp in body.stamps])
        assert abs(body.positions - there).max() < 1e-5


def test_who_does_not_say_what_it_reads_is_judged_as_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(())  # such as a bridge: nobody knows what its poses are those of
    assert judged(tmp_path, said, truth(10), sent)["ate_rmse_m"] > 0.05


def test_metres_are_judged_at_the_body(tmp_path: Path) -> None:
    said, sent = as_sent(("grey",))
    said[-1] = msgspec.structs.replace(said[-1], scale_free=False)
    figures = judged(tmp_path, said, truth(10), sent)
    assert figures["alignment"] == "origin"
    assert figures["scale"] != pytest.approx(UNIT, rel=1e-3)
