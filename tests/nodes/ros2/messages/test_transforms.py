"""The tree of frames: what ``/tf`` and ``/tf_static`` say, put together as tf2 would."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np

from events import BodyAnnouncement, LidarAnnouncement, PoseEstimate, PoseStamped, TransformStamped
from events.geometry import pose_matrix
from nodes.ros2.messages.topics import FrameNames
from nodes.ros2.messages.transforms import Transform, Transforms
from tests.nodes.ros2.messages import samples


def made(*announcements: object, body: str = "truth") -> Transforms:
    transforms = Transforms(FrameNames(), "", body)
    for announcement in announcements or (samples.vehicle(), samples.camera()):
        transforms.announced(announcement)  # type: ignore[arg-type]
    return transforms


def lookup(transforms: Iterable[Transform], child: str) -> np.ndarray:
    """Return a frame in ``map``, shape (4, 4)."""
    tree = {transform.child: transform for transform in transforms}
    matrix = np.eye(4)
    while child != "map":
        step = tree[child]
        matrix = pose_matrix(step.translation, step.rotation) @ matrix
        child = step.parent
    return matrix


def test_the_chain_is_that_of_rep_105() -> None:
    tree = made()
    every = {
        transform.child: transform.parent
        for transform in tree.static() + tree.odometry(samples.odometry())
    }
    assert every == {
        "odom": "map",
        "base_link": "odom",
        "camera_link": "base_link",
        "camera_optical_frame": "camera_link",
    }


def test_a_camera_is_where_the_run_has_it() -> None:
    tree, odometry = made(), samples.odometry()
    every = tree.static() + tree.odometry(odometry)
    # Facing east at (2.5 E, 1 N, 3 up): 0.1 ahead is east, 0.2 right is south, 0.3 down.
    base = lookup(every, "base_link")
    np.testing.assert_allclose(base[:3, 3], (2.5, 1.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(base[:3, :3], np.eye(3), atol=1e-12)
    link = lookup(every, "camera_link")
    np.testing.assert_allclose(link[:3, 3], (2.6, 0.8, 2.7), atol=1e-12)
    np.testing.assert_allclose(link[:3, :3], np.eye(3), atol=1e-12)  # x ahead, z up
    optical = lookup(every, "camera_optical_frame")
    np.testing.assert_allclose(optical[:3, 2], (1, 0, 0), atol=1e-12)  # looks east
    np.testing.assert_allclose(optical[:3, 1], (0, 0, -1), atol=1e-12)  # its y is down


def test_odom_is_where_the_vehicle_started() -> None:
    odom = lookup(made().static(), "odom")
    np.testing.assert_allclose(odom[:3, 3], (2.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(odom[:3, 0], (1, 0, 0), atol=1e-12)  # facing east


def test_an_estimate_may_place_the_body_instead_of_the_truth() -> None:
    tree = made(body="vo")
    assert tree.odometry(samples.odometry()) == []
    in_odom = PoseEstimate(
        stamp=1, source="vo", position=(3.0, 1.0, -2.0), orientation=(1.0, 0.0, 0.0, 0.0)
    )
    # Ahead is east, right is south, of a start at (2 E, 1 N).
    base = lookup(tree.static() + tree.estimate(in_odom), "base_link")
    np.testing.assert_allclose(base[:3, 3], (5.0, 0.0, 2.0), atol=1e-12)
    in_map = msgspec.structs.replace(in_odom, frame_id="map", orientation=samples.EAST)
    base = lookup(tree.static() + tree.estimate(in_map), "base_link")
    np.testing.assert_allclose(base[:3, 3], (1.0, 3.0, 2.0), atol=1e-12)
    assert tree.estimate(msgspec.structs.replace(in_odom, source="other")) == []


def test_with_several_vehicles_each_has_its_name_before_its_frames() -> None:
    other = msgspec.structs.replace(samples.vehicle(), source="other", position=(9.0, 0.0, 0.0))
    tree = made(samples.vehicle(), samples.camera(), other, samples.camera("other/camera"))
    moved = msgspec.structs.replace(samples.odometry(), source="other", position=(9.0, 0.0, -5.0))
    every = tree.static() + tree.odometry(samples.odometry()) + tree.odometry(moved)
    assert {transform.child: transform.parent for transform in every} == {
        f"{name}/{child}": parent if parent == "map" else f"{name}/{parent}"
        for name in ("drone", "other")
        for child, parent in {
            "odom": "map",
            "base_link": "odom",
            "camera_link": "base_link",
            "camera_optical_frame": "camera_link",
        }.items()
    }
    np.testing.assert_allclose(lookup(every, "drone/base_link")[:3, 3], (2.5, 1, 3), atol=1e-12)
    np.testing.assert_allclose(lookup(every, "other/base_link")[:3, 3], (0, 9, 5), atol=1e-12)
    np.testing.assert_allclose(lookup(every, "other/camera_link")[:3, 3], (0.1, 8.8, 4.7))


def test_an_estimate_places_its_own_vehicle_and_the_truth_the_others() -> None:
    other = msgspec.structs.replace(samples.vehicle(), source="other")
    tree = made(samples.vehicle(), other, body="other/vo")
    moved = msgspec.structs.replace(samples.odometry(), source="other")
    assert [transform.child for transform in tree.odometry(samples.odometry())] == [
        "drone/base_link"
    ]
    assert tree.odometry(moved) == []
    estimate = PoseEstimate(
        stamp=1, source="other/vo", position=(0.0, 0.0, 0.0), orientation=(1.0, 0.0, 0.0, 0.0)
    )
    (placed,) = tree.estimate(estimate)
    assert (placed.parent, placed.child) == ("other/odom", "other/base_link")


def test_a_vehicle_that_is_chosen_is_alone() -> None:
    other = msgspec.structs.replace(samples.vehicle(), source="other")
    tree = Transforms(FrameNames(), "other", "truth")
    tree.announced(samples.vehicle())
    tree.announced(other)
    assert [transform.child for transform in tree.static()] == ["odom"]
    assert tree.odometry(samples.odometry()) == []
    moved = msgspec.structs.replace(samples.odometry(), source="other")
    assert [transform.child for transform in tree.odometry(moved)] == ["base_link"]


def test_two_cameras_of_one_name_have_frames_of_their_own() -> None:
    tree = made(samples.camera(), samples.camera("second/camera"))
    assert {transform.child for transform in tree.static()} == {
        "camera_link",
        "camera_optical_frame",
        "second_camera_link",
        "second_camera_optical_frame",
    }


def test_a_free_camera_moves_in_the_map() -> None:
    tree = made(samples.camera("eye", "map"))
    pose = PoseStamped(
        stamp=1, source="eye", position=(1.0, 2.0, -3.0), orientation=(0.5, 0.5, 0.5, 0.5)
    )
    every = tree.static() + tree.pose(pose)
    np.testing.assert_allclose(lookup(every, "eye_link")[:3, 3], (2, 1, 3))
    optical = lookup(every, "eye_optical_frame")
    np.testing.assert_allclose(optical[:3, 2], (0, 1, 0), atol=1e-12)  # looks north


def lidar(source: str) -> LidarAnnouncement:
    return LidarAnnouncement(
        stamp=0,
        source=source,
        rate=10.0,
        frame_id=source,
        position=(0.1, 0.2, -0.3),
        channels=16,
        columns=1024,
        horizontal_fov=6.28,
        elevations=(-0.3, 0.3),
        noise=0.0,
        min_range=0.1,
        max_range=50.0,
    )


def test_a_free_camera_s_body_is_placed_beside_a_vehicle() -> None:
    tree = made()
    corner = msgspec.structs.replace(samples.odometry(), source="corner", child_frame_id="corner")
    every = tree.static() + tree.odometry(samples.odometry()) + tree.odometry(corner)
    np.testing.assert_allclose(lookup(every, "corner"), lookup(every, "base_link"), atol=1e-12)
    assert not tree.odometry(msgspec.structs.replace(corner, child_frame_id="base_link"))
    only = Transforms(FrameNames(), "drone", "truth")
    only.announced(samples.vehicle())
    assert not only.odometry(corner)


def test_an_imu_is_where_it_is_mounted() -> None:
    imu = msgspec.structs.replace(samples.imu(), frame_id="imu", position=(0.1, 0.2, -0.3))
    tree = made(samples.vehicle(), imu)
    every = tree.static() + tree.odometry(samples.odometry())
    np.testing.assert_allclose(lookup(every, "imu")[:3, 3], (2.6, 0.8, 3.3), atol=1e-12)
    assert not any(transform.child == "base_link" for transform in made(samples.imu()).static())


def test_a_sensor_is_where_it_is_mounted() -> None:
    tree = made(samples.vehicle(), lidar("drone/lidar"))
    every = tree.static() + tree.odometry(samples.odometry())
    assert {"odom", "base_link", "lidar"} == {transform.child for transform in every}
    np.testing.assert_allclose(lookup(every, "lidar")[:3, 3], (2.6, 0.8, 3.3), atol=1e-12)
    twice = TransformStamped(
        stamp=0,
        source="drone",
        frame_id="base_link",
        child_frame_id="drone/lidar",
        translation=(0.0, 0.0, 0.0),
        rotation=(1.0, 0.0, 0.0, 0.0),
        static=True,
    )
    assert not tree.add_static(twice)
    other = msgspec.structs.replace(samples.vehicle(), source="other")
    tree = made(lidar("drone/lidar"), samples.vehicle(), other, lidar("other/lidar"))
    assert {
        transform.child: transform.parent
        for transform in tree.static()
        if "lidar" in transform.child
    } == {
        "drone/lidar": "drone/base_link",
        "other/lidar": "other/base_link",
    }


def test_a_body_that_moves_by_itself_has_a_frame_in_the_map() -> None:
    body = BodyAnnouncement(stamp=0, source="world/person", kind="person", object_ids=(3,))
    tree = made(samples.vehicle(), body)
    pose = PoseStamped(
        stamp=1, source="world/person", position=(1.0, 2.0, -3.0), orientation=samples.EAST
    )
    (transform,) = tree.pose(pose)
    assert (transform.parent, transform.child) == ("map", "world/person")
    assert transform.translation == (2.0, 1.0, 3.0)
    np.testing.assert_allclose(transform.rotation, (1, 0, 0, 0), atol=1e-12)


def test_no_frame_gets_two_parents() -> None:
    tree = made()
    mounting = TransformStamped(
        stamp=0,
        source="drone",
        frame_id="base_link",
        child_frame_id="drone/camera_optical",
        translation=(0.0, 0.0, 0.0),
        rotation=(1.0, 0.0, 0.0, 0.0),
        static=True,
    )
    assert not tree.add_static(mounting)
    assert tree.add_static(msgspec.structs.replace(mounting, child_frame_id="lidar"))
    assert not tree.add_static(msgspec.structs.replace(mounting, child_frame_id="lidar"))
    children = [transform.child for transform in tree.static()]
    assert len(children) == len(set(children)) == 4
    for taken in ("base_link", "odom", "lidar", "drone/camera_optical"):
        moving = msgspec.structs.replace(mounting, static=False, child_frame_id=taken)
        assert tree.moving(moving) == []
