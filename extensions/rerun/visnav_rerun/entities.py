"""Tree of entities in Rerun, also its tree of frames; curves, a log, and depth images' points.

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
imu, scores, log           plots and text; so the groups of all sensors, and wind

What the viewer shows at first: the world large, images beside it, plots below.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Event,
    Image,
    NavSatFix,
    PoseStamped,
    Score,
    TrackingLost,
    Wind,
)
from events.geometry import pose_matrix
from events.sensors import numbers
from nodes.mapping import back_project, rays_of
from nodes.viewers.common import REMEMBERED, Colour, describe
from runtime.sensors import fields_of, sensor_kinds
from runtime.time.clock import SECOND

WORLD = "map"
PLAN = "map/plan"
LOG = "log"


def path(*names: str) -> str:
    """Return an entity's path: names divided at slashes, special characters escaped."""
    parts = [part for name in names for part in name.split("/") if part]
    return "/".join(re.sub(r"([^\w.-])", r"\\\1", part) for part in parts)


def world(*names: str) -> str:
    """Return the path of an entity in the world: ``world("truth", "drone")``."""
    return path(WORLD, *names)


def camera(announced: CameraAnnouncement, vehicles: Sequence[str]) -> str:
    """Return where a camera is: below its vehicle (by default the first), or free in the world."""
    source = announced.source
    if announced.parent_frame_id == "map":
        return path(WORLD, "cameras", source)
    has_vehicle = any(source.startswith(f"{vehicle}/") for vehicle in vehicles)
    return path(WORLD, *([] if has_vehicle else vehicles[:1]), source)


E = TypeVar("E", bound=Event)

Numbered = tuple[int, E]  # how many events came before, and the event


