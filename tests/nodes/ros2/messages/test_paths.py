"""Paths: the bytes are rosbags' own, and a path stays bounded and whole."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from nodes.ros2.messages.transforms import PathMessage
from tests.nodes.ros2.messages import samples

TYPE = "nav_msgs/msg/Path"
TURN = (0.5, 0.1, -0.2, 0.7)


def read(data: bytearray) -> Any:
    return samples.store().deserialize(bytes(data), TYPE)


def walked(
    count: int, *, frame: str = "map", step: float = 0.05, length: int = 1000
) -> PathMessage:
    """Return a path of so many steps of 10 cm along x, one each second."""
    path = PathMessage(samples.store(), frame, step, length)
    for n in range(count):
        if path.far((0.1 * n, 1.0, 2.0)):
            path.add((n, 5), (0.1 * n, 1.0, 2.0), TURN)
    return path


@pytest.mark.parametrize("frame", ["m", "map", "odom", "drone/odom", "frames/of/every", "a/length"])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_path_has_the_bytes_that_rosbags_makes(frame: str, count: int) -> None:
    data = walked(count, frame=frame).message((9, 8), (9.0, 1.0, 2.0), TURN)
    message = read(data)
    assert bytes(samples.store().serialize(message)) == bytes(data)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (9, 8)
    assert {message.header.frame_id, *(p.header.frame_id for p in message.poses)} == {frame}
    assert [p.header.stamp.sec for p in message.poses] == [*range(count), 9]
    ways = [p.pose.position.x for p in message.poses]
    np.testing.assert_allclose(ways, [*(0.1 * n for n in range(count)), 9.0])
    q = message.poses[-1].pose.orientation
    assert (q.w, q.x, q.y, q.z) == TURN


def test_a_path_ends_where_the_body_is_and_says_no_place_twice() -> None:
    here = (0.3, 1.0, 2.0)
    assert (
        len(read(PathMessage(samples.store(), "map", 0.05, 10).message((1, 0), here, TURN)).poses)
        == 1
    )
    path = walked(4)
    assert not path.far((0.34, 1.0, 2.0))
    assert len(read(path.message((4, 0), (0.34, 1.0, 2.0), TURN)).poses) == 5
    assert len(read(path.message((4, 0), (0.1 * 3, 1.0, 2.0), TURN)).poses) == 4


def test_a_long_path_becomes_coarser_and_keeps_its_start() -> None:
    for count in (9, 10, 11, 40, 400):
        path = walked(count, length=10)
        poses = read(path.message((count, 0), (0.1 * count, 1.0, 2.0), TURN)).poses
        ways = np.array([p.pose.position.x for p in poses])
        assert len(poses) <= 10
        assert (ways[0], ways[-1]) == (0.0, pytest.approx(0.1 * count))
        assert (np.diff(ways) > 0).all()
        assert np.diff(ways)[:-1].max() <= 2.0 * 0.1 * count / 4
