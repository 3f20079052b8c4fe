"""Layouts of data sets: EuRoC MAV (ASL), TUM monoVO and TUM RGB-D.

EuRoC: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016;
projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets. The body's frame is FRD.
Depth images, which the original lacks, stand beside the cameras.

monoVO, with its photometric calibration, as DSO reads it: J. Engel, V. Usenko, D. Cremers, "A
photometrically calibrated benchmark for monocular visual odometry", arXiv:1607.02555, 2016.
RGB-D: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, and
cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; stamps have nine decimals in place of six.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from events import (
    CameraAnnouncement,
    CameraInfo,
    DepthImage,
    Image,
    Imu,
    ImuAnnouncement,
    Odometry,
    PoseStamped,
    Vector3,
)
from events.camera_info import response_light, vignette_map
from events.frames import flip_yz, rotate, rotation_to_nwu
from events.geometry import pose_matrix
from nodes.data.dataset.recording import (
    WORLD_AXES,
    ImageFile,
    Recording,
    Rig,
    RowFile,
    extra_values,
    in_colour,
    in_grey,
    real,
)
from nodes.ros2.messages.images import depth_in_steps
from nodes.trajectory_files import EUROC_HEADER, euroc_row, seconds_text, tum_row

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_TRUTH = "state_groundtruth_estimate0"
_BODY = "body: x forward, y right, z down"


class Euroc(Recording):
    """Grey images of all the rig's cameras, the IMU, and the body's poses.

    ::

        mav0/cam0/data/<ns>.png, data.csv, sensor.yaml        one folder for each camera
        mav0/depth0/data/<ns>.png, data.csv, sensor.yaml      of the camera of that number
        mav0/imu0/data.csv, sensor.yaml
        mav0/state_groundtruth_estimate0/data.csv, sensor.yaml

    Raises:
        ValueError: A camera or the IMU is not on the body, or a distortion cannot be expressed.
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        frame = rig.cameras[0].parent_frame_id
        for sensor, parent in (
            *((camera.source, camera.parent_frame_id) for camera in rig.cameras),
            *(((rig.imu.source, rig.imu.parent_frame_id),) if rig.imu is not None else ()),
        ):
            if parent != frame or parent == "map":
                raise ValueError(
                    f"{sensor}: expected a sensor on the body of {rig.cameras[0].source}, "
                    f"found it in the frame {parent!r}"
                )
        self.describe("mav0/body.yaml", "euroc.body.yaml", comment=f"{rig.body}; {_BODY}")
        self._images: dict[str, tuple[str, RowFile]] = {}
        self._depths: dict[str, tuple[str, RowFile]] = {}
        for number, camera in enumerate(rig.cameras):
            # With colour, a camera's grey images have a source of their own.
            separate_grey = {"rgb", "grey"} <= {*camera.images}
            source = f"{camera.source}/grey" if separate_grey else camera.source
            self._images[source] = self._camera(f"cam{number}", camera, "camera")
            if "depth" in camera.images:
                self._depths[camera.source] = self._camera(
                    f"depth{number}", camera, "depth-camera", depth_factor
                )
        if rig.imu is not None:
            self._imu = self.rows("mav0/imu0/data.csv", _IMU_HEADER)
            self._sensor("imu0", "imu", f"{rig.imu.source}; {_BODY}", rig.imu, imu=rig.imu)
        self._truth = self.rows(f"mav0/{_TRUTH}/data.csv", f"{EUROC_HEADER}\n")
        self._velocity_known = False
        self._places: set[Vector3] = set()  # no more than two
        self._describe_truth("velocities as the vehicle sent them")

    def image(self, event: Image) -> ImageFile | None:
        """Add an image of the rig; return its file, still to be written."""
        return self._add_image(self._images, event, functools.partial(ImageFile, convert=in_grey))

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Add a depth image of the rig; return its file, still to be written."""
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        return self._add_image(self._depths, event, functools.partial(ImageFile, convert=convert))

    def odometry(self, event: Odometry) -> None:
        """Add a row with the body's true pose and its velocity in the world."""
        if event.source == self.rig.body:
            self._velocity_known |= any(event.linear_velocity)
            if len(self._places) < 2:
                self._places.add(event.position)
            row = euroc_row(
                self.epoch + event.stamp,
                flip_yz(event.position),
                rotation_to_nwu(event.orientation),
                flip_yz(rotate(event.orientation, event.linear_velocity)),
            )
            self._truth.add(event.stamp, row)

    def imu(self, event: Imu) -> None:
        """Add a sample of the rig's IMU."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            values = (*event.angular_velocity, *event.linear_acceleration)
            row = ",".join(f"{value:.12g}" for value in values)
            self._imu.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def close(self) -> None:
        """Close all files; mark the ground truth's velocities as unknown if none came."""
        if self._velocity_unknown:
            self._describe_truth("velocities unknown (zeros)")
        super().close()

    def warnings(self) -> list[str]:
        """Return warnings for readers of the data set."""
        if self._velocity_unknown:
            return ["the vehicle moved and sent no velocity: those of the ground truth are zeros"]
        return []

    @property
    def _velocity_unknown(self) -> bool:
        return len(self._places) > 1 and not self._velocity_known

    def _describe_truth(self, velocities: str) -> None:
        comment = f"{WORLD_AXES}; {_BODY}; true poses, {velocities}, biases not recorded (zeros)"
        self._sensor(_TRUTH, "ground-truth", comment)

    def _sensor(
        self,
        name: str,
        kind: str,
        comment: str,
        mounted: CameraAnnouncement | ImuAnnouncement | None = None,
        **more: Any,
    ) -> None:
        """Write a sensor.yaml: kind, pose on the body, and further fields by kind."""
        pose, fields = np.eye(4), {}
        if mounted is not None:
            pose, fields = pose_matrix(mounted.position, mounted.orientation), extra_values(mounted)
        variables = {
            "kind": kind,
            "comment": comment,
            "pose": pose.tolist(),
            "noted": fields,
        } | more
        self.describe(f"mav0/{name}/sensor.yaml", "euroc.sensor.yaml", **variables)

    def _add_image(
        self,
        places: dict[str, tuple[str, RowFile]],
        event: Image | DepthImage,
        make: functools.partial[ImageFile],
    ) -> ImageFile | None:
        if event.source not in places:
            return None
        name, rows = places[event.source]
        stamp = self.epoch + event.stamp
        if not rows.add(event.stamp, f"{stamp},{stamp}.png\n"):
            return None
        return make(self.folder / "mav0" / name / "data" / f"{stamp}.png", event.data)

    def _camera(
        self, name: str, camera: CameraAnnouncement, kind: str, depth_factor: float = 0.0
    ) -> tuple[str, RowFile]:
        """Make the folder of a camera; return its name and its index."""
        (self.folder / "mav0" / name / "data").mkdir(parents=True)
        comment = f"{camera.source}; x right, y down, z forward"
        more = {"camera": camera, "lens": _lens(camera), "depth_factor": depth_factor}
        self._sensor(name, kind, comment, camera, **more)
        return name, self.rows(f"mav0/{name}/data.csv", "#timestamp [ns],filename\n")


