"""Rows of the table of readers for bags: topics of poses, and the transforms between two frames.

A topic declares its axes (REP 103 and 105): the world is ENU in ``map``, else z up; the body FLU,
or optical if the child frame's name says so.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from events.frames import axes_of, from_geodetic
from nodes.data.replay.bags import open_bag, readable
from nodes.judging.readers.axes import Axes
from nodes.judging.readers.source import Collected, Floats, Options, Reader, Source, Start
from nodes.ros2.messages.typestore import Bag
from nodes.trajectory import Trajectory
from runtime.errors import suggest
from runtime.time.clock import SECOND

TREES, PATH = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), "nav_msgs/msg/Path"
SUFFIXES = (".mcap", ".db3", ".bag")


class Posed(NamedTuple):
    """Pose in a message, as it stands there."""

    header: Any
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] | None = None  # w x y z
    child: str = ""
    covariance: Any = None


def _point(place: Any) -> tuple[float, float, float]:
    return float(place.x), float(place.y), float(place.z)


def _quaternion(turn: Any) -> tuple[float, float, float, float]:
    return float(turn.w), float(turn.x), float(turn.y), float(turn.z)


def _pose_stamped(message: Any) -> Posed:
    return Posed(
        message.header, _point(message.pose.position), _quaternion(message.pose.orientation)
    )


def _with_covariance(message: Any) -> Posed:
    pose, child = message.pose.pose, getattr(message, "child_frame_id", "")
    place, turn = _point(pose.position), _quaternion(pose.orientation)
    return Posed(message.header, place, turn, child, message.pose.covariance)


def _transform_stamped(message: Any) -> Posed:
    moved = message.transform
    place, turn = _point(moved.translation), _quaternion(moved.rotation)
    return Posed(message.header, place, turn, message.child_frame_id)


def _point_stamped(message: Any) -> Posed:
    return Posed(message.header, _point(message.point))


TYPES: dict[str, Callable[[Any], Posed] | None] = {
    "nav_msgs/msg/Odometry": _with_covariance,
    PATH: None,  # its last message has all
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _with_covariance,
    "geometry_msgs/msg/TransformStamped": _transform_stamped,
    "geometry_msgs/msg/PointStamped": _point_stamped,
    "sensor_msgs/msg/NavSatFix": None,  # east, north, up of the first fix
    **dict.fromkeys(TREES),  # between two named frames
}
"""Readable types of messages, and how a pose is read of one."""


def bags_in(path: Path) -> list[Path]:
    """Return the bags that a path stands for: itself, or those in a folder without metadata."""
    if path.suffix in SUFFIXES and not path.is_dir():
        return [path]
    if not path.is_dir():
        return []
    if (path / "metadata.yaml").is_file():
        return [path]
    files = [file for suffix in SUFFIXES for file in path.glob(f"*{suffix}")]
    folders = [file.parent for file in path.glob("*/metadata.yaml")]
    return sorted({*files, *folders})


def read_topic(path: Path, options: Options) -> Source:
    """Read the poses of a topic, as they stand in its messages.

    Raises:
        ValueError: There is no such topic, it holds something else, or cannot be read.
    """
    bags = bags_in(path)
    if len(bags) > 1:
        names = ", ".join(bag_path.name for bag_path in bags)
        raise ValueError(f"{path}: expected one bag, found {names}: name one of them")
    (path,) = bags
    with readable(path), contextlib.closing(open_bag(path)) as bag:
        topic, frames = _chosen(path, bag, options.part)
        type_ = bag.topics()[topic][0]
        if type_ in TREES:
            source = _read_tree(path, bag, topic, frames)
        elif type_ == "sensor_msgs/msg/NavSatFix":
            source = _read_fixes(path, bag, topic)
        else:
            source = _read_poses(path, bag, topic)
    name = frames or topic.strip("/")
    return msgspec.structs.replace(source, name=name)


def _chosen(path: Path, bag: Bag, part: str) -> tuple[str, str]:
    """Return the topic that a text means, and the frames after it; a `ValueError` if it is none."""
    topics = bag.topics()
    for text, frames in ((part, ""), part.rpartition(":")[::2]):
        for name in (text, f"/{text.lstrip('/')}", text.lstrip("/")):
            if name in topics and text:
                type_ = topics[name][0]
                if type_ not in TYPES:
                    raise ValueError(
                        f"{path}: expected poses on {name}, found {type_}; {_listed(topics)}"
                    )
                return name, frames
    raise ValueError(
        f"{path}: expected a topic of poses, as {path.name}:/TOPIC, found {part!r}"
        f"{suggest(part, topics)}; {_listed(topics)}"
    )


def _listed(topics: dict[str, tuple[str, int]]) -> str:
    poses = [f"{name} ({type_})" for name, (type_, _) in sorted(topics.items()) if type_ in TYPES]
    others = sorted(name for name, (type_, _) in topics.items() if type_ not in TYPES)
    listed = f"poses are on {', '.join(poses) or 'none of its topics'}"
    return f"{listed}; others: {', '.join(others)}" if others else listed


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * SECOND + int(header.stamp.nanosec)


def _axes(frame_id: str, child: str, *, oriented: bool = True) -> Axes:
    """Return the axes that names of frames declare."""
    kinds = {"world": "enu", "body": "nwu", "optical": "optical"}
    world = kinds[axes_of(frame_id)]
    body = "optical" if axes_of(child) == "optical" else "flu"
    return msgspec.convert({"world": world, "body": body if oriented else None}, Axes)


def _read_poses(path: Path, bag: Bag, topic: str) -> Source:
    collected, child, oriented = Collected(f"{path}:{topic}"), "", True
    for number, posed in enumerate(_poses(bag, topic), start=1):
        child = child or posed.child
        oriented = posed.orientation is not None
        covariance = None if posed.covariance is None else np.reshape(posed.covariance, (6, 6))
        collected.add(
            _stamp(posed.header),
            posed.position,
            posed.orientation,
            row=f": pose {number}",
            frame_id=posed.header.frame_id.lstrip("/"),
            covariance=covariance,
        )
    return collected.source(axes=_axes(collected.frame_id, child, oriented=oriented), counted=True)


def _poses(bag: Bag, topic: str) -> Iterator[Posed]:
    """Yield the poses of a topic; of a Path, those of the newest message."""
    path = bag.topics()[topic][0] == PATH
    for _, type_, _, message in bag.messages([topic], newest=path):
        read = TYPES[type_]
        if read is not None:
            yield read(message)
        for pose in message.poses if path else ():
            pose.header.frame_id = pose.header.frame_id or message.header.frame_id
            yield _pose_stamped(pose)


def _read_fixes(path: Path, bag: Bag, topic: str) -> Source:
    """Read fixes as positions east, north and up of the first one."""
    collected, origin = Collected(f"{path}:{topic}"), None
    for _, _, _, message in bag.messages([topic]):
        place = float(message.latitude), float(message.longitude), float(message.altitude)
        if message.status.status < 0:
            collected.outside += 1
            continue
        if not np.isfinite(place).all():
            collected.not_numbers += 1
            continue
        origin = origin or place
        north, east, down = from_geodetic(place, origin)
        collected.add(_stamp(message.header), (east, north, -down))
    return collected.source(axes=Axes("enu"), counted=True)


class _Edge(NamedTuple):
    """Transforms of a frame in its parent."""

    collected: Collected
    static: bool


def _read_tree(path: Path, bag: Bag, topic: str, frames: str) -> Source:
    """Read the pose of a frame in another one, over all transforms between them.

    Each link is interpolated at the stamps of the one with most transforms.
    """
    edges = _edges(path, bag, topic)
    parent, child = _two_frames(path, topic, frames, edges)
    up, down = _to_root(edges, child), _to_root(edges, parent)
    common = next((frame for frame in up if frame in down), None)
    if common is None:
        raise ValueError(
            f"{path}:{topic}: expected transforms between {parent} and {child}, found that "
            f"{child} is below {', '.join(up[1:]) or 'nothing'} and {parent} below "
            f"{', '.join(down[1:]) or 'nothing'}"
        )
    links = [(frame, False) for frame in up[: up.index(common)]]
    links += [(frame, True) for frame in reversed(down[: down.index(common)])]
    moving = [edges[frame][1] for frame, _ in links if not edges[frame][1].static]
    if not moving:
        raise ValueError(
            f"{path}:{topic}: expected transforms that change between {parent} and {child}, found "
            "fixed ones only"
        )
    sources = {frame: edges[frame][1].collected.source(counted=True) for frame, _ in links}
    dense = max(
        (sources[frame] for frame, _ in links if not edges[frame][1].static),
        key=lambda source: len(source.poses),
    )
    stamps = dense.poses.stamps
    known = np.ones(len(stamps), np.bool_)
    for frame, _ in links:
        if not edges[frame][1].static:
            known &= sources[frame].poses.covers(stamps)
    if not known.any():
        raise ValueError(
            f"{path}:{topic}: expected all transforms between {parent} and {child} at one time, "
            "found none"
        )
    stamps = stamps[known]
    whole = np.tile(np.eye(4), (len(stamps), 1, 1))
    for frame, inverse in links:  # from the child up to the common frame, then down to the parent
        matrices = _at(sources[frame].poses, stamps, edges[frame][1].static)
        whole = (np.linalg.inv(matrices) if inverse else matrices) @ whole
    notes = list(dense.notes)
    if not known.all():
        count = int((~known).sum())
        notes.append(f"left out: {count} transforms at times without the others of the chain")
    return msgspec.structs.replace(
        dense,
        poses=Trajectory.from_matrices(stamps, whole),
        frame_id=parent,
        axes=_axes(parent, child),
        notes=tuple(notes),
    )


def _at(poses: Trajectory, stamps: Any, static: bool) -> Floats:
    if static:
        return np.asarray(np.tile(poses.matrices()[-1], (len(stamps), 1, 1)))
    return poses.at(stamps).matrices()


def _edges(path: Path, bag: Bag, topic: str) -> dict[str, tuple[str, _Edge]]:
    """Return the parent of each frame, and its transforms in it."""
    static = [name for name in bag.topics() if name.strip("/") == "tf_static"]
    edges: dict[str, tuple[str, _Edge]] = {}
    for name, type_, _, message in bag.messages({topic, *static}):
        for message_transform in message.transforms if type_ in TREES else ():
            posed = _transform_stamped(message_transform)
            child, parent = posed.child.lstrip("/"), posed.header.frame_id.lstrip("/")
            if child not in edges:
                place = f"{path}:{topic}: {parent} to {child}"
                edges[child] = parent, _Edge(Collected(place), name in static and name != topic)
            known, edge = edges[child]
            if known != parent:
                raise ValueError(
                    f"{path}:{topic}: expected one parent of {child}, found {known} and {parent}"
                )
            edge.collected.add(
                len(edge.collected) if edge.static else _stamp(posed.header),
                posed.position,
                posed.orientation,
            )
    return edges


def _two_frames(
    path: Path, topic: str, frames: str, edges: dict[str, tuple[str, _Edge]]
) -> tuple[str, str]:
    """Return parent and child of ``parent.child``; a `ValueError` if they are not there."""
    known = {*edges, *(parent for parent, _ in edges.values())}
    for place, letter in enumerate(frames):
        if letter == "." and {frames[:place], frames[place + 1 :]} <= known:
            return frames[:place], frames[place + 1 :]
    raise ValueError(
        f"{path}: expected two frames of {topic}, as {topic}:map.base_link, found {frames!r}; "
        f"frames are {', '.join(sorted(known)) or 'none'}"
    )


def _to_root(edges: dict[str, tuple[str, _Edge]], frame: str) -> list[str]:
    chain = [frame]
    while chain[-1] in edges and edges[chain[-1]][0] not in chain:
        chain.append(edges[chain[-1]][0])
    return chain


def _is_bag(path: Path, _: Start | None) -> bool:
    return bool(bags_in(path))


READERS = (
    Reader(
        name="bags",
        recognized="`BAG:/TOPIC` of a `.bag`, `.mcap` or `.db3` file, or of a folder",
        columns="`nav_msgs/Odometry`, `nav_msgs/Path` (its last message), `PoseStamped`, "
        "`PoseWithCovarianceStamped`, `TransformStamped`, `PointStamped`, `NavSatFix` (east, north "
        "and up of the first fix), and `BAG:/tf:map.base_link`",
        stamps="of the header",
        axes="world ENU in `map`, else z up; body FLU, or optical by its name (REP 103)",
        matches=_is_bag,
        read=read_topic,
        part="topic",
    ),
)
