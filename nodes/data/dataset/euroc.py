"""EuRoC MAV (ASL) data set layout, for any number of cameras on a body.

M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016;
projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets. The body's frame is FRD.
Depth images, which the original lacks, stand beside the cameras.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from events import CameraAnnouncement, DepthImage, Image, Imu, ImuAnnouncement, Odometry, Vector3
from events.frames import flip_yz, rotate, rotation_to_nwu
from events.geometry import pose_matrix
from nodes.data.dataset.recording import WORLD_AXES, ImageFile, Recording, Rig, RowFile, in_grey
from nodes.ros2.messages.images import depth_in_steps
from nodes.trajectory.formats import EUROC_HEADER, euroc_row

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
            own_grey = {"rgb", "grey"} <= {*camera.images}
            source = f"{camera.source}/grey" if own_grey else camera.source
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
        return self._note(self._images, event, functools.partial(ImageFile, convert=in_grey))

    def depth(self, event: DepthImage) -> ImageFile | None:
        """Add a depth image of the rig; return its file, still to be written."""
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
        pose = np.eye(4)
        if mounted is not None:
            pose = pose_matrix(mounted.position, mounted.orientation)
        what = {"kind": kind, "comment": comment, "pose": pose.tolist()} | more
        self.describe(f"mav0/{name}/sensor.yaml", "euroc.sensor.yaml", **what)

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
