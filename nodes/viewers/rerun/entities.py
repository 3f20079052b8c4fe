"""Tree of entities in Rerun, also its tree of frames.

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

What the viewer shows at first: the world large, images beside it, plots below.
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
    known = any(source.startswith(f"{vehicle}/") for vehicle in vehicles)
    return path(WORLD, *([] if known else vehicles[:1]), source)


E = TypeVar("E", bound=Event)

Numbered = tuple[int, E]  # how many events came before, and the event


class EntityLog:
    """Logs entities."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.now = 0, 0  # time of the next entries: an event's number, and its stamp (ns)
        stream.set_log_time_enabled(False)  # one's own time lines: ``run`` and ``event``
        stream.set_log_tick_enabled(False)

    def put(self, entity: str, *what: Any) -> None:
        """Log components of an entity at the time `now`."""
        number, stamp = self.now
        self.stream.set_time("event", sequence=number)
        self.stream.set_time("run", duration=np.timedelta64(stamp, "ns"))
        self.stream.log(entity, *what)

    def static(self, entity: str, *what: Any) -> None:
        """Log components for the whole run."""
        self.stream.log(entity, *what, static=True)

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
        rrb.TimeSeriesView(name=title, origin="/", contents=what, plot_legend=legend)
        for title, what in plots.items()
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
        for camera, there in cameras.items()
        for kind in ("depth", "segmentation", "rgb/features", "grey/features")
        if kind != "depth" or there != ["depth"]
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
