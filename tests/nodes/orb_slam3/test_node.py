"""The node around ORB-SLAM3: what each mode asks for, and what it says of what is missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from events import EstimatorAnnouncement, Event
from nodes.orb_slam3 import OrbSlam3
from runtime.errors import NodeError, RefusedError
from runtime.testing import run_nodes, spec
from tests.nodes.estimation.test_estimator import camera


def announced(mode: str) -> EstimatorAnnouncement:
    """Start a node that ends at once, for want of a vocabulary, and return what it announced."""
    from runtime.node import make_node
    from tests.runtime.small_events import NoHost

    node = make_node(OrbSlam3, "slam", spec(OrbSlam3, "slam", {"mode": mode}).config, NoHost())
    [announcement] = node.announce()
    assert isinstance(announcement, EstimatorAnnouncement)
    return announcement


def run(*events: Event, **config: object) -> None:
    run_nodes([spec(OrbSlam3, "slam", config)], inputs=events, duration=1.0)


@pytest.mark.parametrize(
    ("mode", "scale_free"),
    [
        ("rgbd", False),
        ("monocular", True),
        ("rgbd_inertial", False),
        ("monocular_inertial", False),
    ],
)
def test_only_a_single_camera_alone_has_no_scale(mode: str, scale_free: bool) -> None:
    assert announced(mode).scale_free is scale_free


def test_a_missing_vocabulary_is_an_error_with_the_command_that_makes_one(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.txt")
    with pytest.raises(NodeError, match=r"python -m runtime vocabulary config\.toml"):
        run(camera("drone/front", "rgb", "depth"), vocabulary=missing)


def test_a_file_in_another_format_is_refused_before_anything_starts(tmp_path: Path) -> None:
    """ORB-SLAM3 would end its process, or read nonsense."""
    other = tmp_path / "other.txt"
    other.write_text("no vocabulary\n")
    with pytest.raises(NodeError, match=r"other\.txt: line 1: expected four whole numbers"):
        run(camera("drone/front", "rgb", "depth"), vocabulary=str(other))


def test_depth_is_asked_for_in_the_modes_that_use_it(tmp_path: Path) -> None:
    missing = str(tmp_path / "none.txt")
    with pytest.raises(NodeError, match="expected a camera with depth, grey images"):
        run(camera("drone/front", "rgb"), mode="rgbd", vocabulary=missing)
    with pytest.raises(NodeError, match="vocabulary"):  # it came that far
        run(camera("drone/front", "rgb"), mode="monocular", vocabulary=missing)


def test_a_named_camera_without_depth_is_refused() -> None:
    node = spec(OrbSlam3, "slam", inputs={"frames": "drone/front"})
    with pytest.raises(RefusedError, match="found none with depth"):
        run_nodes([node], inputs=[camera("drone/front", "rgb")], duration=1.0)


def test_its_runs_do_not_promise_their_digest() -> None:
    assert OrbSlam3.deterministic is False
