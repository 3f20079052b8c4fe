"""What the viewer shows at first: the world large, images beside it, plots below."""

from __future__ import annotations

from typing import Any

import msgspec

from nodes.viewers.rerun import entities

Eye = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Where the eye is and what it looks at, metres in ``map``."""

_SHOWN = 2
"""Cameras whose images have a place of their own; those of more share tabs."""


_ABREAST = 4
"""Plots that have a place of their own at most."""


class Contents(msgspec.Struct):
    """What there is to show.

    Attributes:
        trails: Entities of which all that was logged is shown, up to the time that is shown.
        cameras: By entity: its images (``rgb``, ``grey``, ``depth``, ``segmentation``).
        plots: By title: what it shows.
        eye: Where to look from; None leaves it to the viewer.
    """

    trails: list[str] = []
    cameras: dict[str, list[str]] = {}
    plots: dict[str, str] = {}
    eye: Eye | None = None


def layout(rrb: Any, contents: Contents) -> Any:
    """Return the blueprint."""
    above = [_world(rrb, contents)]
    if views := _images(rrb, contents):
        above.append(rrb.Vertical(*views))
    rows = [rrb.Horizontal(*above, column_shares=[2.4, 1.0][: len(above)])]
    legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    plots = [
        rrb.TimeSeriesView(name=title, origin="/", contents=what, plot_legend=legend)
        for title, what in contents.plots.items()
    ]
    if len(plots) > _ABREAST:  # the rest share the last place
        plots[_ABREAST - 1 :] = [rrb.Tabs(*plots[_ABREAST - 1 :])]
    if plots:
        rows.append(rrb.Horizontal(*plots))
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[2.6, 1.0][: len(rows)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="run", play_state="following"),
        auto_views=False,
    )


def _world(rrb: Any, contents: Contents) -> Any:
    so_far = rrb.VisibleTimeRanges(
        timeline="run",
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    eye = None
    if contents.eye is not None:
        position, target = contents.eye
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=(0, 0, -1)
        )
    # Depth images in the world would be clouds of their own, and features would float. But a
    # camera that has nothing else is shown by its depth.
    hidden = [
        f"- /{camera}/{kind}/**"
        for camera, there in contents.cameras.items()
        for kind in ("depth", "segmentation", "rgb/features", "grey/features")
        if kind != "depth" or there != ["depth"]
    ]
    return rrb.Spatial3DView(
        name="world: true path green, planned path grey, estimates as in the plots",
        origin=f"/{entities.WORLD}",
        contents=["+ $origin/**", *hidden],
        overrides={trail: [so_far] for trail in contents.trails},
        eye_controls=eye,
        background=_DARK,
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0),
    )


def _images(rrb: Any, contents: Contents) -> list[Any]:
    cameras = [_camera(rrb, entity, kinds) for entity, kinds in contents.cameras.items() if kinds]
    if len(cameras) > _SHOWN:
        return [rrb.Tabs(*(rrb.Vertical(*views, name=name) for name, views in cameras))]
    return [view for _, views in cameras for view in views]


def _camera(rrb: Any, entity: str, kinds: list[str]) -> tuple[str, list[Any]]:
    name = entity.removeprefix(f"{entities.WORLD}/")
    views = [rrb.Spatial2DView(name=f"{name} {k}", origin=f"/{entity}/{k}") for k in kinds]
    return name, views


_DARK = (22, 25, 31)
"""Behind the world, whatever the viewer's theme: the colours of paths are made for it."""
