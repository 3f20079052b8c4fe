"""Topics and frames: names allowed by ROS, quality of service, and publishing settings.

Frames are those of REP 103 and REP 105. Definitions of services missing in rosbags are from their
packages' ``.srv`` files, without parts that no hash depends on (comments, constants, default
values): std_srvs and action_msgs of ROS 2 Jazzy, simulation_interfaces 2.1.0.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec

from events import CameraAnnouncement
from events.announcements import Vehicles
from events.frames import Axes, axes_of
from runtime import NodeConfig
from runtime.sensors import sensor_kinds

NO_HASH = "TypeHashNotSupported"  # text of Humble in the place of a type's hash
_DEFAULT_DEPTH = 42
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Qos(msgspec.Struct, frozen=True, kw_only=True):
    """Quality of service, as far as used here."""

    reliable: bool = True
    transient_local: bool = False  # whether late joiners get the last `depth` messages
    depth: int = 10
    keep_all: bool = False  # whether a publisher waits for slow readers rather than drop a message

    def text(self) -> str:
        """Return the text in a token; defaults of rmw_zenoh_cpp stay empty.

        ``reliability:durability:history,depth:deadline s,ns:lifespan s,ns:liveliness,lease s,ns``
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        history = "2" if self.keep_all else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


class Topic(msgspec.Struct, frozen=True, kw_only=True):
    """A topic from the view of an endpoint."""

    name: str  # with its leading slash
    type: str  # ``sensor_msgs/msg/Image``
    hash: str = ""  # ``RIHS01_…``, or `NO_HASH`; empty if not needed
    qos: Qos = Qos()


def dds_type(type_: str) -> str:
    """Return ``sensor_msgs::msg::dds_::Image_`` for ``sensor_msgs/msg/Image``, or `ValueError`."""
    parts = type_.split("/")
    if len(parts) != 3 or not all(_NAME.fullmatch(part) for part in parts):
        raise ValueError(f'expected a type such as "sensor_msgs/msg/Image", found {type_!r}')
    package, folder, name = parts
    return f"{package}::{folder}::dds_::{name}_"


def topic_name(namespace: str, name: str) -> str:
    """Return a topic's full name, as with a leading slash; a `ValueError` if ROS forbids it."""
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if not all(_NAME.fullmatch(part) for part in full[1:].split("/")):
        raise ValueError(
            "expected a topic of letters, digits, _ and /, none of its parts beginning with a "
            f"digit, found {name!r}"
        )
    return full


def ros_name(source: str) -> str:
    """Return the name allowed by ROS nearest to the name of a source."""
    parts = [re.sub(r"[^A-Za-z0-9_]", "_", part) for part in source.split("/") if part]
    return "/".join(f"_{part}" if part[0].isdigit() else part for part in parts) or "_"


_USUAL_GROUPS = (
    "images", "depth_images", "segmentation_images", "point_clouds", "imu", "odometry",
    "camera_poses", "transforms", "estimates", "scores", "ranges", "pressures", "magnetic_fields",
    "fixes", "lidar_scans", "wind", "body_poses", "clock", "paths",
)  # fmt: skip

ALL_GROUPS: tuple[str, ...] = tuple(
    dict.fromkeys((*_USUAL_GROUPS, *(kind.group for kind in sensor_kinds())))
)
"""Groups of topics, in the order of the default; sensors that are not in it come last."""

if TYPE_CHECKING:
    TopicGroup = str
else:
    TopicGroup = Literal[ALL_GROUPS]

Positive = Annotated[int, msgspec.Meta(ge=1)]
Rate = Annotated[float, msgspec.Meta(gt=0)]


class PublishingConfig(NodeConfig):
    """Settings of the published topics.

    Attributes:
        namespace: Prefix of all topic names without a leading slash.
        publish: Groups of topics to publish.
        topics: Other names for topics, by default name.
        time: ``simulated``: stamps count from the run's start, with ``/clock`` (set
            ``use_sim_time``). ``wall``: by the wall clock, without ``/clock``; with the real clock
            only.
        vehicle: Vehicle whose truth ``/tf`` shows; if empty, all announced ones, with its name
            before each of several ones' frames.
        tf: ``truth``, or the source of the estimates that place ``base_link`` instead.
        path_rate: Messages a second, at most, of the path of a vehicle or of an estimate.
        path_step: Metres from one pose of a path to the next.
        path_length: Poses of a path at most; beyond, every other is left out and the step doubled.
        covariance: Publish estimates as PoseWithCovarianceStamped.
        raw_images: Publish images as ``Image``.
        compressed_images: Publish images as ``CompressedImage`` of this format.
        raw_depth: Publish depth images as ``Image``: in metres (32FC1), or in whole ``millimetres``
            up to 65.535 m (16UC1).
        compressed_depth: Publish depth images as of compressed_depth_image_transport: ``inverse``
            depth in 16 bits (32FC1), or whole ``millimetres`` up to 65.535 m (16UC1).
        depth_max: Metres beyond which ``inverse`` depth is unknown.
        depth_quantization: Metres at which steps of ``inverse`` depth are a hundredth of the depth;
            they grow with its square.
        jpeg_quality: 1 to 100.
        sensor_qos: ``best_effort`` (as ROS's sensor data) or ``reliable``, for the topics of
            sensors.
    """

    namespace: str = "/"
    publish: tuple[TopicGroup, ...] = ALL_GROUPS
    topics: dict[str, str] = msgspec.field(default_factory=dict)
    time: Literal["simulated", "wall"] = "simulated"
    vehicle: str = ""
    tf: str = "truth"
    path_rate: Rate = 2.0
    path_step: Rate = 0.05
    path_length: Annotated[int, msgspec.Meta(ge=3, le=1_000_000)] = 1000
    covariance: bool = False
    raw_images: bool = True
    compressed_images: Literal["", "jpeg", "png"] = ""
    raw_depth: bool | Literal["millimetres"] = True
    compressed_depth: Literal["", "inverse", "millimetres"] = ""
    depth_max: Rate = 10.0
    depth_quantization: Rate = 100.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    sensor_qos: Literal["best_effort", "reliable"] = "best_effort"

    def __post_init__(self) -> None:
        if not self.namespace.startswith("/"):
            raise ValueError(f"namespace: expected a leading slash, found {self.namespace!r}")
        if self.namespace != "/":
            check_name("namespace", self.namespace)
        for old_name, name in self.topics.items():
            check_name(f'topics: "{old_name}"', name)


