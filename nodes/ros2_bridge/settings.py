"""What the file says of the bridge."""

from __future__ import annotations

import re
from typing import Annotated, Literal

import msgspec

from nodes.ros_messages.incoming import READERS
from nodes.ros_messages.topics import Qos, dds_type, topic_name
from nodes.ros_messages.typestore import Distribution
from runtime import NodeConfig
from runtime.paths import InputPath

Kind = Literal[
    "images",
    "depth",
    "segmentation",
    "clouds",
    "imu",
    "odometry",
    "poses",
    "tf",
    "estimates",
    "scores",
    "ranges",
    "pressures",
    "magnetic_fields",
    "fixes",
    "lidars",
    "clock",
    "paths",
]

EVERYTHING: tuple[Kind, ...] = Kind.__args__  # type: ignore[attr-defined]

KINDS: tuple[Kind, ...] = tuple(kind for kind in EVERYTHING if kind != "paths")
"""What tells each thing once; paths tell poses again and again."""

_Positive = Annotated[int, msgspec.Meta(ge=1)]
_Rate = Annotated[float, msgspec.Meta(gt=0)]


class Subscription(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic to hear, and what its messages become.

    Attributes:
        topic: Relative to the namespace, or with a leading slash.
        type: ``geometry_msgs/msg/PoseStamped``.
        use: ``as`` in the file: what a message becomes. ``estimate`` (from PoseStamped,
            PoseWithCovarianceStamped or Odometry), ``odometry`` (Odometry), ``velocity`` (Twist,
            TwistStamped), ``position``, ``pose`` (PoseStamped), ``image``, ``depth`` (Image),
            ``imu`` (Imu), ``camera`` (CameraInfo; the run waits for the first one, and a camera
            is announced).
        mapping: Instead: ``module:function``, which takes a message and the `Reading` and
            returns an event, or None.
        source: Of the events; if empty, the node's name and the topic.
        frame_id: If set, the frame that events name, whatever the message says.
        scale_free: Whether an estimate's unit of length is its own.
        reliable: Quality of service, as ROS shows it.
        depth: How many messages wait at most.
        rate: Messages a second at most; what comes faster is dropped.
        transient_local: Whether to hear what was said before, and is kept (``/map``,
            ``/tf_static``); a ``camera`` always does.
        wait: Seconds that the run's start waits for a ``camera``.
    """

    topic: str
    type: str
    use: str = msgspec.field(name="as", default="")
    mapping: str = ""
    source: str = ""
    frame_id: str = ""
    scale_free: bool = False
    reliable: bool = True
    depth: _Positive = 10
    rate: _Rate = 1000.0
    transient_local: bool = False
    wait: Annotated[float, msgspec.Meta(ge=0, le=86_400)] = 10.0

    def __post_init__(self) -> None:
        dds_type(self.type)
        topic_name("/", self.topic)
        if bool(self.use) == bool(self.mapping):
            raise ValueError(f'{self.topic}: expected either as = "…" or mapping = "…"')
        if self.mapping:
            _importable(self.topic, "mapping", "module:function", self.mapping)
        if self.use and (self.type, self.use) not in READERS:
            known = [f"{use} from {type_}" for type_, use in READERS]
            raise ValueError(
                f"{self.topic}: expected one of: {', '.join(known)}; "
                f"found {self.use} from {self.type}"
            )
        if self.use == "velocity" and self.frame_id not in {"", "map", "heading"}:
            raise ValueError(
                f'{self.topic}: frame_id: expected "map" or "heading" for a velocity, '
                f"found {self.frame_id!r}"
            )

    @property
    def qos(self) -> Qos:
        """Return the quality of service."""
        return Qos(reliable=self.reliable, transient_local=self.transient_local, depth=self.depth)


class OwnPublication(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic to publish beyond those that the bridge knows of.

    Attributes:
        topic: Relative to the namespace, or with a leading slash.
        type: ``sensor_msgs/msg/BatteryState``.
        event: ``module:Class`` of the events that become its messages; subclasses come too.
        mapping: ``module:function``, which takes an event and the `Writing` and returns a message
            of `type`, or None. It is called in a thread beside the loop.
        source: Take only events of this source or below it.
        reliable: Quality of service, as ROS shows it.
        transient_local: Whether late joiners get the last `depth` messages.
        depth: How many messages are kept, and how many events wait at most.
    """

    topic: str
    type: str
    event: str
    mapping: str
    source: str = ""
    reliable: bool = True
    transient_local: bool = False
    depth: _Positive = 10

    def __post_init__(self) -> None:
        dds_type(self.type)
        topic_name("/", self.topic)
        _importable(self.topic, "event", "module:Class", self.event)
        _importable(self.topic, "mapping", "module:function", self.mapping)

    @property
    def qos(self) -> Qos:
        """Return the quality of service."""
        return Qos(reliable=self.reliable, transient_local=self.transient_local, depth=self.depth)


def _importable(topic: str, what: str, form: str, found: str) -> None:
    if not re.fullmatch(r"\w+(\.\w+)*:\w+", found):
        raise ValueError(f'{topic}: {what}: expected "{form}", found {found!r}')


class Ros2BridgeConfig(NodeConfig):
    """Settings of the bridge.

    Attributes:
        domain_id: ROS_DOMAIN_ID.
        namespace: Before all topics' names that do not begin with a slash.
        node_name: As ``ros2 node list`` shows it.
        distribution: Of ROS 2, on the other side.
        keys: ``rmw_zenoh``, or ``ros2dds`` for a bridge with zenoh-plugin-ros2dds.
        connect: Zenoh endpoints; if not given, those of `zenoh_config`, or else
            ``tcp/localhost:7447``, where ``rmw_zenohd`` listens.
        listen: The same for listening; or else any port of the loopback.
        zenoh_config: A Zenoh configuration file (JSON5) for whatever else: TLS, access control,
            shared memory. What it leaves out is as without it: no multicast, for one.
        publish: What to publish.
        topics: Other names for topics, by the name that they would have.
        time: ``simulated``: stamps count from the run's start, and ``/clock`` tells the time (set
            ``use_sim_time``). ``wall``: they are shifted to the wall clock, and there is no
            ``/clock``; with the real clock only.
        clock_rate: Of ``/clock``, Hz.
        vehicle: Whose truth ``/tf`` shows; if empty, all that are announced: with the vehicle's
            name before its frames if there are several.
        tf: ``truth``, or the source of the estimates that place ``base_link`` instead.
        path_rate: Messages a second, at most, of the way that a vehicle or an estimate has come.
        path_step: Metres from one pose of a path to the next.
        path_length: Poses of a path at most; beyond that, every other is left out and the step
            doubled, so that a path always reaches back to its start.
        covariance: Publish estimates as PoseWithCovarianceStamped.
        raw: Publish images as they are.
        compressed: Publish images as ``CompressedImage``, too.
        compressed_depth: Publish depth images as compressed_depth_image_transport does, too.
        depth_max: Metres beyond which such depth is unknown.
        depth_quantization: Metres near which steps of such depth are a hundredth of the depth;
            farther away they grow with its square.
        jpeg_quality: 1 to 100.
        sensor_qos: ``best_effort`` (as ROS's sensor data) or ``reliable``, of what sensors measure.
        largest: Bytes of a message from outside at most.
        definitions: Types that ROS 2 does not come with, and the ``.msg`` file of each.
        subscriptions: What to hear.
        publications: What to publish beyond that.
    """

    domain_id: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    namespace: str = "/"
    node_name: str = "visnav"
    distribution: Distribution = "jazzy"
    keys: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"
    connect: tuple[str, ...] | None = None
    listen: tuple[str, ...] | None = None
    zenoh_config: InputPath = ""
    publish: tuple[Kind, ...] = EVERYTHING
    topics: dict[str, str] = msgspec.field(default_factory=dict)
    time: Literal["simulated", "wall"] = "simulated"
    clock_rate: _Rate = 100.0
    vehicle: str = ""
    tf: str = "truth"
    path_rate: _Rate = 2.0
    path_step: _Rate = 0.05
    path_length: Annotated[int, msgspec.Meta(ge=3, le=1_000_000)] = 1000
    covariance: bool = False
    raw: bool = True
    compressed: Literal["", "jpeg", "png"] = ""
    compressed_depth: bool = False
    depth_max: _Rate = 10.0
    depth_quantization: _Rate = 100.0
    jpeg_quality: Annotated[int, msgspec.Meta(ge=1, le=100)] = 90
    sensor_qos: Literal["best_effort", "reliable"] = "best_effort"
    largest: _Positive = 64 * 1024 * 1024
    definitions: dict[str, InputPath] = msgspec.field(default_factory=dict)
    subscriptions: tuple[Subscription, ...] = ()
    publications: tuple[OwnPublication, ...] = ()

    def __post_init__(self) -> None:
        if not self.namespace.startswith("/"):
            raise ValueError(f"namespace: expected a leading slash, found {self.namespace!r}")
        if "/" in self.node_name:
            raise ValueError(f"node_name: expected no slash, found {self.node_name!r}")
        if self.namespace != "/":
            _checked("namespace", self.namespace)
        _checked("node_name", f"/{self.node_name}")
        for given, name in self.topics.items():
            _checked(f'topics: "{given}"', name)
        for type_ in self.definitions:
            try:
                dds_type(type_)
            except ValueError as error:
                raise ValueError(f"definitions: {error}") from None


def _checked(where: str, name: str) -> None:
    try:
        topic_name("/", name)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