class EntityLog:
    """Logs entities."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.now = 0, 0  # time of the next entries: an event's number, and its stamp (ns)
        stream.set_log_time_enabled(False)  # one's own time lines: ``run`` and ``event``
        stream.set_log_tick_enabled(False)

    def add(self, entity: str, *components: Any) -> None:
        """Log components of an entity at the time `now`."""
        number, stamp = self.now
        self.stream.set_time("event", sequence=number)
        self.stream.set_time("run", duration=np.timedelta64(stamp, "ns"))
        self.stream.log(entity, *components)

    def static(self, entity: str, *components: Any) -> None:
        """Log components for the whole run."""
        self.stream.log(entity, *components, static=True)

    def columns(self, entity: str, events: Sequence[Numbered[E]], columns: Iterable[Any]) -> None:
        """Log rows at once, a row for each event."""
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


Eye = tuple[tuple[float, float, float], tuple[float, float, float]]  # position, target, ``map``
_SHOWN = 2  # cameras whose images have a place of their own; those of more share tabs


_ABREAST = 4  # plots with a place of their own, at most


def layout(
    rrb: Any,
    trails: list[str],  # entities shown with their whole past
    cameras: dict[str, list[str]],  # kinds of images (``rgb``, ``grey``, …), by camera's entity
    plots: dict[str, str],  # entities plotted, by title
    eye: Eye | None,  # viewpoint; None leaves it to the viewer
) -> Any:
    """Return the blueprint."""
    above = [_world(rrb, trails, cameras, eye)]
    if views := _images(rrb, cameras):
        above.append(rrb.Vertical(*views))
    rows = [rrb.Horizontal(*above, column_shares=[2.4, 1.0][: len(above)])]
    legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    curves = [
        rrb.TimeSeriesView(name=title, origin="/", contents=entities, plot_legend=legend)
        for title, entities in plots.items()
    ]
    if len(curves) > _ABREAST:  # the rest share the last place
        curves[_ABREAST - 1 :] = [rrb.Tabs(*curves[_ABREAST - 1 :])]
    if curves:
        rows.append(rrb.Horizontal(*curves))
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[2.6, 1.0][: len(rows)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="run", play_state="following"),
        auto_views=False,
    )


def _world(rrb: Any, trails: list[str], cameras: dict[str, list[str]], eye: Eye | None) -> Any:
    so_far = rrb.VisibleTimeRanges(
        timeline="run",
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    controls = None
    if eye is not None:
        position, target = eye
        controls = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=(0, 0, -1)
        )
    # Depth images in the world would be clouds of their own, and features would float. But a
    # camera that has nothing else is shown by its depth.
    hidden = [
        f"- /{camera}/{kind}/**"
        for camera, entity in cameras.items()
        for kind in ("depth", "segmentation", "rgb/features", "grey/features")
        if kind != "depth" or entity != ["depth"]
    ]
    return rrb.Spatial3DView(
        name="world: true path green, planned path grey, estimates as in the plots",
        origin=f"/{WORLD}",
        contents=["+ $origin/**", *hidden],
        overrides={trail: [so_far] for trail in trails},
        eye_controls=controls,
        background=_DARK,
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0),
    )


def _images(rrb: Any, cameras: dict[str, list[str]]) -> list[Any]:
    shown = {
        (name := entity.removeprefix(f"{WORLD}/")): [
            rrb.Spatial2DView(name=f"{name} {kind}", origin=f"/{entity}/{kind}") for kind in kinds
        ]
        for entity, kinds in cameras.items()
        if kinds
    }
    if len(shown) > _SHOWN:
        return [rrb.Tabs(*(rrb.Vertical(*views, name=name) for name, views in shown.items()))]
    return [view for views in shown.values() for view in views]


_DARK = (22, 25, 31)  # background of the world in every theme, matched to the colours of paths


_AXES = [(230, 80, 70), (90, 200, 90), (90, 140, 255)]  # colours of x, y, z
GROUPS: dict[type[Event], str] = {
    **{kind.event: kind.group for kind in sensor_kinds() if kind.fields},
    Wind: "wind",
}  # parts of the tree of plots, by type of event

_HANDY = {"rad": ("°", 180.0 / np.pi), "s": ("ms", 1000.0)}  # plotted unit and factor, by unit
_FIRST = ("imu", "barometer", "range")  # sensors whose plots come before those of the others
PLOTS = {
    "position error (m)": "+ /scores/position_error/**",
    "rotation error (°)": "+ /scores/rotation_error/**",
    **{
        f"{title} ({kind.fields[field]})": f"+ /{kind.group}/{field}/**"
        for kind in sorted(sensor_kinds(), key=lambda kind: kind.name not in _FIRST)
        for field, title in kind.plots.items()
    },
    "wind (m/s)": "+ /wind/velocity/**",
}  # plots with a place in the layout, by title, and their entities

_TITLED = ("position_error", "rotation_error")  # metrics whose plots have the unit in their title


class Plots:
    """Writes curves and the log."""

    def __init__(self, log: EntityLog, colours: Mapping[str, Colour]) -> None:
        self._entity_log = log
        self._colours = colours
        self._styled: set[str] = set()
        self.plotted: set[str] = set()  # parts of the tree with curves

    def titles(self) -> dict[str, str]:
        """Return the plots with something to show: the entities of each, by title."""
        return {
            t: entities for t, entities in PLOTS.items() if entities.split("/")[1] in self.plotted
        }

    def measurements(self, kind: type[Event], source: str, events: Sequence[Numbered[Any]]) -> None:
        """Log the measurements of a sensor."""
        self.plotted.add(GROUPS[kind])
        for field in fields_of(kind):
            entity = path(GROUPS[kind], field, source)
            rows = np.array([numbers(event, field) for _, event in events])
            if rows.shape[1] == 3:
                self._style(entity, colors=_AXES, names=["x", "y", "z"])
            else:
                self._style(entity, names=[source])
            self._entity_log.columns(
                entity, events, self._entity_log.rr.Scalars.columns(scalars=rows)
            )
        if kind is NavSatFix:
            places = np.array([(event.latitude, event.longitude) for _, event in events])
            columns = self._entity_log.rr.GeoPoints.columns(positions=places)
            self._entity_log.columns(path("gps", source), events, columns)

    def scores(self, _: str, events: Sequence[Numbered[Score]]) -> None:
        """Log scores, of any subject and metric."""
        self.plotted.add("scores")
        by_key: dict[tuple[str, str, str], list[Numbered[Score]]] = {}
        for number, event in events:
            key = event.subject, event.metric, event.unit
            by_key.setdefault(key, []).append((number, event))
        for (subject, metric, unit), scores in by_key.items():
            entity = path("scores", metric, subject)
            shown_unit, factor = _HANDY.get(unit, (unit, 1.0))
            style = {"colors": [self._colours[subject]]} if subject in self._colours else {}
            name = subject if metric in _TITLED else f"{subject} ({shown_unit})"
            self._style(entity, names=[name], **style)
            values = np.array([event.value for _, event in scores]) * factor
            self._entity_log.columns(
                entity, scores, self._entity_log.rr.Scalars.columns(scalars=values)
            )

    def log_note(self, source: str, text: str) -> None:
        """Log a note for the whole run."""
        entry = self._entity_log.rr.TextLog(f"{source}: {text}", level="WARN")
        self._entity_log.static(path(LOG, "notes", source), entry)

    def logged(self, event: Event) -> None:
        """Log an event as text."""
        text = f"{event.source}: {describe(event)}"
        lost = isinstance(event, TrackingLost)
        self._entity_log.add(
            LOG, self._entity_log.rr.TextLog(text, level="WARN" if lost else "INFO")
        )

    def _style(self, entity: str, **style: Any) -> None:
        if entity not in self._styled:
            self._styled.add(entity)
            self._entity_log.static(entity, self._entity_log.rr.SeriesLines(**style))


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

    def add(self, event: Image | DepthImage | PoseStamped) -> ColouredPoints | None:
        """Add an image, depth or pose; return the points when a set is complete and due."""
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
        pose = next((pose for pose in self._poses if pose.stamp == image.stamp), None)
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
        points_in_camera, mask = back_project(
            depth.data[pixels, pixels], self._rays, self._max_distance
        )
        colours = image.data[pixels, pixels][mask]
        if colours.ndim == 1:
            colours = np.repeat(colours[:, None], 3, axis=1)
        placed = pose_matrix(pose.position, pose.orientation)
        points = points_in_camera.astype(np.float64) @ placed[:3, :3].T + placed[:3, 3]
        low = points[:, 2] > pose.position[2] - self._max_height  # z points down
        return ColouredPoints(image.stamp, points[low].astype(np.float32), colours[low])
