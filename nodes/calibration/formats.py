"""Announced rigs as calibration files of other programs.

Each file is a template beside this module, ``<format>.<file>.jinja``. Every file speaks of the
IMU's frame and of optical frames (x right, y down, z forward); pixel centres have whole coordinates
in all of them. Without an IMU, the body's frame takes its place. The IMU's axes are ROS's (forward,
left, up) in files that name topics, else ours, as in exported data (forward, right, down). Noise is
that of ``ImuAnnouncement``, continuous densities as Kalibr's, or what a template says beside it.
What a format cannot express is refused if the projection depends on it, else noted in a comment,
for which JSON has no place. Scale and axes of the IMU are words of OpenVINS and Basalt only.
Sources: github.com/ethz-asl/kalibr/wiki/yaml-formats; docs.openvins.com/gs-calibration.html and
open_vins/config; VINS-Fusion/config and camodocal; basalt-headers' ``calibration.hpp``; ORB-SLAM3's
"Calibration_Tutorial.pdf", section 5; open_vins' ``Propagator.cpp`` and basalt-headers'
``calib_bias.hpp``; github.com/VSLAM-LAB/VSLAM-LAB,
``Datasets/DatasetVSLAMLAB.py`` and its data sets.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

import events
from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
)
from events.announcements import IDENTITY
from events.frames import axes_of, flip_yz, rotation_to_nwu
from events.geometry import inverse, pose_matrix, pose_tuples
from nodes.data.dataset.recording import (
    ImageFile,
    Recording,
    Rig,
    choose,
    in_colour,
    real,
    templates,
)
from nodes.ros2.messages.images import depth_in_steps
from nodes.ros2.messages.mappings import TopicKind, publication
from nodes.ros2.messages.topics import PublishingConfig
from nodes.trajectory_files import EPOCH, epoch_of
from runtime.run.results import claim

DEPTH_FACTOR = 5000.0  # steps of an exported depth image per metre, as TUM's
GRAVITY = 9.81  # gravity, m/s², as measured by an `Imu` at rest


class Format(msgspec.Struct, frozen=True):
    """Files and capabilities of a calibration format."""

    files: tuple[str, ...]
    # Coefficients of its radial-tangential lens: 4 (k1, k2, p1, p2), 5 (k3) or 8 (k4, k5, k6 in the
    # denominator).
    radtan: int
    pair_only: bool = False  # limited to one camera or one stereo pair
    needs_imu: bool = False
    camera_file: str = ""  # a file of each camera, with ``{}`` for its number; empty for none
    topics: bool = False  # whether its files name the topics of ROS
    imu_errors: bool = False  # whether it has words for an IMU's scale and axes


FORMATS = {
    "kalibr": Format(("camchain-imucam.yaml", "imu.yaml"), 4, topics=True),
    "openvins": Format(
        ("estimator_config.yaml", "kalibr_imu_chain.yaml", "kalibr_imucam_chain.yaml"),
        4,
        needs_imu=True,
        topics=True,
        imu_errors=True,
    ),
    "vins": Format(("vins.yaml",), 4, pair_only=True, camera_file="cam{}.yaml", topics=True),
    "basalt": Format(("calibration.json",), 8, imu_errors=True),
    "orbslam3": Format(("orbslam3.yaml",), 5, pair_only=True),
    "vslamlab": Format(("calibration.yaml",), 5),
}  # calibration formats by their names in ``export``


def write_files(rig: Rig, name: str, *, topics: bool = True) -> dict[str, str]:
    """Return the texts of a format's files, by name.

    Args:
        name: One of `FORMATS`.
        topics: Whether the reader listens to the topics named; else measurements come another way.

    Raises:
        ValueError: The format cannot express something that the projection depends on.
    """
    form = FORMATS[name]
    if form.needs_imu and rig.imu is None:
        raise ValueError(f"{name}: expected an IMU on {rig.body}, found none")
    chosen = pair(rig) if form.pair_only else rig.cameras
    ros = form.topics and topics
    cameras = [_camera(rig, camera, name, ros=ros) for camera in chosen]
    for field in ("fisheye",) if name == "orbslam3" else ("time_offset",) * (name != "kalibr"):
        if len({camera[field] for camera in cameras}) > 1:
            raise ValueError(f"{name} has one {field} for all cameras, found several")
    common = variables(rig, cameras) | {
        "imu_errors": _imu_errors(rig, name, ros=ros) if form.imu_errors else None,
        "axes": "x forward, y left, z up, as on ROS's topics"
        if ros
        else "x forward, y right, z down, as in exported data; on ROS's topics y left, z up",
        "imu_topic": _topic("imu", rig.imu.source) if ros and rig.imu else "",
    }
    environment = templates(Path(__file__).parent)
    files = {
        file: environment.get_template(f"{name}.{file}.jinja").render(common)
        for file in form.files
        if rig.imu is not None or file != "imu.yaml"
    }
    if rig.imu is not None and not form.imu_errors:
        files[form.files[-1]] += "".join(f"# {remark}\n" for remark in _imu_remarks(rig.imu))
    for number, camera in enumerate(cameras if form.camera_file else []):
        template = environment.get_template(f"{name}.{form.camera_file.format('')}.jinja")
        files[form.camera_file.format(number)] = template.render(camera=camera)
    return files


def left_out(rig: Rig, name: str) -> list[str]:
    """Return sentences on what a format's files leave out, even of their comments."""
    return [
        f"{camera.source}: {name} has no word for a rolling shutter ({real(camera.readout)} s)"
        for camera in rig.cameras
        if name == "basalt" and camera.readout
    ]


