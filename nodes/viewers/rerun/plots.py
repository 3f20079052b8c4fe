"""Curves over time, and a log in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from events import (
    Event,
    FluidPressure,
    Imu,
    MagneticField,
    NavSatFix,
    Range,
    Score,
    TrackingLost,
    Wind,
)
from events.measurements import fields_of, numbers
from nodes.viewers.common.appearance import Colour, describe
from nodes.viewers.rerun import entities
from nodes.viewers.rerun.entities import EntityLog, Numbered

_AXES = [(230, 80, 70), (90, 200, 90), (90, 140, 255)]
"""Colours of x, y, z."""

GROUPS: dict[type[Event], str] = {
    Imu: "imu",
    FluidPressure: "pressures",
    MagneticField: "magnetic_fields",
    NavSatFix: "fixes",
    Range: "ranges",
    Wind: "wind",
}
"""Parts of the tree of plots, by type of event."""

_HANDY = {"rad": ("°", 180.0 / np.pi), "s": ("ms", 1000.0)}
"""By unit of a score: what is plotted instead, and how many of it make one."""

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
}
"""Which plots have a place in the layout, by title, and what they show."""

_TITLED = ("position_error", "rotation_error")
"""Metrics whose plots have the unit in their title."""


class Plots:
    """Writes curves and the log."""

    def __init__(self, log: EntityLog, colours: Mapping[str, Colour]) -> None:
        self._to = log
        self._colours = colours
        self._known: set[str] = set()

    def measurements(self, kind: type[Event], source: str, events: Sequence[Numbered[Any]]) -> None:
        """Put measurements of one sensor."""
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

    def scores(self, events: Sequence[Numbered[Score]]) -> None:
        """Put scores, of any subject and metric."""
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