def _lens(camera: CameraAnnouncement) -> tuple[str, str, tuple[float, ...]]:
    """Return Kalibr's name of a distortion model, the coefficients' names and values."""
    model, lens = camera.info.distortion_model, camera.info.distortion
    if model == "equidistant":
        return "equidistant", "k1, k2, k3, k4", lens
    if model == "plumb_bob":
        name, more = "radial-tangential", lens[4] != 0.0
        return name, "k1, k2, p1, p2" + ", k3" * more, lens if more else lens[:4]
    raise ValueError(
        f"{camera.source}: expected plumb_bob or equidistant distortion, found {model}"
    )


class TumMono(Recording):
    """Grey images of the rig's first camera, its calibration, and its poses.

    ::

        images/<number>.png
        times.txt               number, stamp, and milliseconds of exposure, times the gain
        camera.txt              intrinsics and size, as DSO reads them
        pcalib.txt              light of each of the 256 grey levels, 0 to 255
        vignette.png            share of the light that reaches each pixel, 16 bits
        groundtruthSync.txt     the camera's optical frame in the world, at the images' stamps

    Raises:
        ValueError: The camera's distortion cannot be expressed.
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._camera = camera = rig.cameras[0]
        separate_grey = {"rgb", "grey"} <= {*camera.images}  # they have a source of their own
        self._source = f"{camera.source}/grey" if separate_grey else camera.source
        self.write("camera.txt", _calibration(camera.source, camera.info))
        light = 255.0 * response_light(camera.response)
        self.write("pcalib.txt", " ".join(f"{value:.9g}" for value in light) + "\n")
        shares = vignette_map(camera.info, camera.vignette)
        _, code = cv2.imencode(".png", np.rint(65535 * shares / shares.max()).astype(np.uint16))
        (folder / "vignette.png").write_bytes(code.tobytes())
        (folder / "images").mkdir()
        self._times = self.rows("times.txt", "")
        self._truth = self.rows("groundtruthSync.txt", "")
        self._poses: dict[int, PoseStamped] = {}

    def image(self, event: Image) -> ImageFile | None:
        """Add an image of the camera, and a row with the pose at its stamp."""
        if event.source != self._source:
            return None
        number, stamp = self._times.count, self.epoch + event.stamp
        row = f"{number:05d} {seconds_text(stamp)}"
        if event.exposure_time:
            row += f" {1e3 * event.exposure_time * event.gain:.9g}"
        if not self._times.add(event.stamp, f"{row}\n"):
            return None
        if (pose := self._poses.get(event.stamp)) is not None:
            place = flip_yz(pose.position), rotation_to_nwu(pose.orientation)
            self._truth.add(event.stamp, tum_row(stamp, *place))
        self._poses = {s: pose for s, pose in self._poses.items() if s > event.stamp}
        return ImageFile(self.folder / "images" / f"{number:05d}.png", event.data, in_grey)

    def warnings(self) -> list[str]:
        """Return a warning of what the layout has no place for."""
        camera = self._camera
        if not camera.readout:
            return []
        return [
            f"{camera.source}: no file of this layout says its readout, {real(camera.readout)} s"
        ]

    def pose(self, event: PoseStamped) -> None:
        """Store a pose of the camera until its image comes."""
        if event.source == self._camera.source:
            self._poses[event.stamp] = event


def _calibration(source: str, info: CameraInfo) -> str:
    """Return a camera.txt; pixel centres have whole coordinates, as in all others of ours."""
    coefficients: tuple[float, ...]
    if info.is_pinhole:
        model, coefficients, size = "Pinhole", (0.0,), "none"
    elif info.distortion_model == "equidistant":
        model, coefficients, size = "EquiDistant", info.distortion, "crop"
    elif info.distortion_model == "plumb_bob" and info.distortion[4] == 0.0:
        model, coefficients, size = "RadTan", info.distortion[:4], "crop"
    else:
        raise ValueError(
            f"{source}: expected distortion with four coefficients, which camera.txt has place "
            f"for, found {info.distortion_model} {info.distortion}"
        )
    numbers = " ".join(map(repr, (info.fx, info.fy, info.cx, info.cy, *coefficients)))
    return f"{model} {numbers}\n{info.width} {info.height}\n{size}\n{info.width} {info.height}\n"


class TumRgbd(Recording):
    """Images of the rig's first camera and its poses, `depth_factor` 5000 in the original.

    ::

        rgb/<s>.png, depth/<s>.png        depth: 16 bits, 0 for none
        rgb.txt, depth.txt                stamp and file
        associations.txt                  pairs of both with one stamp
        groundtruth.txt                   the camera's optical frame in the world
        accelerometer.txt                 in the body's frame
        camera.yaml                       intrinsics
    """

    def __init__(self, folder: Path, rig: Rig, depth_factor: float, epoch: int) -> None:
        super().__init__(folder, rig, depth_factor, epoch)
        self._camera = camera = rig.cameras[0]
        colour = "rgb" in camera.images
        self._files = {
            "rgb": self._index("rgb", "color images" if colour else "grey images"),
            "groundtruth": self._rows(
                "groundtruth", "ground truth trajectory", f"{WORLD_AXES}; camera: {_OPTICAL}",
                "timestamp tx ty tz qx qy qz qw",
            ),
        }  # fmt: skip
        if "depth" in camera.images:
            scale = f"{depth_factor:g} steps per metre along the optical axis, 0 for none"
            self._files["depth"] = self._index("depth", f"depth maps, {scale}")
            self._pairs = self.rows("associations.txt", "")
        if rig.imu is not None:
            self._files["accelerometer"] = self._rows(
                "accelerometer", "accelerometer data", "body: x forward, y right, z down; m/s^2",
                "timestamp ax ay az",
            )  # fmt: skip
        self._unpaired: dict[int, str] = {}  # by stamp: rgb or depth, whichever came
        fields = extra_values(camera)
        fields.pop("time_offset", None)  # the true poses are those of the images' own stamps
        self.describe(
            "camera.yaml",
            "tum_rgbd.camera.yaml",
            camera=camera,
            factor=depth_factor,
            noted=fields,
        )

    def image(self, event: Image) -> ImageFile | None:
        """Add an image of the camera, in colour if available."""
        if event.source != self._camera.source or not self._add("rgb", event.stamp):
            return None
        return ImageFile(self._path("rgb", event.stamp), event.data, in_colour)

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Add a depth image of the camera; return its file, still to be written."""
        if event.source != self._camera.source or not self._add("depth", event.stamp):
            return None
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        return ImageFile(self._path("depth", event.stamp), event.data, convert)

    def pose(self, event: PoseStamped) -> None:
        """Add a row with the camera's true pose."""
        if event.source == self._camera.source:
            pose = flip_yz(event.position), rotation_to_nwu(event.orientation)
            self._files["groundtruth"].add(event.stamp, tum_row(self.epoch + event.stamp, *pose))

    def imu(self, event: Imu) -> None:
        """Add a row with the accelerations."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            x, y, z = rotate(self.rig.imu.orientation, event.linear_acceleration)
            row = f"{self._seconds(event.stamp)} {x:.9f} {y:.9f} {z:.9f}\n"
            self._files["accelerometer"].add(event.stamp, row)

    def _add(self, kind: str, stamp: int) -> bool:
        """Add an image, and its partner if received; return whether in order."""
        name = f"{self._seconds(stamp)} {kind}/{self._seconds(stamp)}.png"
        if kind not in self._files or not self._files[kind].add(stamp, f"{name}\n"):
            return False
        if "depth" in self._files:
            partner = self._unpaired.pop(stamp, None)
            if partner is None:
                self._unpaired[stamp] = name
            else:
                first, second = sorted((name, partner), key=lambda n: "depth/" in n)
                self._pairs.add(stamp, f"{first} {second}\n")
                self._unpaired = {s: n for s, n in self._unpaired.items() if s > stamp}
        return True

    def _path(self, kind: str, stamp: int) -> Path:
        return self.folder / kind / f"{self._seconds(stamp)}.png"

    def _seconds(self, stamp: int) -> str:
        return seconds_text(self.epoch + stamp)

    def _index(self, kind: str, title: str) -> RowFile:
        (self.folder / kind).mkdir()
        return self._rows(kind, title, f"camera: {self._camera.source}", "timestamp filename")

    def _rows(self, name: str, *header: str) -> RowFile:
        """Open a file with a header of three lines, as some readers skip exactly three."""
        return self.rows(f"{name}.txt", "".join(f"# {line}\n" for line in header))


_OPTICAL = "x right, y down, z forward"