def variables(
    rig: Rig, cameras: list[dict[str, Any]] | None = None, *, topics: bool = False
) -> dict[str, Any]:
    """Return all templates' variables: cameras, imu, stereo, gravity, depth_factor.

    Args:
        cameras: In a format's words; if not given, all of the rig, with up to eight coefficients.
        topics: Whether the IMU's axes are those on the topics of ROS.
    """
    if cameras is None:
        cameras = [_camera(rig, camera, "", ros=topics) for camera in rig.cameras]
    return {
        "cameras": cameras,
        "imu": rig.imu,
        "stereo": len(pair(rig)) == 2,
        "gravity": GRAVITY,
        "depth_factor": DEPTH_FACTOR,
    }


def _imu_errors(rig: Rig, name: str, *, ros: bool) -> dict[str, Any]:
    """Return scale and axes of the IMU in the words of OpenVINS and of Basalt.

    The first has L · Q, with a rotation Q; the second the inverse less the identity, column by
    column, of the accelerometer without the numbers above its diagonal.
    """
    entries: dict[str, Any] = {}
    turn = imu_axes(rig, ros=ros)[:3, :3]
    g_sensitivity = rig.imu.g_sensitivity if rig.imu else 0.0
    names = ("gyroscope", "Tw", "R_IMUtoGYRO"), ("accelerometer", "Ta", "R_IMUtoACC")
    for sensor, lower, rotation in names:
        announced = getattr(rig.imu, f"{sensor}_matrix") if rig.imu else IDENTITY
        matrix = turn @ np.reshape(announced, (3, 3)) @ turn
        if abs(np.linalg.det(matrix)) < 1e-9:
            raise ValueError(
                f"{name}: expected an IMU of three axes, found {sensor}_matrix {announced}"
            )
        q, r = np.linalg.qr(matrix.T)
        signs = np.sign(np.diag(r))
        entries |= {lower: signs * r.T, rotation: (q * signs).T}
        error = np.linalg.inv(matrix) - np.eye(3)
        if sensor == "accelerometer":
            above = np.triu(np.ones((3, 3), np.bool_), 1)
            if name == "basalt" and (g_sensitivity or np.abs(error[above]).max() > 1e-12):
                raise ValueError(
                    "basalt has no word for all of the IMU's errors: expected no g_sensitivity and "
                    "an accelerometer_matrix without numbers above its diagonal, found "
                    f"{g_sensitivity:g} and {announced}"
                )
            error = error.T[~above.T]
        entries[f"{sensor}_error"] = np.ravel(error, "F")
    entries["Tg"] = g_sensitivity * np.eye(3)
    return {key: value + 0.0 for key, value in entries.items()}  # without -0.0


def _imu_remarks(imu: ImuAnnouncement) -> list[str]:
    """Return comments on errors of scale and axes, for formats that cannot express them."""
    return [
        f"{name}, which readers of this file know nothing of: {getattr(imu, name)}"
        for name in ("gyroscope_matrix", "accelerometer_matrix", "g_sensitivity")
        if getattr(imu, name) not in {IDENTITY, 0.0}
    ]


