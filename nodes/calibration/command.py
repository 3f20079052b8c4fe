"""``selftest`` and ``lint``: a measured check and a rule check of a rig's settings."""

from __future__ import annotations

import contextlib
import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer

from events import CameraAnnouncement, Image, ImuAnnouncement, Odometry
from events.frames import from_rpy
from nodes.calibration import proofs
from nodes.calibration.proofs import Curve, Figure, Points, needed, noise
from nodes.calibration.room import CENTRE, Motion, _Collector, mjcf
from nodes.data.dataset.recording import choose
from nodes.judging.report import tables
from nodes.judging.report.page import embedded, page_of
from nodes.trajectory_files import tum_row
from runtime.config.model import Config, NodeSpec, to_builtins
from runtime.config.reading import load_configuration, parse
from runtime.errors import ConfigError
from runtime.run.execute import execute
from runtime.run.results import claim
from runtime.run.supervisor import Supervisor
from runtime.sensors import sensor_kinds
from runtime.source_files import source_file
from runtime.tools import preflight
from runtime.tools.cli.commands import ConfigFile, Overrides
from runtime.tools.cli.run import leave_behind
from runtime.units import Duration

TITLES = {
    1: "The ideal IMU integrates to the truth",
    2: "The IMU's Allan deviation is as announced",
    3: "Known points fall on their pixels",
    4: "Depth lies on true surfaces",
    5: "Exported calibrations project the same",
    6: "Stamps of image, depth, pose and IMU agree",
}

_CAMERA_SETTINGS = {
    *("name", "images", "width", "height", "fov", "intrinsics", "lens", "undistorted", "stereo"),
    *("position", "orientation", "rate", "latency", "readout", "time_offset"),
}  # used in the self-test (optics, pose, timing); other settings, as defects, have their defaults

_SECONDS, _RATE = 9.0, 5.0  # length of the flight; images a second, about
_COLLECTOR = {"name": "collector", "type": f"{_Collector.__module__}:_Collector"}


class Result(msgspec.Struct, eq=False):
    """Self-test results of a vehicle."""

    vehicle: str
    figures: dict[int, list[Figure]]  # by number of the proof
    notes: list[str]  # what was switched off, or cannot be shown
    curves: list[Curve]
    points: dict[str, Points]  # by source of the camera

    def passed(self) -> bool:
        """Return whether every figure is within its limit."""
        return all(figure.passed for figures in self.figures.values() for figure in figures)


def subjects(config: Config) -> list[NodeSpec]:
    """Return simulators of vehicles or cameras, by their ports; a `ConfigError` if none."""
    specs = [
        spec
        for spec in config.nodes
        if {Image, Odometry} <= {output.event for output in spec.node.declared.outputs.values()}
        and "world" in spec.config.__struct_fields__
    ]
    if not specs:
        names = ", ".join(spec.type_name for spec in config.nodes)
        raise ConfigError(f"expected a node that simulates a vehicle or a camera, found {names}")
    return specs


