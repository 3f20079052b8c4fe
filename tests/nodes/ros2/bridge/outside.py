"""A stub of an estimator in ROS 2, which answers images as it is told to, well or badly.

In this process, as `Outside`; or in one of its own:

    python -m tests.nodes.ros2.bridge.outside LOCATOR BEHAVIOUR
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from nodes.ros2.bridge.keys import Message, NodeName
from nodes.ros2.bridge.session import Session
from nodes.ros2.messages.topics import Qos, Topic
from tests.nodes.ros2.messages import samples

IMAGES, POSES, DONE = "/drone/camera/image_raw", "/slam/pose", "/slam/done"
TYPES = {
    IMAGES: "sensor_msgs/msg/Image",
    "/drone/camera/depth/image_raw": "sensor_msgs/msg/Image",
    "/drone/imu": "sensor_msgs/msg/Imu",
    "/clock": "rosgraph_msgs/msg/Clock",
    POSES: "geometry_msgs/msg/PoseStamped",
    DONE: "std_msgs/msg/Header",
}


def topic(name: str) -> Topic:
    return Topic(name=name, type=TYPES[name], hash=samples.store().hash(TYPES[name]), qos=Qos())


class Outside:
    """A stub that says a pose for each image, which depends on the image.

    Args:
        behaviour: Which of `BEHAVIOURS`.
        endpoints: ``connect`` or ``listen``, each an endpoint.
    """

    def __init__(self, behaviour: str, **endpoints: str) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.images = 0
        self.kept: list[tuple[int, float]] = []
        self._endpoints: dict[str, Any] = {way: (at,) for way, at in endpoints.items()}
        self._endpoints = {"connect": (), "listen": ()} | self._endpoints
        self._behave = BEHAVIOURS[behaviour]
        self.join()

    def join(self) -> None:
        self.session = Session(NodeName(name="slam"), **self._endpoints)
        heard = [name for name in TYPES if name not in {POSES, DONE}]
        takes = [(topic(name), lambda m, n=name: self._take(n, m)) for name in heard]
        self.session.subscribe_in_order(takes)
        self._poses = self.session.publisher(topic(POSES), held=True)
        self._rival = self.session.publisher(topic(POSES), held=True)
        self._done = self.session.publisher(topic(DONE), held=True)

    def leave(self) -> None:
        self.session.close()

    def pose(self, stamp: int, x: float) -> None:
        message = samples.store().zero(TYPES[POSES])
        message.header = samples.store().header(divmod(stamp, 10**9), "odom")
        message.pose.position.x, message.pose.orientation.w = x, 1.0
        self._poses.put(samples.store().serialize(message))

    def done(self, stamp: int) -> None:
        header = samples.store().header(divmod(stamp, 10**9), "")
        self._done.put(samples.store().serialize(header))

    def garbage(self) -> None:
        self._poses.put(bytearray(b"garbage"))

    def lose(self) -> None:
        """Leave out a number, as if a message were lost on the way."""
        self._poses.sent += 1

    def _take(self, name: str, message: Message) -> None:
        data = message.read()
        self.heard.append((name, data))
        if name == IMAGES:
            image: Any = samples.store().deserialize(data, TYPES[IMAGES])
            stamp = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
            self.images += 1
            self._behave(self, stamp, float(image.data.mean()))


def at_once(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp, x)


def slowly(stub: Outside, stamp: int, x: float) -> None:
    time.sleep(0.02)  # a slow machine
    stub.pose(stamp, x)


def out_of_order(stub: Outside, stamp: int, x: float) -> None:
    stub.kept.append((stamp, x))
    if len(stub.kept) == 2:
        for answer in reversed(stub.kept):
            stub.pose(*answer)
        stub.kept.clear()


def twice(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp, x)
    stub.pose(stamp, x + 1.0)


def in_turns(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp, x)
    stub._poses, stub._rival = stub._rival, stub._poses


def through_a_double(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp + (-1) ** (stub.images + 1) * 300, x)


def stamps_of_the_future(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp + 3600 * 10**9, x)
    stub.pose(stamp, x)


def floods(stub: Outside, stamp: int, x: float) -> None:
    for n in range(300):
        stub.pose(stamp - 10**9 - n, x)
        stub.garbage()
    stub.pose(stamp, x)


def not_a_number(stub: Outside, stamp: int, x: float) -> None:
    stub.pose(stamp, x if stub.images % 3 != 2 else float("nan"))


def skips(stub: Outside, stamp: int, x: float) -> None:
    if stub.images % 3 != 2:
        stub.pose(stamp, x)


def says_done(stub: Outside, stamp: int, x: float) -> None:
    if stub.images % 3 != 2:
        stub.pose(stamp, x)
    stub.done(stamp)


def initialises(stub: Outside, stamp: int, x: float) -> None:
    if stub.images > 5:
        stub.pose(stamp, x)


def stops(stub: Outside, stamp: int, x: float) -> None:
    if stub.images <= 5:
        stub.pose(stamp, x)


def loses_one(stub: Outside, stamp: int, x: float) -> None:
    if stub.images == 5:
        stub.lose()
    stub.pose(stamp, x)


def dies(stub: Outside, stamp: int, x: float) -> None:
    if stub.images == 5:
        threading.Thread(target=stub.leave).start()  # not in the thread that it ends
    elif stub.images < 5:
        stub.pose(stamp, x)


def comes_back(stub: Outside, stamp: int, x: float) -> None:
    def again() -> None:
        stub.leave()
        stub.join()

    if stub.images == 5:
        threading.Thread(target=again).start()
    else:
        stub.pose(stamp, x)


BEHAVIOURS: dict[str, Callable[[Outside, int, float], None]] = {
    behaviour.__name__: behaviour
    for behaviour in (
        *(
            at_once,
            in_turns,
            slowly,
            out_of_order,
            twice,
            through_a_double,
            stamps_of_the_future,
            floods,
        ),
        *(not_a_number, skips, says_done, initialises, stops, loses_one, dies, comes_back),
    )
}


def main() -> None:
    Outside(sys.argv[2], connect=sys.argv[1])
    time.sleep(120)  # to be killed before


if __name__ == "__main__":
    main()
