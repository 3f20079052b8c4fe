"""A replay's settings in a run's file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from events import CameraInfo
from events.camera_info import DistortionModel
from runtime import Changeable, Duration, NodeConfig
from runtime.paths import InputPath

Use = Literal["image", "depth", "imu", "odometry", "truth", "estimate", "camera"]


class BagTopic(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic of a ROS bag, and what its messages become.

    Attributes:
        topic: Its name.
        use: ``as`` in the file. ``image`` (from Image or CompressedImage), ``depth``, ``camera``
            (CameraInfo: a camera is announced), ``imu``, ``odometry`` and ``truth`` (Odometry,
            PoseStamped or TransformStamped: the vehicle's true pose), ``estimate``.
        source: Of the events; if empty, the node's name, and for a camera the topic's namespace.
        frame_id: If set, the frame that events name, whatever the messages say.
    """

    topic: str
    use: Use = msgspec.field(name="as")
    source: str = ""
    frame_id: str = ""


class Pinhole(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Intrinsics of a camera, for data sets that do not come with them.

    Attributes:
        fx: Pixels.
        fy: Pixels.
        cx: Pixels.
        cy: Pixels.
        distortion_model: As in ROS's ``camera_info``.
        distortion: Its coefficients: of plumb_bob k1, k2, p1, p2, k3.
    """

    fx: Annotated[float, msgspec.Meta(gt=0)]
    fy: Annotated[float, msgspec.Meta(gt=0)]
    cx: float
    cy: float
    distortion_model: DistortionModel = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        self.info(1, 1)

    def info(self, width: int, height: int) -> CameraInfo:
        """Return the intrinsics of images of a size.

        Raises:
            ValueError: The number of coefficients is not that of the model.
        """
        return CameraInfo(width=width, height=height, **msgspec.structs.asdict(self))


class ReplayConfig(NodeConfig):
    """Settings of a replay.

    Attributes:
        file: A recording of `nodes.data.recorder` (torn ones too), a ROS 2 bag (a folder, or an
            MCAP or SQLite file), or the folder of a data set in the layout of EuRoC, of TUM RGB-D,
            or of KITTI's odometry (``sequences/00``).
        start: Where to begin. The run's clock is 0 there, and stamps count from there.
        end: Where to end, on the recording's own time; 0 for its end.
        linger: How long the run goes on after the last event, so that others can react to it.
            A recording that says when it ended, or an `end`, ends just then.
        loop: Begin again at the end. The clock goes on, and stamps with it.
        paused: Send nothing; can change in a run. The clock goes on, and what follows comes later.
        position: Where to go on, on the recording's own time, whenever it is set in a run.
        only: Types (``Image``, ``Odometry``) and sources (``drone``, with all below it); an event
            must be of one of the types and from one of the sources, so far as any are named.
            ``["Event"]`` is everything. If empty: the events of sensors and of the vehicle, and the
            true poses; not those of pilots, estimators and evaluations.
        skip: Types and sources that are left out.
        memory: Bytes that may be read ahead.
        topics: What is read of a ROS bag, and as what.
        vehicle: Source of a data set's true poses; its cameras are below it. If empty, the
            node's name.
        camera: Intrinsics of a data set in TUM's layout, if it has no camera.yaml.
        depth_factor: Steps of its depth images per metre.
    """

    file: InputPath
    start: Duration = Duration(0)  # immutable
    end: Duration = Duration(0)
    linger: Duration = Duration(0.5)
    loop: bool = False
    paused: Changeable[bool] = False
    position: Changeable[Duration] = Duration(0)
    only: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()
    memory: Annotated[int, msgspec.Meta(ge=1 << 20)] = 128 << 20
    topics: tuple[BagTopic, ...] = ()
    vehicle: str = ""
    camera: Pinhole | None = None
    depth_factor: Annotated[float, msgspec.Meta(gt=0)] = 5000.0

    def __post_init__(self) -> None:
        if self.end and self.end <= self.start:
            raise ValueError(f"end: expected a time after start, {self.start:g} s")
