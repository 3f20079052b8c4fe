"""The page itself: everything in one file, that needs no network and no script."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np

from nodes.report import tables
from nodes.report.clouds import draw_clouds
from nodes.report.contents import Run
from nodes.report.curves import draw_distributions, draw_errors, draw_latency, draw_relative
from nodes.report.folder import read_run
from nodes.report.frames import draw_frames, read_picture
from nodes.report.paths import draw_paths
from nodes.report.style import Picture, drawing
from runtime.summary import WORKER_COLUMNS

PAGE = "report.html"
PLOTS = "plots"
_OURS = ("trajectories", "errors", "distributions", "latency", "relative", "frames_*", "clouds_*")
"""Names of the pictures; those of an earlier report are taken away."""

_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 88]

_ALIGNED = {
    "none": "in the truth's frame as it is",
    "origin": "laid on the truth at its first pose",
    "se3": "laid on the truth as a whole (SE3)",
    "sim3": "laid on the truth as a whole, with scale (Sim3)",
}
"""How estimates and the truth were brought together, in words."""

_LEFT = {
    "flight.png": ("The flight", "True path, height and speed, from the flight log.", False),
    "pictures.png": ("Pictures", "Sample pictures of the cameras, from the flight log.", True),
}


def write_report(out: Path) -> Path:
    """Write ``report.html`` and its pictures, ``plots/*.png``, anew.

    Args:
        out: The folder of a run, whatever is in it.

    Returns:
        The page's path.

    Raises:
        ValueError: The folder is not there, or is no run's.
        OSError: Something cannot be written.
    """
    run = read_run(out)
    plots = out / PLOTS
    plots.mkdir(exist_ok=True)
    for pattern in _OURS:
        for old in plots.glob(f"{pattern}.png"):
            old.unlink()
    with drawing():
        curves = [
            picture
            for draw in (draw_paths, draw_errors, draw_distributions, draw_latency, draw_relative)
            if (picture := draw(run, plots)) is not None
        ]
        frames, clouds = draw_frames(run, plots), draw_clouds(run, plots)
    page = out / PAGE
    page.write_text(render(run, curves, frames, clouds), encoding="utf-8", newline="\n")
    return page


def render(run: Run, curves: list[Picture], frames: list[Picture], clouds: list[Picture]) -> str:
    """Return the page."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    left = [Picture(path, *_LEFT[path.name]) for path in run.pictures if _can_be_read(run, path)]
    return environment.get_template("page.html.jinja").render(
        run=run,
        main=tables.figures(run, main=True),
        others=tables.figures(run, main=False),
        facts=tables.facts(run),
        ticks=tables.ticks(run),
        workers=tables.workers(run),
        worker_columns=("worker", *WORKER_COLUMNS),
        outputs=tables.outputs(run),
        curves=[_embedded(p) for p in curves],
        frames=[_embedded(p) for p in frames],
        clouds=[_embedded(p) for p in clouds],
        left=[_embedded(p) for p in left],
        verdicts=[_verdict(e.name, e.figures, e.color) for e in run.estimators],
    )


def _can_be_read(run: Run, path: Path) -> bool:
    """Tell whether a file that another node left is a picture; `Run.missing` says if not."""
    try:
        read_picture(path)
    except (OSError, ValueError) as error:
        run.missing.append(f"{path.name} cannot be read: {error}")
        return False
    return True


def _embedded(picture: Picture) -> dict[str, str]:
    data, kind = picture.path.read_bytes(), "png"
    if picture.photo:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is not None:
            data, kind = cv2.imencode(".jpg", image, _QUALITY)[1].tobytes(), "jpeg"
    return {
        "title": picture.title,
        "caption": picture.caption,
        "source": f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}",
    }


def _verdict(name: str, figures: dict[str, Any], color: str) -> dict[str, Any]:
    """Return what the top of the page says of an estimator."""
    passed = figures.get("passed")
    failed = figures.get("failed")
    return {
        "name": name,
        "color": color,
        "method": str(figures.get("method") or ""),
        "alignment": _ALIGNED.get(str(figures.get("alignment")), ""),
        "state": "not judged" if passed is None else "passed" if passed else "failed",
        "failed": [str(each) for each in failed] if isinstance(failed, list) else [],
    }
