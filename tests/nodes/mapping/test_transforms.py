"""The tree gives what multiplying matrices gives, and says what it does not know."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from events import Odometry, Quaternion, TransformStamped, Vector3
from nodes.mapping.transforms import (
    TransformError,
    TransformTree,
    UnconnectedFramesError,
    UnknownFrameError,
    UnknownTimeError,
)

SECOND = 1_000_000_000
HERE: Vector3 = (0.0, 0.0, 0.0)
LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)

Array = npt.NDArray[np.float64]
numbers = st.floats(-20.0, 20.0)
vectors = st.tuples(numbers, numbers, numbers)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .filter(lambda q: float(np.linalg.norm(q)) > 0.1)
    .map(lambda q: tuple((np.asarray(q) / np.linalg.norm(q)).tolist()))
)


class Pose(NamedTuple):
    position: Vector3
    orientation: Quaternion

    def matrix(self) -> Array:
        """Written out apart from the code's own."""
        w, x, y, z = np.asarray(self.orientation) / np.linalg.norm(self.orientation)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), self[0][0]],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), self[0][1]],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), self[0][2]],
                [0, 0, 0, 1],
            ]
        )


STILL = Pose(HERE, LEVEL)
poses = st.builds(Pose, vectors, quaternions)


def transform(
    parent: str, child: str, pose: Pose = STILL, stamp: int = 0, static: bool = False
) -> TransformStamped:
    return TransformStamped(
        stamp=stamp,
        source="test",
        frame_id=parent,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
        static=static,
    )


@pytest.mark.slow
@given(st.lists(st.tuples(poses, st.integers(0, 100), st.booleans()), min_size=1, max_size=7))
def test_a_lookup_is_the_product_of_the_matrices(edges: list[tuple[Pose, int, bool]]) -> None:
    """Between any two frames of any tree: up from the source, and down to the target."""
    tree, known = TransformTree(), {"f0": np.eye(4)}
    for number, (pose, choice, static) in enumerate(edges, 1):
        parent = f"f{choice % number}"
        tree.add(transform(parent, f"f{number}", pose, stamp=5, static=static))
        known[f"f{number}"] = known[parent] @ pose.matrix()
    for source, here in known.items():
        for target, there in known.items():
            np.testing.assert_allclose(
                tree.lookup(target, source, 5), np.linalg.inv(there) @ here, atol=1e-9
            )


@given(poses, poses, st.integers(1, 10 * SECOND - 1))
def test_between_two_stamps_it_interpolates(first: Pose, last: Pose, stamp: int) -> None:
    """Positions linearly, orientations as scipy's own slerp does."""
    tree = TransformTree()
    tree.add(transform("map", "body", last, 10 * SECOND))
    tree.add(transform("map", "body", first, 0))  # in any order
    share = stamp / (10 * SECOND)
    turns = Rotation.from_matrix([first.matrix()[:3, :3], last.matrix()[:3, :3]])
    expected = np.eye(4)
    expected[:3, :3] = Slerp([0.0, 1.0], turns)(share).as_matrix()
    expected[:3, 3] = (1 - share) * np.array(first.position) + share * np.array(last.position)
    found = tree.lookup("map", "body", stamp)
    half_turn = abs((turns[0].inv() * turns[1]).magnitude() - np.pi) < 1e-3
    if half_turn:  # either way round is as short
        found[:3, :3] = expected[:3, :3]
    np.testing.assert_allclose(found, expected, atol=1e-9)


@settings(max_examples=30)
@given(st.lists(poses, min_size=2, max_size=5), st.data())
def test_at_a_known_stamp_it_is_that_pose(row: list[Pose], data: st.DataObject) -> None:
    """To the bit, whatever stands beside it and in whichever order they came."""
    tree = TransformTree()
    order = data.draw(st.permutations(range(len(row))))
    for place in order:
        tree.add(transform("map", "body", row[place], place * 7))
    alone = TransformTree()
    for place, pose in enumerate(row):
        alone.add(transform("map", "body", pose, 0))
        np.testing.assert_array_equal(
            tree.lookup("map", "body", place * 7), alone.lookup("map", "body", 0)
        )
        np.testing.assert_allclose(tree.lookup("map", "body", place * 7), pose.matrix(), atol=1e-9)


def test_interpolation_takes_the_shorter_way() -> None:
    """A quaternion and its negative are one rotation."""
    tree = TransformTree()
    tree.add(transform("map", "body", Pose(HERE, (1.0, 0.0, 0.0, 0.0)), 0))
    tree.add(transform("map", "body", Pose(HERE, (-(0.5**0.5), 0.0, 0.0, -(0.5**0.5))), 10))
    yaw = Rotation.from_matrix(tree.lookup("map", "body", 5)[:3, :3]).as_euler("ZYX")[0]
    assert yaw == pytest.approx(np.pi / 4)


