"""Messages of the server: Foxglove's own (paths and bodies, features, the log), and ROS's as CDR.

Paths and bodies are in ROS's frames and axes, as all else is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from events import Event, TrackedFeatures, TrackingLost, Vector3
from events.frames import convert_vector
from nodes.ros2.messages.mappings import PUBLISHED
from nodes.ros2.messages.topics import Topic
from nodes.ros2.messages.typestore import TypeStore
from nodes.viewers.common import INLIER, OUTLIER, VEHICLE, Box, Colour, Trail, describe
from nodes.viewers.foxglove.server import Server
from runtime.time.schedule import SECOND


class Messages:
    """Makes messages.

    Args:
        types: ``foxglove.messages``.
    """

    def __init__(self, types: Any) -> None:
        self._m = types

    def features(self, event: TrackedFeatures) -> Any:
        """Return an ImageAnnotations: what agrees in green, the rest in red."""
        groups = [
            self._m.PointsAnnotation(
                timestamp=self._time(event.stamp),
                type=self._m.PointsAnnotationType.Points,
                points=[self._m.Point2(x=x, y=y) for x, y in event.points[chosen].tolist()],
                outline_color=self._colour(colour),
                fill_color=self._colour(colour),
                thickness=4.0,
            )
            for chosen, colour in ((event.inliers, INLIER), (~event.inliers, OUTLIER))
        ]
        return self._m.ImageAnnotations(points=groups)

    def log(self, event: Event) -> Any:
        """Return a Log."""
        levels = self._m.LogLevel
        return self._m.Log(
            timestamp=self._time(event.stamp),
            level=levels.Warning if isinstance(event, TrackingLost) else levels.Info,
            message=describe(event),
            name=event.source,
        )

    def scene(self, *entities: Any) -> Any:
        """Return a SceneUpdate of what `line` and `body` return."""
        return self._m.SceneUpdate(entities=list(entities))

    def line(self, trail: Trail, name: str, piece: list[Vector3]) -> Any:
        """Return a piece of a path as a SceneEntity."""
        strip = self._m.LinePrimitive(
            type=self._m.LinePrimitiveLineType.LineStrip,
            thickness=trail.thickness,
            points=[self._m.Point3(x=x, y=y, z=z) for x, y, z in piece],
            color=self._colour(trail.colour),
        )
        return self._m.SceneEntity(frame_id=trail.frame_id, id=name, lines=[strip])

    def body(self, name: str, frame_id: str, boxes: Sequence[Box] = VEHICLE) -> Any:
        """Return a body as a SceneEntity that goes where its frame goes; by default a vehicle's."""
        vector = self._m.Vector3
        cubes = []
        for centre, (length, width, height), colour in boxes:
            x, y, z = convert_vector("body", centre)
            cubes.append(
                self._m.CubePrimitive(
                    pose=self._m.Pose(
                        position=vector(x=x, y=y, z=z), orientation=self._m.Quaternion(w=1.0)
                    ),
                    size=vector(x=length, y=width, z=height),
                    color=self._colour(colour),
                )
            )
        return self._m.SceneEntity(frame_id=frame_id, id=name, frame_locked=True, cubes=cubes)

    def _colour(self, colour: Colour) -> Any:
        r, g, b = colour
        return self._m.Color(r=r / 255, g=g / 255, b=b / 255, a=1.0)

    def _time(self, stamp: int) -> Any:
        return self._m.Timestamp(sec=stamp // SECOND, nsec=stamp % SECOND)


E = TypeVar("E", bound=Event)


class RosTopics:
    """The topics of ROS's messages."""

    def __init__(self, server: Server, store: TypeStore) -> None:
        self.server = server
        self._definitions = {row.type: store.definition(row.type) for row in PUBLISHED}
        self._stamps = threading.local()  # of what each thread puts

    def publisher(self, topic: Topic) -> RosTopic:
        """Declare a topic."""
        self.server.declare_ros(topic.name, topic.type, self._definitions[topic.type])
        return RosTopic(self, topic)

    def stamped(self, put: Callable[[E], None]) -> Callable[[E], None]:
        """Return `put`, whose messages then have the time of their event."""

        def put_stamped(event: E) -> None:
            self._stamps.stamp = event.stamp
            put(event)

        return put_stamped

    @property
    def stamp(self) -> int:
        """Return the stamp of the event whose messages this thread puts (ns)."""
        return getattr(self._stamps, "stamp", 0)


class RosTopic:
    """One of them.

    Viewers that come later get the newest message of what ROS keeps for late joiners, and of a
    cloud that is no sensor's: a map.
    """

    def __init__(self, topics: RosTopics, topic: Topic) -> None:
        self.topic = topic
        self._topics = topics
        cloud = topic.type == "sensor_msgs/msg/PointCloud2"
        self._kept = topic.qos.transient_local or (cloud and topic.qos.reliable)

    @property
    def wanted(self) -> bool:
        """Tell whether anybody looks, or may look later at what is kept."""
        return self._kept or self._topics.server.wanted(self.topic.name)

    def put(self, message: bytearray) -> None:
        """Send a message to those who look."""
        data, server, stamp = bytes(message), self._topics.server, self._topics.stamp
        if self._kept:
            server.latch(self.topic.name, lambda: data, stamp)
        else:
            server.log(self.topic.name, data, stamp)
