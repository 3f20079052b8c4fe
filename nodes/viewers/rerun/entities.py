"""Where things stand in Rerun's tree of entities, which is also its tree of frames.

map                        the world: x north, y east, z down
map/<vehicle>              a vehicle's body, where it truly is
map/<vehicle>/<camera>     one of its cameras (optical frame), with its images below
map/cameras/<camera>       a free camera
map/truth/<vehicle>        the path it has truly flown
map/plan                   the path it was meant to fly; map/plan/<vehicle> of several
map/wind/<vehicle>         the wind that it feels
map/<vehicle>/<lidar>      a lidar with its newest points, or another sensor's frame
map/world/<body>           a body that moves by itself; its path is map/paths/world/<body>
map/estimates/<estimator>  the frame an estimator works in; its path and newest pose below
images/<camera>            images of a camera that nobody announced
map/clouds/<node>          clouds; map/points/<camera>: points of depth images
…/cloud/<node>             clouds in the frame of a body, a camera or an estimator
imu, scores, log           plots and text; so pressures, ranges, magnetic_fields, fixes, wind
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from events import CameraAnnouncement, Event

WORLD = "map"
PLAN = "map/plan"
LOG = "log"


def path(*names: str) -> str:
    """Return an entity's path; slashes of sources divide it, what Rerun cannot read is escaped."""
    parts = [part for name in names for part in name.split("/") if part]
    return "/".join(re.sub(r"([^\w.-])", r"\\\1", part) for part in parts)


def world(*names: str) -> str:
    """Return the path of an entity in the world: ``world("truth", "drone")``."""
    return path(WORLD, *names)


def camera(announced: CameraAnnouncement, vehicles: Sequence[str]) -> str:
    """Return where a camera is: below its vehicle, or free in the world.

    One whose source does not begin with its vehicle's is taken to be the first vehicle's.
    """
    source = announced.source
    if announced.parent_frame_id == "map":
        return path(WORLD, "cameras", source)
    known = any(source.startswith(f"{vehicle}/") for vehicle in vehicles)
    return path(WORLD, *([] if known else vehicles[:1]), source)


E = TypeVar("E", bound=Event)

Numbered = tuple[int, E]
"""How many events came before, and the event."""


class EntityLog:
    """Logs entities."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr = rr
        self.stream = stream
        stream.set_log_time_enabled(False)  # one's own time lines: ``run`` and ``event``
        stream.set_log_tick_enabled(False)

    def at(self, number: int, stamp: int) -> None:
        """Set the time of what is put next: the event's number, and its stamp (ns)."""
        self.stream.set_time("event", sequence=number)
        self.stream.set_time("run", duration=np.timedelta64(stamp, "ns"))

    def put(self, entity: str, *what: Any) -> None:
        """Log something at that time."""
        self.stream.log(entity, *what)

    def static(self, entity: str, *what: Any) -> None:
        """Log what holds for the whole run."""
        self.stream.log(entity, *what, static=True)

    def columns(self, entity: str, events: Sequence[Numbered[E]], columns: Iterable[Any]) -> None:
        """Log rows at once, one for each event."""
        stamps = np.array([event.stamp for _, event in events], "timedelta64[ns]")
        numbers = np.array([number for number, _ in events], np.int64)
        self.stream.send_columns(
            entity,
            indexes=[
                self.rr.TimeColumn("event", sequence=numbers),
                self.rr.TimeColumn("run", duration=stamps),
            ],
            columns=columns,
        )
