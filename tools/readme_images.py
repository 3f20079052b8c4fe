"""Make the README's image, and that of the first tutorial.

`overview.jpg`: the office from outside with the truth and the estimates of three systems, whose
runs are those of the suite's flight there; and what the camera saw. `features.jpg`: the features of
the standard tour.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from events.frames import from_rpy
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.renderer import Shot
from sims.worlds import load_scene

TOUR, RUNS, DOCS = Path("runs/tour/latest/plots"), Path("runs/office/runs"), Path("docs/images")
SYSTEMS = {  # the estimator's name in the suite: name, colour
    "features": ("ours, RGB-D", "#ffb000"),
    "orb_slam3_rgbd": ("ORB-SLAM3", "#ff4f8b"),
    "kiss_icp": ("KISS-ICP, lidar", "#4fc3ff"),
}
TRUTH, GROUND, TEXT = "#ffffff", "#14181d", "#e8eaed"
VERDICTS = {"passed": "#7ee787", "failed": "#ff7b72"}
VIEW = (11.4, -5.2, -7.4), (0.0, -40.0, 146.0)  # north, east, down, metres; roll, pitch, yaw, °
SIZE, FOV = (1080, 860), 70.0
GAP = 0.5  # s without an estimate, over which no line is drawn

Points = npt.NDArray[np.float64]


def main() -> None:
    """Write both images."""
    png = TOUR / "frames_odometry.png"
    if not png.is_file():
        raise SystemExit(f"expected {png}: run `make demo` first")
    features: Any = cv2.imdecode(np.frombuffer(png.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    jpeg = cv2.imencode(".jpg", features, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    (DOCS / "features.jpg").write_bytes(jpeg.tobytes())
    quality = {"quality": 90, "optimize": True}
    _overview().savefig(DOCS / "overview.jpg", facecolor=GROUND, pil_kwargs=quality)


def _overview() -> Any:
    runs = {name: run for run in sorted(RUNS.iterdir()) for name in SYSTEMS if _is(run, name)}
    if missing := SYSTEMS.keys() - runs.keys():
        raise SystemExit(f"expected runs of {', '.join(missing)} in {RUNS}: run `make images`")
    figure = plt.figure(figsize=(16.6, 8.6), dpi=100)
    world = figure.add_axes((0.0, 0.0, SIZE[0] / 1660, 1.0))
    world.imshow(_from_outside(), extent=(0, SIZE[0], SIZE[1], 0))
    truth = np.loadtxt(runs["features"] / "trajectories" / "truth.tum")
    _draw(world, truth * [1, 1, 1, 0, *[1] * 4], "#00000040", 3.0)  # its shadow
    for name, (_, colour) in SYSTEMS.items():
        _draw(world, np.loadtxt(runs[name] / "evaluation" / f"{name}.aligned.tum"), colour, 3.6)
    _draw(world, truth, TRUTH, 2.6)
    world.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0))
    image = figure.add_axes((1096 / 1660, 0.455, 548 / 1660, 0.48))
    image.imshow(plt.imread(max((runs["features"] / "frames").glob("features_*"))))
    image.set_title("camera, and the features that ours tracks", **_text(15), loc="left")
    _legend(figure.add_axes((1096 / 1660, 0.0, 548 / 1660, 0.44)), runs)
    for axes in figure.axes:
        axes.set_axis_off()
    return figure


def _legend(axes: Axes, runs: dict[str, Path]) -> None:
    """Draw a row for the truth and each system: colour, name, error, time lost, verdict."""
    axes.set(xlim=(0, 1), ylim=(5.6, -0.4))
    rows = [("truth", TRUTH, "error", "lost", "verdict")]
    for name, (label, colour) in SYSTEMS.items():
        verdict = json.loads((runs[name] / "evaluation" / "verdict.json").read_text())
        figures = verdict["estimators"][name]
        error, lost = f"{figures['flight_ate_percent']:.3g} %", f"{figures['lost_seconds']:.1f} s"
        rows.append((label, colour, error, lost, "passed" if figures["passed"] else "failed"))
    for row, (label, colour, *cells) in enumerate(rows):
        axes.plot([0, 0.07], [row + 0.36] * 2, color=colour, linewidth=4)
        axes.text(0.1, row + 0.5, label, **_text(17))
        for at, cell in zip((0.49, 0.68, 0.855), cells, strict=True):
            axes.text(at, row + 0.5, cell, **_text(17, VERDICTS.get(cell, TEXT)))
    axes.text(0, 4.6, "passed: at most 5 % error of the path flown,", **_text(14))
    axes.text(0.15, 5.1, "lost for at most 4 s", **_text(14))


def _text(size: int, colour: str = TEXT) -> dict[str, Any]:
    return {"color": colour, "fontsize": size}


def _is(run: Path, name: str) -> bool:
    return (run / "trajectories" / f"{name}.tum").is_file()


def _draw(axes: Axes, rows: Points, colour: str, width: float) -> None:
    """Draw a trajectory: rows of seconds, position in map (NED, metres), quaternion."""
    points = _projected(rows[:, 1:4])
    points[1:][np.diff(rows[:, 0]) > GAP] = np.nan
    axes.plot(*points.T, color=colour, linewidth=width)


def _camera() -> CameraSpec:
    return CameraSpec(name="camera", images=("rgb",), width=SIZE[0], height=SIZE[1], fov=FOV)


def _from_outside() -> Any:
    world, dynamics = load_scene("office", 1)
    for geom in list(world.worldbody.geoms):
        if geom.name.startswith("ceiling"):
            world.delete(geom)
    prefix = add_free_camera(world, "free", (_camera(),))
    renderer = CameraRenderer(model_to_bytes(world.compile()), (_camera(),), prefix, 0, 2, dynamics)
    north_east_down, angles = VIEW
    state = pose_to_qpos(north_east_down, from_rpy(*np.radians(angles).tolist()))
    (frame,) = renderer.expose((Shot("camera", 3_000_000_000, state),))
    image = np.array(frame.rgb)
    renderer.close()
    image[(image == 0).all(axis=2)] = [int(GROUND[at : at + 2], 16) for at in (1, 3, 5)]
    return image


def _projected(points: Points) -> Points:
    """Return where points (map, NED, metres) are in the image from outside: columns and rows."""
    position, (roll, pitch, yaw) = np.array(VIEW[0]), np.radians(VIEW[1])
    assert roll == 0.0
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    axes = np.stack([right, np.cross(forward, right), forward])
    focal = SIZE[0] / 2 / np.tan(np.radians(FOV) / 2)
    seen = (points - position) @ axes.T
    pixels: Points = seen[:, :2] / seen[:, 2:] * focal + (np.array(SIZE) - 1) / 2
    return pixels


if __name__ == "__main__":
    main()