def check_name(place: str, name: str) -> None:
    """Raise a `ValueError`, beginning with `place`, for a name that ROS does not allow."""
    try:
        topic_name("/", name)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None


SIMULATION = "simulation_interfaces/srv"
STEPS = "simulation_interfaces/action/SimulateSteps"
CANCEL_GOAL = "action_msgs/srv/CancelGoal"
TRIGGER = "std_srvs/srv/Trigger"
_ID = "unique_identifier_msgs/UUID goal_id\n"
_STAMP = "builtin_interfaces/Time stamp"

DEFINITIONS = {
    TRIGGER: "---\nbool success\nstring message",
    "simulation_interfaces/msg/Result": "uint8 result\nstring error_message",
    "simulation_interfaces/msg/SimulationState": "uint8 state",
    "simulation_interfaces/msg/SimulatorFeatures": (
        "uint16[] features\nstring[] spawn_formats\nstring custom_info"
    ),
    f"{SIMULATION}/GetSimulatorFeatures": "---\nSimulatorFeatures features",
    f"{SIMULATION}/GetSimulationState": "---\nSimulationState state\nResult result",
    f"{SIMULATION}/SetSimulationState": "SimulationState state\n---\nResult result",
    f"{SIMULATION}/StepSimulation": "uint64 steps\n---\nResult result",
    f"{SIMULATION}/ResetSimulation": "uint8 scope\n---\nResult result",
    f"{STEPS}_Goal": "uint64 steps",
    f"{STEPS}_Result": "Result result",
    f"{STEPS}_Feedback": "uint64 completed_steps\nuint64 remaining_steps",
    f"{STEPS}_FeedbackMessage": f"{_ID}{STEPS}_Feedback feedback",
    f"{STEPS}_SendGoal": f"{_ID}{STEPS}_Goal goal\n---\nbool accepted\n{_STAMP}",
    f"{STEPS}_GetResult": f"{_ID}---\nint8 status\n{STEPS}_Result result",
    CANCEL_GOAL: "GoalInfo goal_info\n---\nint8 return_code\nGoalInfo[] goals_canceling",
}  # by type; request and response of a service are divided by ``---``


class CameraFrames(msgspec.Struct, frozen=True):
    """A camera's two frames in ROS (REP 103): ``camera_link`` and ``camera_optical_frame``."""

    link: str
    optical: str


class FrameNames:
    """Names and axes of the run's frames, and their names in ROS.

    Frames of a single vehicle are REP 105's (``odom``, ``base_link``), of several ``drone/odom``,
    ``drone/base_link``; the vehicle is that of the source (``drone/camera``: ``drone``).
    """

    def __init__(self) -> None:
        self._cameras: dict[str, tuple[str, str]] = {}  # by optical frame: source, own name
        self.own: set[str] = set()  # frames with their owner's name, which ROS calls the same
        self.vehicles = Vehicles()  # whose frames are distinguished

    def add(self, camera: CameraAnnouncement) -> CameraFrames:
        """Add a camera: its frames have its own name, or its vehicle's too if taken."""
        self.vehicles.announced(camera)
        if camera.frame_id not in self._cameras:
            name = ros_name(camera.source.rpartition("/")[2])
            if any(other_name == name for _, other_name in self._cameras.values()):
                name = ros_name(camera.source).replace("/", "_")
            self._cameras[camera.frame_id] = (camera.source, name)
        frames = self.camera(camera.frame_id)
        assert frames is not None
        return frames

    def camera(self, frame_id: str) -> CameraFrames | None:
        """Return the frames of the camera with this optical frame, if any."""
        entry = self._cameras.get(frame_id)
        if entry is None:
            return None
        source, name = entry
        prefix = ""
        if len(self.vehicles.names) > 1 and (vehicle := self.vehicles.carrier(source)):
            prefix, name = f"{ros_name(vehicle)}/", ros_name(source.rpartition("/")[2])
        return CameraFrames(f"{prefix}{name}_link", f"{prefix}{name}_optical_frame")

    def name(self, frame_id: str, source: str = "") -> str:
        """Return the ROS name of a source's frame."""
        if frame_id == "map" or frame_id in self.own:
            return frame_id
        camera = self.camera(frame_id)
        if camera is not None:
            return camera.optical
        vehicle = self.vehicles.of(source)
        local_name = frame_id.removeprefix(f"{vehicle}/")  # ``drone/lidar``, which names it already
        return f"{ros_name(vehicle)}/{local_name}" if len(self.vehicles.names) > 1 else local_name

    def axes(self, frame_id: str) -> Axes:
        """Return how a frame's axes lie."""
        return "optical" if frame_id in self._cameras else axes_of(frame_id)
