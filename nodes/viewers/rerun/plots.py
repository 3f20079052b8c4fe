"""Curves over time, a log in words, and depth images with colours as points in the world."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    CameraInfo,
    DepthImage,
    Event,
    FluidPressure,
    Image,
    Imu,
    MagneticField,
    NavSatFix,
    PoseStamped,
    Range,
    Score,
    TrackingLost,
    Wind,
)
from events.geometry import pose_matrix
from events.sensors import fields_of, numbers
from nodes.mapping.cloud import back_project, rays_of
from nodes.viewers.common import REMEMBERED, Colour, describe
from nodes.viewers.rerun import entities
from nodes.viewers.rerun.entities import EntityLog, Numbered
from runtime.time.schedule import SECOND

_AXES = [(230, 80, 70), (90, 200, 90), (90, 140, 255)]  # colours of x, y, z
GROUPS: dict[type[Event], str] = {
    Imu: "imu",
    FluidPressure: "pressures",
    MagneticField: "magnetic_fields",
    NavSatFix: "fixes",
    Range: "ranges",
    Wind: "wind",
}  # parts of the tree of plots, by type of event

_HANDY = {"rad": ("°", 180.0 / np.pi), "s": ("ms", 1000.0)}  # plotted unit and factor, by unit
PLOTS = {
    "position error (m)": "+ /scores/position_error/**",
    "rotation error (°)": "+ /scores/rotation_error/**",
    "angular velocity (rad/s)": "+ /imu/angular_velocity/**",
    "specific force (m/s²)": "+ /imu/linear_acceleration/**",
    "pressure (Pa)": "+ /pressures/fluid_pressure/**",
    "range (m)": "+ /ranges/range/**",
    "magnetic field (T)": "+ /magnetic_fields/magnetic_field/**",
    "satellite velocity (m/s)": "+ /fixes/velocity/**",
    "wind (m/s)": "+ /wind/velocity/**",
}  # plots with a place in the layout, by title, and their entities

_TITLED = ("position_error", "rotation_error")  # metrics whose plots have the unit in their title


class Plots:
    """Writes curves and the log."""

    def __init__(self, log: EntityLog, colours: Mapping[str, Colour]) -> None:
        self._to = log
        self._colours = colours
        self._known: set[str] = set()
        self.plotted: set[str] = set()  # parts of the tree with curves

    def titles(self) -> dict[str, str]:
        """Return the plots with something to show: the entities of each, by title."""
        return {t: what for t, what in PLOTS.items() if what.split("/")[1] in self.plotted}

    def measurements(self, kind: type[Event], source: str, events: Sequence[Numbered[Any]]) -> None:
        """Put the measurements of a sensor."""
        self.plotted.add(GROUPS[kind])
        for field in fields_of(kind):
            entity = entities.path(GROUPS[kind], field, source)
            rows = np.array([numbers(event, field) for _, event in events])
            if rows.shape[1] == 3:
                self._style(entity, colors=_AXES, names=["x", "y", "z"])
            else:
                self._style(entity, names=[source])
            self._to.columns(entity, events, self._to.rr.Scalars.columns(scalars=rows))
        if kind is NavSatFix:
            places = np.array([(event.latitude, event.longitude) for _, event in events])
            columns = self._to.rr.GeoPoints.columns(positions=places)
            self._to.columns(entities.path("gps", source), events, columns)

    def scores(self, _: str, events: Sequence[Numbered[Score]]) -> None:
        """Put scores, of any subject and metric."""
        self.plotted.add("scores")
        apart: dict[tuple[str, str, str], list[Numbered[Score]]] = {}
        for number, event in events:
            key = event.subject, event.metric, event.unit
            apart.setdefault(key, []).append((number, event))
        for (subject, metric, unit), found in apart.items():
            entity = entities.path("scores", metric, subject)
            shown, factor = _HANDY.get(unit, (unit, 1.0))
            style = {"colors": [self._colours[subject]]} if subject in self._colours else {}
            name = subject if metric in _TITLED else f"{subject} ({shown})"
            self._style(entity, names=[name], **style)
            values = np.array([event.value for _, event in found]) * factor
            self._to.columns(entity, found, self._to.rr.Scalars.columns(scalars=values))

    def note(self, source: str, text: str) -> None:
        """Put a note of the whole run into the log."""
        note = self._to.rr.TextLog(f"{source}: {text}", level="WARN")
        self._to.static(entities.path(entities.LOG, "notes", source), note)

    def logged(self, event: Event) -> None:
        """Put an event into the log, in words."""
        text = f"{event.source}: {describe(event)}"
        lost = isinstance(event, TrackingLost)
        self._to.put(entities.LOG, self._to.rr.TextLog(text, level="WARN" if lost else "INFO"))

    def _style(self, entity: str, **style: Any) -> None:
        if entity not in self._known:
            self._known.add(entity)
            self._to.static(entity, self._to.rr.SeriesLines(**style))


class ColouredPoints(msgspec.Struct, frozen=True, eq=False):
    """Coloured points in the world."""

    stamp: int  # of the exposure (ns)
    points: npt.NDArray[np.float32]  # float32 metres, shape (n, 3), in the pose's parent frame
    colours: npt.NDArray[np.uint8]  # uint8 red, green, blue, shape (n, 3)


class ScenePoints:
    """Points in the world from a camera's depth and colours, at a bounded rate."""

    def __init__(
        self,
        info: CameraInfo,
        rate: float,  # sets a second at most; 0: none
        stride: int,  # take every n-th pixel of every n-th row
        max_distance: float,  # metres from the camera, beyond which points are left out
        max_height: float,  # metres above the camera, likewise
    ) -> None:
        self._rate, self._stride = rate, stride
        self._max_distance, self._max_height = max_distance, max_height
        self._info = info
        self._rays = rays_of(info, stride)
        self._done = -1
        self._image: Image | None = None
        self._depth: DepthImage | None = None
        self._poses: deque[PoseStamped] = deque(maxlen=REMEMBERED)

    def take(self, event: Image | DepthImage | PoseStamped) -> ColouredPoints | None:
        """Take an image, depth or pose; return the points when all are there and a set is due."""
        match event:
            case Image():
                self._image = event
            case DepthImage():
                self._depth = event
            case PoseStamped():
                self._poses.append(event)
        image, depth = self._image, self._depth
        if image is None or depth is None or image.stamp != depth.stamp:
            return None
        pose = next((each for each in self._poses if each.stamp == image.stamp), None)
        period = int(image.stamp * self._rate // SECOND)
        if pose is None or period == self._done or not self._rate:
            return None
        self._done = period
        return self._points(image, depth, pose)

    def _points(self, image: Image, depth: DepthImage, pose: PoseStamped) -> ColouredPoints | None:
        pixels = slice(None, None, self._stride)
        size = (self._info.height, self._info.width)
        if depth.data.shape != size or image.data.shape[:2] != size:
            return None
        seen, where = back_project(depth.data[pixels, pixels], self._rays, self._max_distance)
        colours = image.data[pixels, pixels][where]
        if colours.ndim == 1:
            colours = np.repeat(colours[:, None], 3, axis=1)
        placed = pose_matrix(pose.position, pose.orientation)
        points = seen.astype(np.float64) @ placed[:3, :3].T + placed[:3, 3]
        low = points[:, 2] > pose.position[2] - self._max_height  # z points down
        return ColouredPoints(image.stamp, points[low].astype(np.float32), colours[low])