def prove(config: Config, spec: NodeSpec, folder: Path, standing: float) -> Result:
    """Fly a vehicle of a file and return its self-test results.

    Args:
        folder: For the room, the exported files and a free camera's path.
        standing: Seconds of simulated time that the IMU may stand for proof 2, at most.

    Raises:
        ConfigError: The file cannot be flown.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = _vehicle_table(config, spec, folder)
    world = folder / "room.xml"
    table["world"] = str(world.resolve())
    world.write_text(mjcf(0.05), encoding="utf-8")
    brought_up = preflight.of_nodes(_config([table], config, 1.0))
    if brought_up.errors:
        raise ConfigError("; ".join(brought_up.errors))
    announced = brought_up.announcements
    cameras = [a for a in announced if isinstance(a, CameraAnnouncement)]
    focal = min((c.info.fx for c in cameras), default=256.0)
    angle = float(np.clip(13.0 / focal, 0.035, 0.08))
    world.write_text(mjcf(angle), encoding="utf-8")
    notes = [
        f"Each camera takes about {_RATE:g} images a second, without noise, blur and what else is "
        "not geometry or time; the error of its depth is switched off, too."
    ]
    lists = (getattr(spec.config, name, ()) for name in ("cameras", "lidars"))
    sensors = (getattr(spec.config, "imu", None), *itertools.chain(*lists))
    if any(getattr(sensor, "calibration_error", False) for sensor in sensors):
        notes.append("The errors of the announced calibrations, which are meant, are switched off.")
    collected = _run(_flight(table, folder), config)
    motion = Motion(collected.odometry)
    result = Result(spec.name, {number: [] for number in TITLES}, notes, [], {})
    figures = result.figures
    imu = next((a for a in announced if isinstance(a, ImuAnnouncement)), None)
    if imu is None or collected.imu_announced is None:
        notes.append(f"{spec.name} has no IMU: proofs 1 and 2 do not apply.")
    else:
        start = max(collected.imu[0].stamp, collected.taken_off) + 50_000_000  # in mid-flight
        figures[1].append(proofs.integration(collected.imu_announced, collected.imu, motion, start))
        seconds = needed(imu, standing)
        resting = _run(_nodes_at_rest(table, seconds), config, seconds)
        samples = {
            "gyroscope": np.array([sample.angular_velocity for sample in resting.imu]),
            "accelerometer": np.array([sample.linear_acceleration for sample in resting.imu]),
        }
        for curve, curve_figures in noise(imu, samples):
            result.curves.append(curve)
            figures[2] += curve_figures
    for camera in collected.cameras.values():
        points = None
        if collected.images[camera.source]:
            points = proofs.discs(camera, collected, motion, angle)
            result.points[camera.source] = points
            figures[3].append(proofs.projection(camera, points))
        if "depth" in camera.images:
            figures[4].append(proofs.depth(camera, collected, motion, angle))
        figures[6] += proofs.stamps(camera, collected, motion, points)
    if imu is not None and collected.imu_announced is not None:
        figures[6].append(proofs.lateness(collected.imu_announced, collected, motion))
    if collected.cameras:
        rig = choose([*collected.cameras.values(), *([imu] if imu else [])], spec.name)
        figures[5] += proofs.exported(rig, folder / "calibration")
    return result


def _is_carried(table: dict[str, Any]) -> bool:
    return "trajectory" in table and "imu" in table


def _vehicle_table(config: Config, spec: NodeSpec, folder: Path) -> dict[str, Any]:
    """Return the vehicle's node table at the room's centre, without inputs and links."""
    (table,) = (node for node in to_builtins(config)["nodes"] if node["name"] == spec.name)
    sensors = (kind.name for kind in sensor_kinds() if kind.name != "imu")
    for key in ("inputs", "links", *sensors, "range_finders", "lidars"):
        table.pop(key, None)
    table.get("imu", {}).pop("calibration_error", None)
    for camera in table.get("cameras", ()):
        for key in set(camera) - _CAMERA_SETTINGS:
            del camera[key]
        camera["rate"] /= max(math.ceil(camera["rate"] / _RATE - 1e-9), 1)
        images = set(camera["images"]) | {"depth"}
        camera["images"] = sorted(images if images & {"rgb", "grey"} else images | {"rgb"})
    if _is_carried(table):
        table |= {"rest": 0.0, "speed": 1.0, "lever": [0.0, 0.0, 0.0], "margin": 0.0}
        table |= {"axes": "ned", "body": "frd", "columns": "", "topic": "", "knots": 0.05}
        table |= {"trajectory": _write_path(folder, 10), "place": "recorded"}
    elif "trajectory" in table:
        table["rate"] /= max(math.ceil(table["rate"] / _RATE - 1e-9), 1)
    else:
        table |= {"position": [0.0, 0.0], "height": 0.0}
    return table  # type: ignore[no-any-return]


def _flight(table: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    if "imu" in table:
        table = table | {"imu": table["imu"] | {"ideal": True}}
    if _is_carried(table):
        return [table, _COLLECTOR]
    if "trajectory" in table:
        return [table | {"trajectory": _write_path(folder, 1)}, _COLLECTOR]
    pilot = {
        "name": "selftest_pilot",
        "type": "WaypointFollower",
        "start_delay": "0.1s",
        "waypoints": [[0.0, 0.0, float(CENTRE[2])], [0.4, 0.0, float(CENTRE[2])]],
        "heading": "fixed",
        "excitation": {"duration": "6s", "amplitude": 0.3, "frequency": 0.4, "yaw": 45.0},
    }
    return [table, pilot, _COLLECTOR]


def _nodes_at_rest(table: dict[str, Any], seconds: float) -> list[dict[str, Any]]:
    """Return the nodes of a run in which the vehicle rests, without cameras."""
    slow = {"rest": seconds + 1.0} if _is_carried(table) else {"control_rate": 20}
    return [table | {"cameras": []} | slow, _COLLECTOR]


def _write_path(folder: Path, step: int) -> str:
    """Write the path of a vehicle without pilot, with a row each `step` ms; return the file."""
    path = folder.resolve() / "path.tum"
    path.write_text("".join(_path(step)), encoding="utf-8")
    return str(path)


def _path(step: int) -> Iterator[str]:
    """Yield a smooth path about all axes, as rows of a TUM file."""
    for millisecond in range(0, round(_SECONDS * 1e3) + 1, step):
        t = millisecond / 1e3
        x, y, z = (0.4 * math.sin(w * t) for w in (2.5, 3.2, 2.0))
        yaw, pitch, roll = (a * math.sin(w * t) for a, w in ((0.8, 1.1), (0.3, 1.9), (0.3, 2.3)))
        place = (float(CENTRE[0]) + x, float(CENTRE[1]) + y, float(CENTRE[2]) + z)
        yield tum_row(millisecond * 1_000_000, place, from_rpy(roll, pitch, yaw))


def _config(nodes: list[dict[str, Any]], config: Config, seconds: float) -> Config:
    run = {"seed": config.run.seed, "duration": seconds, "digest": False, "log": "warning"}
    return parse({"run": run, "nodes": nodes}, "selftest")


def _run(nodes: list[dict[str, Any]], config: Config, seconds: float = _SECONDS) -> _Collector:
    supervisors: list[Supervisor] = []

    @contextlib.contextmanager
    def watch(supervisor: Supervisor) -> Iterator[None]:
        supervisors.append(supervisor)
        yield

    execute(_config(nodes, config, seconds), watch=watch)
    (collector,) = (node for node in supervisors[0].state.all_nodes if isinstance(node, _Collector))
    return collector


def selftest(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page; runs/<name>-selftest if not given.")
    ] = None,
    overrides: Overrides = None,
    standing: Annotated[
        str,
        typer.Option(help="How long the IMU may stand for its Allan deviation, simulated time."),
    ] = "600s",
) -> None:
    """Fly a file's vehicles in a room of known surfaces, and check their announcements.

    Each vehicle flies alone, on a short path about all axes. Checks: the ideal IMU integrates to
    the truth; the noisy IMU has the announced Allan deviation; known points fall on their pixels,
    row time included; depth lies on true surfaces; exported calibrations project the same; the
    stamps of image, depth, pose and IMU agree. Writes selftest.html, with all figures.
    Ends with 0 if all checks pass, else with 1.
    """
    settings = load_configuration(config, overrides or [])
    try:
        seconds = float(Duration.parse(standing))
    except ValueError as error:
        raise ConfigError(f"--standing: {error}") from None
    folder = out or Path("runs") / f"{settings.run.name}-selftest"
    claim(folder)
    results = []
    for spec in subjects(settings):
        result = prove(settings, spec, folder / spec.name, seconds)
        results.append(result)
        for proof, figures in result.figures.items():
            state = "passed" if all(figure.passed for figure in figures) else "FAILED"
            print(
                f"{spec.name}: {proof}. {TITLES[proof]}: {state if figures else 'not applicable'}"
            )
            for figure in figures:
                limit = "" if figure.limit is None else f" (at most {tables.number(figure.limit)})"
                value = f"{tables.number(figure.value)}{limit} {figure.unit}"
                print(f"    {figure.subject}: {figure.name}: {value}")
                if figure.remark:
                    print(f"        {figure.remark}")
    page = folder / "selftest.html"
    write_page(page, settings.run.name, results)
    print(page)
    leave_behind(0 if all(result.passed() for result in results) else 1)


def lint(
    config: ConfigFile,
    overrides: Overrides = None,
    ignore: Annotated[
        list[str] | None, typer.Option(metavar="RULE", help="Leave a rule out; may be repeated.")
    ] = None,
) -> None:
    """Report doubtful settings of a rig: a line for each finding.

    Nothing flies; the nodes are brought up as by check. Each line names the setting and a change:
    baselines, exposures, rates, lenses, latencies, missing noise and mountings, stamps that cannot
    match, estimators that lack a sensor. Accept intended settings in the file, by
    [run] accept = ["rule"] or ["rule:drone/camera"]. Ends with 0, with 1 if there is a finding,
    with 2 if the file is wrong.
    """
    settings = load_configuration(config, overrides or [])
    brought_up = preflight.of_nodes(settings)
    errors = brought_up.errors
    findings = [] if errors else preflight.lint(settings, brought_up.announcements, ignore or [])
    for finding in findings:
        print(finding)
    for error in errors:
        print(f"error: {config.name}: {error}", file=sys.stderr)
    if not findings and not errors:
        print(f"{config}: nothing to say")
    leave_behind(2 if errors else 1 if findings else 0)


def write_page(path: Path, name: str, results: Sequence[Result]) -> None:
    """Write the self-test page and its plots; an `OSError` says if a file cannot be written."""
    with tables.drawing():
        plots = {r.vehicle: [embedded(plot, path.parent) for plot in _plots(r)] for r in results}
    page = page_of(Path(__file__).with_name("selftest.html.jinja")).render(
        name=name, results=results, titles=TITLES, plots=plots, text=tables.number
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def _plots(result: Result) -> Iterator[tables.Plot]:
    for source, points in result.points.items():
        figure = tables.sheet(5.0, width=6.0)
        axes = figure.add_subplot()
        longest = float(np.nanmax(np.abs(points.off), initial=1e-3))
        axes.quiver(*points.pixels.T, *points.off.T, angles="xy", width=0.002, color=tables.LINE)
        axes.invert_yaxis()
        axes.set(aspect="equal", xlabel="column", ylabel="row")
        yield tables.Plot(
            f"points_{source_file(source)}",
            figure,
            f"{source}: points beside their pixels",
            f"Each arrow is one sphere in one image; the longest is {longest:.3f} px. Without "
            "errors they are short and point anywhere.",
        )
    if result.curves:
        figure = tables.sheet(3.4)
        for place, curve in enumerate(result.curves, 1):
            axes = figure.add_subplot(1, 2, place)
            axes.loglog(curve.seconds, curve.measured, "o", ms=4, color=tables.LINE)
            axes.loglog(curve.seconds, curve.announced, color="#3a3a3a")
            unit = "rad/s" if curve.name == "gyroscope" else "m/s²"
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter(lambda value, _: f"{value:g}")
                axis.set_minor_formatter(lambda *_: "")
            axes.set(title=curve.name, xlabel="averaging time (s)", ylabel=f"deviation ({unit})")
        yield tables.Plot(
            f"allan_{result.vehicle}",
            figure,
            "Allan deviation",
            "Points: measured, mean of three axes. Line: what the announced densities give.",
        )
