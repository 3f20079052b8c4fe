"""Poses in bags: every type of message, chains of transforms, and names that are there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from events.frames import to_geodetic
from nodes.judging.readers import Axes, read, read_truth
from nodes.trajectory import Trajectory
from tests.nodes.judging.judge import bags
from tests.nodes.judging.judge.bags import make
from tests.nodes.trajectory.samples import angle, walk

ROS1 = get_typestore(Stores.ROS1_NOETIC)
START = 1_700_000_000_000_000_000
POSE = walk(40, start=START)
TRANSFORM, TREE = "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"
POINT, FIX = "geometry_msgs/msg/PointStamped", "sensor_msgs/msg/NavSatFix"

Message = tuple[str, str, int, Any]  # topic, type, time (ns), message


def write(path: Path, messages: Iterable[Message]) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for topic, type_, time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_, typestore=bags.STORE)
            writer.write(connections[topic], time, bags.STORE.serialize_cdr(message, type_))
    return path


def transform(stamp: int, parent: str, child: str, matrix: np.ndarray) -> Any:
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    place = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    moved = make(
        "geometry_msgs/msg/Transform",
        translation=make("geometry_msgs/msg/Vector3", **place),
        rotation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
    head = bags.header(stamp, parent)
    return make(TRANSFORM, header=head, child_frame_id=child, transform=moved)


def tree(topic: str, stamp: int, *links: tuple[str, str, np.ndarray]) -> Message:
    messages = [transform(stamp, *link) for link in links]
    return topic, TREE, stamp, make(TREE, transforms=messages)


def moving(names: tuple[str, str] = ("map", "base_link")) -> list[Message]:
    stamps, matrices = POSE.stamps.tolist(), POSE.matrices()
    return [tree("/tf", s, (*names, m)) for s, m in zip(stamps, matrices, strict=True)]


def rigid(seed: int) -> npt.NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return matrix


def assert_same(actual: Trajectory, expected: Trajectory) -> None:
    assert (actual.stamps == expected.stamps).all()
    assert actual.positions == pytest.approx(expected.positions, abs=1e-9)
    assert angle(actual, expected) < 1e-9


def test_one_link_of_the_tree(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", moving())
    source = read(f"{bag}:/tf:map.base_link")
    assert_same(source.poses, POSE)
    assert (source.name, source.frame_id) == ("map.base_link", "map")
    assert source.axes == Axes("enu", "flu")
    inverse = np.asarray(np.linalg.inv(POSE.matrices()), np.float64)
    back = Trajectory.from_matrices(POSE.stamps, inverse)
    assert_same(read(f"{bag}:/tf:base_link.map").poses, back)


def test_a_chain_is_composed_over_static_links_and_other_branches(tmp_path: Path) -> None:
    """From a camera below the body to a marker beside it: map - odom - body - camera."""
    corrections = [(POSE.stamps[0], rigid(1)), (POSE.stamps[-1], rigid(1))]
    messages = [tree("/tf", int(s), ("map", "odom", m)) for s, m in corrections]
    messages += moving(("odom", "base_link"))
    links = [("base_link", "camera_optical", rigid(2)), ("map", "marker.1", rigid(3))]
    messages += [tree("/tf_static", START, link) for link in links]
    bag = write(tmp_path / "bag", sorted(messages, key=lambda message: message[2]))
    source = read(f"{bag}:/tf:marker.1.camera_optical")
    whole = np.linalg.inv(rigid(3)) @ rigid(1) @ POSE.matrices() @ rigid(2)
    assert_same(source.poses, Trajectory.from_matrices(POSE.stamps, whole))
    assert source.axes.body == "optical"


def test_a_chain_is_read_where_all_its_links_are_known(tmp_path: Path) -> None:
    messages = [tree("/tf", int(s), ("map", "odom", rigid(1))) for s in POSE.stamps[[10, 20]]]
    messages += moving(("odom", "base_link"))
    bag = write(tmp_path / "bag", sorted(messages, key=lambda message: message[2]))
    source = read(f"{bag}:/tf:map.base_link")
    assert (source.poses.stamps == POSE.stamps[10:21]).all()
    assert source.notes == ("left out: 29 transforms at times without the others of the chain",)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("", r"expected two frames of /tf, as /tf:map.base_link, found ''; frames are a, b, base"),
        (":map.body", r"expected two frames of /tf, .* found 'map.body'; frames are a, b, base_li"),
        (
            ":map.a",
            r"expected transforms between map and a, found that a is below b and map below n",
        ),
        (":b.a", r"expected transforms that change between b and a, found fixed ones only"),
    ],
)
def test_frames_that_are_not_there_are_refused(frames: str, message: str, tmp_path: Path) -> None:
    messages = [tree("/tf_static", START - 1, ("b", "a", rigid(1))), *moving()]
    bag = write(tmp_path / "bag", messages)
    with pytest.raises(ValueError, match=message):
        read(f"{bag}:/tf{frames}")


def test_two_parents_of_a_frame_are_refused(tmp_path: Path) -> None:
    bag = write(
        tmp_path / "bag", [*moving(), tree("/tf", START + 10**10, ("a", "base_link", rigid(1)))]
    )
    with pytest.raises(ValueError, match="expected one parent of base_link, found map and a"):
        read(f"{bag}:/tf:map.base_link")


def test_a_topic_of_transforms_and_one_of_points(tmp_path: Path) -> None:
    messages: list[Message] = []
    for stamp, matrix in zip(POSE.stamps.tolist(), POSE.matrices(), strict=True):
        messages.append(("/vicon", TRANSFORM, stamp, transform(stamp, "world", "rig", matrix)))
        place = make("geometry_msgs/msg/Point", **dict(zip("xyz", matrix[:3, 3], strict=True)))
        point = make(POINT, header=bags.header(stamp, "world"), point=place)
        messages.append(("/leica", POINT, stamp, point))
    bag = write(tmp_path / "bag", messages)
    source = read(f"{bag}:/vicon")
    assert_same(source.poses, POSE)
    assert source.axes == Axes("nwu", "flu")
    source = read(f"{bag}:/leica")
    assert source.poses.positions == pytest.approx(POSE.positions)
    assert (source.positions_only, source.axes) == (True, Axes("nwu"))


def test_fixes_are_places_east_north_and_up_of_the_first(tmp_path: Path) -> None:
    origin = (47.3, 8.5, 400.0)
    messages: list[Message] = []
    for number, (stamp, (x, y, z), _) in enumerate(POSE.poses()):
        latitude, longitude, altitude = to_geodetic((y, x, -z), origin)
        status = make("sensor_msgs/msg/NavSatStatus", status=-1 if number == 5 else 0, service=1)
        fix = make(
            FIX, header=bags.header(stamp, "gps"), status=status, latitude=latitude,
            longitude=longitude, altitude=altitude, position_covariance=np.zeros(9),
            position_covariance_type=0,
        )  # fmt: skip
        messages.append(("/fix", FIX, stamp, fix))
    source = read(f"{write(tmp_path / 'bag', messages)}:/fix")
    expected = np.delete(POSE.positions - POSE.positions[0], 5, axis=0)
    assert source.poses.positions == pytest.approx(expected, abs=1e-4)  # on an ellipsoid
    assert source.axes == Axes("enu")
    assert source.notes == ("left out: 1 row without a pose",)


def test_a_topic_of_ros_1_has_no_slash(tmp_path: Path) -> None:
    """As rosbag writes it when a node names its topic so."""
    with Writer1(tmp_path / "flight.bag") as writer:
        connection = writer.add_connection("odom", bags.POSE, typestore=ROS1)
        for number, (stamp, position, orientation) in enumerate(POSE.poses()):
            time = ROS1.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            head = ROS1.types["std_msgs/msg/Header"](seq=number, stamp=time, frame_id="/world")
            pose = bags.pose(list(position), list(orientation))
            message = ROS1.types[bags.POSE](header=head, pose=pose)
            writer.write(connection, stamp, ROS1.serialize_ros1(message, bags.POSE))
    for text in ("flight.bag:odom", "flight.bag:/odom"):
        source = read(f"slam={tmp_path}/{text}")
        assert (source.name, source.frame_id) == ("slam", "world")
        assert_same(source.poses, POSE)


def test_a_folder_of_bags_is_the_bag_in_it(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", moving())
    (file,) = bag.glob("*.mcap")
    (tmp_path / "bags").mkdir()
    file.rename(tmp_path / "bags" / "one.mcap")
    assert_same(read_truth(f"{tmp_path}/bags:/tf:map.base_link").poses, POSE)
    (tmp_path / "bags" / "two.mcap").write_bytes(b"")
    with pytest.raises(ValueError, match=r"bags: expected one bag, found one.mcap, two.mcap: name"):
        read(f"{tmp_path}/bags:/tf:map.base_link")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.md").touch()
    with pytest.raises(ValueError, match=r"other: expected a trajectory, a bag or the folder of a"):
        read(str(tmp_path / "other"))


def test_covariances_of_a_topic_are_kept(tmp_path: Path) -> None:
    def change(_: int, message: Any) -> Any:
        message.pose.covariance[:] = np.diag([1.0, 2, 3, 4, 5, 6]).ravel()
        return message

    bag = bags.bag(tmp_path / "bag", bags.ODOMETRY, POSE, change=change)
    source = read(f"{bag}:/slam/poses")
    assert source.covariances is not None
    assert (source.covariances == np.diag([1.0, 2, 3, 4, 5, 6])).all()


def test_stamps_that_nobody_set_are_named(tmp_path: Path) -> None:
    from nodes.judging import judgement

    def change(_: int, message: Any) -> Any:
        message.header.stamp = bags.header(0, "").stamp
        return message

    truth = read(f"{bags.bag(tmp_path / 'truth', bags.POSE, POSE)}:/slam/poses")
    source = read(f"vo={bags.bag(tmp_path / 'bag', bags.POSE, POSE, change=change)}:/slam/poses")
    config = judgement.JudgeConfig()
    _, judgements, verdict, _ = judgement.judge_all(truth, [source], None, config)
    why = "expected stamps, found that all are zero: the sender sets none"
    assert judgements["vo"].figures["why"] == why
    assert why in verdict.estimators["vo"]["failed"]