def _camera(rig: Rig, camera: CameraAnnouncement, name: str, *, ros: bool) -> dict[str, Any]:
    """Return a camera's template variables, beyond the announced fields."""
    info, in_imu = camera.info, imu_axes(rig, ros=ros) @ camera_in_imu(rig, camera)
    fisheye = info.distortion_model == "equidistant"
    k = _coefficients(camera, name)
    names = (
        ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    )
    lens = dict(zip(names, k, strict=False))
    if name == "basalt" and not fisheye:  # the radius at which the model turns back
        lens["rpmax"] = float(np.tan(min(info.widest_angle(), 1.55)))
    (x, y, z), (qw, qx, qy, qz) = pose_tuples(in_imu)
    rolling = (
        f"rolling shutter: {real(camera.readout)} s from the first row to the last; "
        "stamps are those of the middle row"
    )
    late = f"stamps are {real(camera.time_offset)} s late on the clock of the IMU"
    remarks = [rolling] if camera.readout else []
    return {field: getattr(camera, field) for field in camera.__struct_fields__} | {
        "fisheye": fisheye,
        "k": k,
        "lens": lens,
        "middle": {"fx": info.fx, "fy": info.fy, "cx": info.cx, "cy": info.cy},
        "in_imu": in_imu,
        "from_imu": inverse(in_imu),
        "topic": _topic("image", camera.source),
        "pose": {"px": x, "py": y, "pz": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw},
        "eyes": [
            number
            for number, other in enumerate(rig.cameras)
            if camera.stereo == other.source or other.stereo == camera.source
        ],
        "remarks": remarks,
        "all_remarks": [*remarks, *([late] if camera.time_offset else [])],
    }


def _coefficients(camera: CameraAnnouncement, name: str) -> tuple[float, ...]:
    info, count = camera.info, FORMATS[name].radtan if name else 8
    if info.distortion_model == "equidistant":
        return info.distortion
    k = (0.0,) * 8 if info.is_pinhole else (*info.distortion, 0.0, 0.0, 0.0)[:8]
    if any(k[count:]):
        names = ", ".join(("k1", "k2", "p1", "p2", "k3")[:count])
        lens = info.distortion_model + (" with k3" if len(info.distortion) == 5 else "")
        raise ValueError(
            f"{camera.source}: {name} has no word for its lens: expected radtan ({names}) or "
            f"equidistant, found {lens}; the format basalt has one"
        )
    return k[:count]


Floats = npt.NDArray[np.float64]


def camera_in_imu(rig: Rig, camera: CameraAnnouncement) -> Floats:
    """Return an optical frame's pose in the IMU's (or body's) frame, (4, 4), if on one body."""
    if rig.imu is not None and rig.imu.parent_frame_id != camera.parent_frame_id:
        raise ValueError(
            f"{camera.source}: expected a camera mounted on {rig.imu.parent_frame_id}, as "
            f"{rig.imu.source} is, found one on {camera.parent_frame_id}"
        )
    in_body = pose_matrix(camera.position, camera.orientation)
    if rig.imu is None:
        return in_body
    return inverse(pose_matrix(rig.imu.position, rig.imu.orientation)) @ in_body


def imu_axes(rig: Rig, *, ros: bool) -> Floats:
    """Return the pose of the IMU's (or body's) frame in its ROS axes, shape (4, 4)."""
    frame = rig.cameras[0].parent_frame_id if rig.imu is None else rig.imu.frame_id
    turned = ros and axes_of(frame) == "body"
    return np.diag([1.0, -1.0, -1.0, 1.0]) if turned else np.eye(4)


def _topic(kind: TopicKind, source: str) -> str:
    topic = publication(kind, source, PublishingConfig())
    return "" if topic is None else topic.name


def pair(rig: Rig) -> tuple[CameraAnnouncement, ...]:
    """Return the first stereo pair of a rig, left before right, or its first camera alone."""
    by_source = {camera.source: camera for camera in rig.cameras}
    for camera in rig.cameras:
        if camera.stereo in by_source:
            return by_source[camera.stereo], camera
    return rig.cameras[:1]


def export_calibration(
    run: Path,
    form: str,  # one of `nodes.calibration.formats.FORMATS`
    out: Path | None = None,  # folder for the files; ``export/<form>`` in the run's folder if None
    epoch: int | str = EPOCH,
    camera: str | None = None,  # source of a camera or of its body; the first camera's body if None
) -> list[Path]:
    """Export a run's announced cameras and IMU as another program's calibration.

    ``vslamlab`` also gets images, IMU and ground truth, if the run has a recording.

    Args:
        epoch: The run's time 0 in the data: a date (ISO 8601), or nanoseconds of Unix time.

    Raises:
        ValueError: The run has no announcements or no such camera, or the format cannot express it.
        OSError: A file cannot be written.
    """
    zero = epoch_of(epoch)
    rig = choose(announcements(run), camera)
    files = write_files(rig, form)
    folder = out or run / "export" / form
    recording = run / "recording.mcap"
    if form == "vslamlab" and recording.is_file():
        claim(folder)  # images that an earlier export has left there are removed
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    written = [folder / name for name in files]
    if form != "vslamlab" or not recording.is_file():
        return written
    from nodes.data.replay.bags import Recorded  # which imports the MCAP library

    for number in range(len(rig.cameras)):
        for kind in ("rgb", "depth"):
            shutil.rmtree(folder / f"{kind}_{number}", ignore_errors=True)
    reader, sequence = Recorded(recording), VslamLab(folder, rig, DEPTH_FACTOR, zero)
    handlers: dict[type[Any], Callable[[Any], ImageFile | None]] = {
        Image: sequence.image,
        DepthImage: sequence.depth,
        Imu: sequence.imu,
        Odometry: sequence.odometry,
    }
    for _, event in reader.events(0, None, lambda kind, _: kind in handlers):
        if (file := handlers[type(event)](event)) is not None:
            file()
    reader.close()
    sequence.close()
    return written + [file.path for file in sequence.files]