def test_fixed_transforms_hold_for_all_times() -> None:
    tree = TransformTree()
    pose = Pose((0.15, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5))
    tree.add(transform("body", "camera", pose, stamp=3, static=True))
    for stamp in (-5, 0, 10**18):
        np.testing.assert_allclose(tree.lookup("body", "camera", stamp), pose.matrix())
    assert tree.span("camera") is None


def test_events_of_all_kinds_become_transforms() -> None:
    """Odometry and poses are the child's pose in the parent."""
    tree = TransformTree()
    tree.add_odometry(
        Odometry(
            stamp=7,
            source="drone",
            position=(1.0, 2.0, 3.0),
            orientation=LEVEL,
            linear_velocity=HERE,
            angular_velocity=HERE,
        )
    )
    turned = Pose((0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 1.0))
    tree.add(
        TransformStamped(
            stamp=7,
            source="x",
            frame_id="map",
            child_frame_id="thing",
            translation=turned.position,
            rotation=turned.orientation,
        )
    )
    np.testing.assert_allclose(tree.lookup("map", "base_link", 7)[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(tree.lookup("thing", "base_link", 7)[:3, 3], [-1, -2, 4], atol=1e-12)


def test_only_the_links_between_two_frames_need_to_know_the_time() -> None:
    """What lies above both is not asked."""
    tree = TransformTree()
    tree.add(transform("map", "body", stamp=0))
    tree.add(transform("body", "left", static=True))
    tree.add(transform("body", "right", static=True))
    np.testing.assert_array_equal(tree.lookup("left", "right", 99), np.eye(4))
    with pytest.raises(UnknownTimeError):
        tree.lookup("map", "right", 99)


def test_history_is_bounded() -> None:
    """By time, back from the newest; what comes later and is older still is let go at once."""
    tree = TransformTree(history=2.0)
    for k in range(500):
        tree.add(transform("map", "body", stamp=k * SECOND // 100))
    newest = 499 * SECOND // 100
    assert tree.span("body") == (newest - 2 * SECOND, newest)
    tree.add(transform("map", "body", stamp=SECOND))
    assert tree.span("body") == (newest - 2 * SECOND, newest)
    assert len(tree._edges["body"].poses) == 201


def test_times_outside_the_history_are_refused_with_its_span() -> None:
    tree = TransformTree()
    tree.add(transform("map", "body", stamp=SECOND))
    tree.add(transform("map", "body", stamp=2 * SECOND))
    for stamp, text in ((SECOND - 1, "0.999999999 s"), (2 * SECOND + 1, "2.000000001 s")):
        said = f"map → body: expected a stamp from 1.000000000 s to 2.000000000 s, found {text}"
        with pytest.raises(UnknownTimeError, match=said):
            tree.lookup("map", "body", stamp)


def test_frames_that_are_unknown_or_apart_are_named() -> None:
    tree = TransformTree()
    with pytest.raises(UnknownFrameError, match=r"known frames \(none\), found 'body'"):
        tree.lookup("map", "body", 0)
    tree.add(transform("map", "body"))
    tree.add(transform("odom", "other"))
    with pytest.raises(UnknownFrameError, match=r"\(map, body, odom, other\), found 'bod'"):
        tree.lookup("map", "bod", 0)
    with pytest.raises(UnconnectedFramesError, match="found other under odom and map under map"):
        tree.lookup("map", "other", 0)
    with pytest.raises(UnknownFrameError, match="a frame with a parent, found 'map'"):
        tree.span("map")
    assert issubclass(TransformError, LookupError)


def test_what_is_no_tree_is_refused() -> None:
    """A second parent, a loop, a frame in itself, and a fixed frame that moves."""
    tree = TransformTree()
    tree.add(transform("map", "body"))
    tree.add(transform("body", "camera", static=True))
    for wrong, message in (
        (transform("odom", "body"), "odom → body: expected one parent .* body is in map"),
        (transform("camera", "map"), "camera → map: expected a tree, but map is above camera"),
        (transform("x", "x"), "x → x: expected a tree"),
        (transform("body", "camera"), "body → camera: expected a static transform as before"),
        (transform("map", "body", static=True), "expected a moving transform as before"),
    ):
        with pytest.raises(ValueError, match=message):
            tree.add(wrong)
    np.testing.assert_array_equal(tree.lookup("map", "camera", 0), np.eye(4))
    with pytest.raises(UnknownFrameError):
        tree.lookup("map", "x", 0)


def test_a_history_below_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="history: expected 0 s or more, found -1"):
        TransformTree(history=-1.0)
