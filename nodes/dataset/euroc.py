"""The layout of the EuRoC MAV data sets (ASL's), for any number of cameras of one body.

M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016;
projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets. The body's frame is FRD.
Depth images, which the original lacks, stand beside the cameras.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from events import CameraAnnouncement, DepthImage, Image, Imu, Odometry, Vector3
from events.frames import flip_yz, rotation_to_nwu
from events.poses import pose_matrix
from events.rotations import rotate
from nodes.dataset.recording import ImageFile, Recording, RowFile, in_grey, real
from nodes.dataset.rig import WORLD_AXES, Rig
from nodes.trajectory.formats import EUROC_HEADER, euroc_row
from nodes.viewing.encoding import depth_in_steps

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_TRUTH = "mav0/state_groundtruth_estimate0"
_BODY = "body: x forward, y right, z down"


class Euroc(Recording):
    """Grey images of all the rig's cameras, the IMU, and the body's poses.

    ::

        mav0/cam0/data/<ns>.png, data.csv, sensor.yaml        one folder for each camera
        mav0/depth0/data/<ns>.png, data.csv, sensor.yaml      of the camera of that number
        mav0/imu0/data.csv, sensor.yaml
        mav0/state_groundtruth_estimate0/data.csv, sensor.yaml

    Raises:
        ValueError: A camera or the IMU does not sit on the body, or the layout has no word for a
            camera's distortion.
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
        self.write("mav0/body.yaml", f'comment: "{rig.body}; {_BODY}"\n{self.epoch_line()}')
        self._images: dict[str, tuple[str, RowFile]] = {}
        self._depths: dict[str, tuple[str, RowFile]] = {}
        for number, camera in enumerate(rig.cameras):
            # With colour, a camera's grey images have a source of their own.
            own_grey = {"rgb", "grey"} <= {*camera.images}
            source = f"{camera.source}/grey" if own_grey else camera.source
            self._images[source] = self._camera(f"cam{number}", camera, "camera")
            if "depth" in camera.images:
                note = (
                    f"depth_factor: {real(depth_factor)}  "
                    "# steps per metre along the optical axis, 0 for none\n"
                )
                kind = "depth-camera"
                self._depths[camera.source] = self._camera(f"depth{number}", camera, kind, note)
        if rig.imu is not None:
            self._imu = self.rows("mav0/imu0/data.csv", _IMU_HEADER)
            self.write("mav0/imu0/sensor.yaml", self._imu_yaml())
        self._truth = self.rows(f"{_TRUTH}/data.csv", f"{EUROC_HEADER}\n")
        self._velocity_known = False
        self._places: set[Vector3] = set()  # no more than two
        self._describe_truth("velocities as the vehicle sent them")

    def image(self, event: Image) -> ImageFile | None:
        """Note an image of one of the cameras."""
        return self._note(self._images, event, functools.partial(ImageFile, convert=in_grey))

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Note a depth image of one of the cameras."""
        convert = functools.partial(depth_in_steps, per_metre=self.depth_factor)
        return self._note(self._depths, event, functools.partial(ImageFile, convert=convert))

    def odometry(self, event: Odometry) -> None:
        """Note where the body is, and its velocity in the world."""
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
        """Note what the IMU measures."""
        if self.rig.imu is not None and event.source == self.rig.imu.source:
            values = (*event.angular_velocity, *event.linear_acceleration)
            row = ",".join(f"{value:.12g}" for value in values)
            self._imu.add(event.stamp, f"{self.epoch + event.stamp},{row}\n")

    def close(self) -> None:
        """Write out what is left, and say so if the velocities are none."""
        if self._velocity_unknown:
            self._describe_truth("velocities unknown (zeros)")
        super().close()

    def warnings(self) -> list[str]:
        """Return what a reader should know."""
        if self._velocity_unknown:
            return ["the vehicle moved and sent no velocity: those of the ground truth are zeros"]
        return []

    @property
    def _velocity_unknown(self) -> bool:
        return len(self._places) > 1 and not self._velocity_known

    def _describe_truth(self, velocities: str) -> None:
        comment = f"{WORLD_AXES}; {_BODY}; true poses, {velocities}, biases not recorded (zeros)"
        self.write(f"{_TRUTH}/sensor.yaml", _head("ground-truth", comment, np.eye(4)))

    def _note(
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
        self, name: str, camera: CameraAnnouncement, kind: str, more: str = ""
    ) -> tuple[str, RowFile]:
        """Make the folder of a camera; return its name and its index."""
        (self.folder / "mav0" / name / "data").mkdir(parents=True)
        info = camera.info
        head = _head(
            kind,
            f"{camera.source}; x right, y down, z forward",
            pose_matrix(camera.position, camera.orientation),
        )
        middle = ", ".join(map(real, (info.fx, info.fy, info.cx, info.cy)))
        model, names, lens = _lens(camera)
        text = (
            f"rate_hz: {real(camera.rate)}\n"
            f"resolution: [{info.width}, {info.height}]\n"
            "camera_model: pinhole\n"
            f"intrinsics: [{middle}]  # fu, fv, cu, cv\n"
            f"distortion_model: {model}\n"
            f"distortion_coefficients: [{', '.join(map(real, lens))}]  # {names}\n"
        )
        self.write(f"mav0/{name}/sensor.yaml", head + text + more)
        return name, self.rows(f"mav0/{name}/data.csv", "#timestamp [ns],filename\n")

    def _imu_yaml(self) -> str:
        imu = self.rig.imu
        assert imu is not None
        mounting = pose_matrix(imu.position, imu.orientation)
        return _head("imu", f"{imu.source}; {_BODY}", mounting) + (
            f"rate_hz: {real(imu.rate)}\n"
            "# continuous-time densities, as in Kalibr's files\n"
            f"gyroscope_noise_density: {real(imu.gyroscope_noise_density)}  # rad/s/sqrt(Hz)\n"
            f"gyroscope_random_walk: {real(imu.gyroscope_random_walk)}  # rad/s^2/sqrt(Hz)\n"
            f"accelerometer_noise_density: {real(imu.accelerometer_noise_density)}"
            "  # m/s^2/sqrt(Hz)\n"
            f"accelerometer_random_walk: {real(imu.accelerometer_random_walk)}"
            "  # m/s^3/sqrt(Hz)\n"
        )


def _lens(camera: CameraAnnouncement) -> tuple[str, str, tuple[float, ...]]:
    """Return a distortion model as Kalibr calls it, the coefficients' names, and they themselves.

    Raises:
        ValueError: It has no name for the model.
    """
    model, lens = camera.info.distortion_model, camera.info.distortion
    if model == "equidistant":
        return "equidistant", "k1, k2, k3, k4", lens
    if model == "plumb_bob":
        name, more = "radial-tangential", lens[4] != 0.0
        return name, "k1, k2, p1, p2" + ", k3" * more, lens if more else lens[:4]
    raise ValueError(
        f"{camera.source}: expected plumb_bob or equidistant distortion, found {model}"
    )


def _head(kind: str, comment: str, pose: npt.NDArray[np.float64]) -> str:
    """Return the beginning of a sensor.yaml: what it is, and where it sits on the body."""
    rows = ",\n         ".join(", ".join(map(real, row)) for row in pose.tolist())
    return (
        f"sensor_type: {kind}\n"
        f'comment: "{comment}"\n\n'
        "# sensor to body\n"
        "T_BS:\n"
        "  cols: 4\n"
        "  rows: 4\n"
        f"  data: [{rows}]\n\n"
    )