def announcements(run: Path) -> list[Announcement]:
    """Return a run's announced cameras and IMUs; a `ValueError` if it was killed before."""
    path = run / "summary.json"
    try:
        rows = msgspec.json.decode(path.read_bytes())["announcements"]
        return [
            msgspec.convert(
                {key: value for key, value in row.items() if key != "type"},
                getattr(events, row["type"]),
            )
            for row in rows
            if row["type"] in {CameraAnnouncement.__name__, ImuAnnouncement.__name__}
        ]
    except (OSError, KeyError, TypeError, msgspec.MsgspecError) as error:
        raise ValueError(
            f"{path}: expected the summary of a finished run with what it announced, found: {error}"
        ) from None


class VslamLab(Recording):
    """Images of the rig's cameras, the IMU, and its poses in a world with z up.

    The body of the calibration is the IMU, as in VSLAM-LAB's own sequences of EuRoC.

    ::

        rgb_0/<ns>.png, depth_0/<ns>.png      one folder for each camera; depth in 16 bits
        rgb.csv                               images that belong together, row by row
        imu_0.csv                             in the IMU's frame
        groundtruth.csv                       the IMU, else the body (FRD), in north, west, up
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._stamps: dict[str, list[int]] = {}
        self._names = {camera.source: number for number, camera in enumerate(rig.cameras)}
        for number, camera in enumerate(rig.cameras):
            for kind in ("rgb", *(("depth",) if "depth" in camera.images else ())):
                self._stamps[f"{kind}_{number}"] = []
                (folder / f"{kind}_{number}").mkdir()
        self._imu_in_body = np.eye(4)
        if rig.imu is not None:
            self._imu_in_body = pose_matrix(rig.imu.position, rig.imu.orientation)
            axes = ("wx (rad s^-1)", "wy (rad s^-1)", "wz (rad s^-1)")
            force = ("ax (m s^-2)", "ay (m s^-2)", "az (m s^-2)")
            self._imu = self.rows("imu_0.csv", ",".join(("ts (ns)", *axes, *force)) + "\n")
        header = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw\n"
        self._truth = self.rows("groundtruth.csv", header)

    def image(self, event: Image | DepthImage) -> ImageFile | None:
        """Add an image; return its file, still to be written."""
        kind = "rgb" if isinstance(event, Image) else "depth"
        name = f"{kind}_{self._names.get(event.source, -1)}"
        if name not in self._stamps:
            return None
        self._stamps[name].append(self.epoch + event.stamp)
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        path = self.folder / name / f"{self.epoch + event.stamp}.png"
        return ImageFile(path, event.data, in_colour if kind == "rgb" else convert)

    depth = image

    def odometry(self, event: Odometry) -> None:
        """Add a row with the true pose of the IMU, or of the body of a rig without one."""
        if event.source == self.rig.body:
            place, turn = event.position, event.orientation
            if (self._imu_in_body != np.eye(4)).any():
                place, turn = pose_tuples(pose_matrix(place, turn) @ self._imu_in_body)
            (x, y, z), (w, i, j, k) = flip_yz(place), rotation_to_nwu(turn)
            row = f"{x:.9f},{y:.9f},{z:.9f},{i:.12f},{j:.12f},{k:.12f},{w:.12f}"
            self._truth.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def imu(self, event: Imu) -> None:
        """Add a sample of the rig's IMU."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            values = (*event.angular_velocity, *event.linear_acceleration)
            row = ",".join(f"{value:.12g}" for value in values)
            self._imu.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def close(self) -> None:
        """Write the rows of matching images, within half of the first camera's period."""
        head = ",".join(f"ts_{name} (ns),path_{name}" for name in self._stamps)
        rows = self.rows("rgb.csv", f"{head}\n")
        tolerance = 0.5e9 / self.rig.cameras[0].rate
        for stamp in self._stamps["rgb_0"]:
            cells = []
            for name, stamps in self._stamps.items():
                distances = np.abs(np.asarray(stamps, np.int64) - stamp)
                if len(stamps) and distances.min() <= tolerance:
                    near = stamps[int(distances.argmin())]
                    cells.append(f"{near},{name}/{near}.png")
            if len(cells) == len(self._stamps):
                rows.add(stamp, ",".join(cells) + "\n")
        super().close()
