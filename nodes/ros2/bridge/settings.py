"""The bridge's settings in a run's file, and imports of the user's own mappings and events."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec

from events import Event
from nodes.ros2.messages.mappings import READERS, described_uses
from nodes.ros2.messages.topics import (
    Positive,
    PublishingConfig,
    Qos,
    Rate,
    check_name,
    dds_type,
    topic_name,
)
from nodes.ros2.messages.typestore import Distribution
from runtime.channels.hold import HoldConfig
from runtime.paths import InputPath
from runtime.units import Duration, Latency

ServiceGroup = Literal["simulation", "vehicle"]


class Subscription(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a subscription: a topic of ROS, and the events from its messages.

    Attributes:
        topic: Relative to the namespace, or with a leading slash.
        type: Type of the messages: ``geometry_msgs/msg/PoseStamped``.
        use: ``as`` in the file: what a message becomes. {uses}.
        mapping: Instead of `use`: ``module:function``, called with a message and a
            `MessageContext`; returns an event, or None.
        source: Source of the events; if empty, the node's name and the topic.
        vehicle: Vehicle for a ``velocity``, ``position`` or ``pose``; empty for the only one.
        frame_id: Frame of the events; if empty, the message's.
        scale_free: Whether an estimate's unit of length is arbitrary.
        reliable: Quality of service, as ROS shows it.
        depth: Messages that wait at most.
        max_rate: Messages a second at most; the rest is dropped.
        transient_local: Whether to get kept messages of before (``/map``, ``/tf_static``); a
            ``camera`` always does.
        timeout: Seconds that the start waits for a ``camera``, or for the estimator that
            `answers_to` images.
        answers_to: Source of the images answered by an ``estimate`` or ``done`` of the same stamp.
            Simulated time waits for each answer, and nothing is dropped; `depth` and `max_rate` do
            not apply.
        latency: Time on the run's clock from the arrival of an image to its answer's event.
        hold: Longest wait for an answer, and its consequence.
        needs: Topics of this node to which the estimator must subscribe before the first image; if
            empty, that of the images.
    """

    topic: str
    type: str
    use: str = msgspec.field(name="as", default="")
    mapping: str = ""
    source: str = ""
    vehicle: str = ""
    frame_id: str = ""
    scale_free: bool = False
    reliable: bool = True
    depth: Positive = 10
    max_rate: Rate = 1000.0
    transient_local: bool = False
    timeout: Annotated[float, msgspec.Meta(ge=0, le=86_400)] = 10.0
    answers_to: str = ""
    latency: Latency = Latency(0.015)  # immutable
    hold: HoldConfig = HoldConfig()
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        dds_type(self.type)
        topic_name("/", self.topic)
        if bool(self.use) == bool(self.mapping):
            raise ValueError(f'{self.topic}: expected either as = "…" or mapping = "…"')
        if self.mapping:
            _importable(self.topic, "mapping", "module:function", self.mapping)
        readers = [key for key, row in READERS.items() if not row.bags]
        if self.use and (self.type, self.use) not in readers:
            known = [f"{use} from {type_}" for type_, use in readers]
            raise ValueError(
                f"{self.topic}: expected one of: {', '.join(known)}; "
                f"found {self.use} from {self.type}"
            )
        if self.use == "velocity" and self.frame_id not in {"", "map", "heading"}:
            raise ValueError(
                f'{self.topic}: frame_id: expected "map" or "heading" for a velocity, '
                f"found {self.frame_id!r}"
            )
        if self.answers_to and (self.use not in {"estimate", "done"} or not self.reliable):
            raise ValueError(
                f'{self.topic}: answers_to: expected as = "estimate" or "done", and reliable, '
                f'found as = "{self.use}", reliable = {str(self.reliable).lower()}'
            )
        if not self.answers_to and (self.needs or self.hold != HoldConfig()):
            raise ValueError(
                f"{self.topic}: needs, hold: expected answers_to beside them, found none"
            )
        if self.use == "done" and not self.answers_to:
            raise ValueError(f'{self.topic}: as = "done": expected answers_to, found none')

    @property
    def qos(self) -> Qos:
        """Return the quality of service."""
        return Qos(reliable=self.reliable, transient_local=self.transient_local, depth=self.depth)

    def is_completed_by(self, other: Subscription) -> bool:
        """Return whether `other` has the ``done`` messages of this estimate."""
        return (
            (self.use, other.use) == ("estimate", "done")
            and self.answers_to == other.answers_to
            and other.source in {"", self.source}
        )


Subscription.__doc__ = str(Subscription.__doc__).replace("{uses}", described_uses())


class OwnPublication(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a topic to publish besides the bridge's own.

    Attributes:
        topic: Relative to the namespace, or with a leading slash.
        type: Type of the messages: ``sensor_msgs/msg/BatteryState``.
        event: Type of the events, ``module:Class``, with its subclasses.
        mapping: ``module:function``, called beside the loop with an event and a `MessageBuilder`;
            returns a message of `type`, or None.
        source: Take only events of this source or below it.
        reliable: Quality of service, as ROS shows it.
        transient_local: Whether late joiners get the last `depth` messages.
        depth: Messages kept, and events waiting, at most.
    """

    topic: str
    type: str
    event: str
    mapping: str
    source: str = ""
    reliable: bool = True
    transient_local: bool = False
    depth: Positive = 10

    def __post_init__(self) -> None:
        dds_type(self.type)
        topic_name("/", self.topic)
        _importable(self.topic, "event", "module:Class", self.event)
        _importable(self.topic, "mapping", "module:function", self.mapping)

    @property
    def qos(self) -> Qos:
        """Return the quality of service."""
        return Qos(reliable=self.reliable, transient_local=self.transient_local, depth=self.depth)


def _importable(topic: str, setting: str, form: str, path: str) -> None:
    if not re.fullmatch(r"\w+(\.\w+)*:\w+", path):
        raise ValueError(f'{topic}: {setting}: expected "{form}", found {path!r}')


class Ros2BridgeConfig(PublishingConfig):
    """Settings of the bridge, besides those of `PublishingConfig`.

    Attributes:
        domain_id: ROS_DOMAIN_ID.
        node_name: As ``ros2 node list`` shows it.
        distribution: Of ROS 2, on the other side.
        keys: ``rmw_zenoh``, or ``ros2dds`` for a bridge with zenoh-plugin-ros2dds.
        connect: Zenoh endpoints to connect to; by default those of `zenoh_config`, else
            ``tcp/localhost:7447`` (``rmw_zenohd``).
        listen: The same for listening; by default any port of the loopback.
        zenoh_config: A Zenoh configuration file (JSON5) for other settings: TLS, access control,
            shared memory; defaults stay, as no multicast.
        clock_rate: Messages a second on ``/clock``, on the run's clock.
        max_message_size: Bytes of a message from outside, at most.
        definitions: Message types missing in ROS 2, and the ``.msg`` file of each.
        subscriptions: Topics of ROS 2 whose messages become events.
        publications: Topics published by functions of the user's own.
        services: Groups of services. ``simulation``: simulation_interfaces, to pause, step and end
            the run. ``vehicle``: ``std_srvs/Trigger`` as ``arm``, ``disarm``, ``take_off`` and
            ``land`` below each vehicle's name.
        step: Simulated time of one step of ``step_simulation`` and ``simulate_steps``.
        paused: Whether simulated time stands from the run's start until a service resumes it.
    """

    domain_id: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    node_name: str = "visnav"
    distribution: Distribution = "jazzy"
    keys: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"
    connect: tuple[str, ...] | None = None
    listen: tuple[str, ...] | None = None
    zenoh_config: InputPath = ""
    clock_rate: Rate = 100.0
    max_message_size: Positive = 64 * 1024 * 1024
    definitions: dict[str, InputPath] = msgspec.field(default_factory=dict)
    subscriptions: tuple[Subscription, ...] = ()
    publications: tuple[OwnPublication, ...] = ()
    services: tuple[ServiceGroup, ...] = ()
    step: Duration = Duration(0.001)  # immutable
    paused: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.services and self.keys != "rmw_zenoh":
            raise ValueError(f'services: expected keys = "rmw_zenoh" for them, found "{self.keys}"')
        if self.step < 1e-9:
            raise ValueError(f"step: expected 1 ns or more, found {self.step:g} s")
        if self.paused and "simulation" not in self.services:
            raise ValueError('paused: expected services = ["simulation"] too, to let time go on')
        if "/" in self.node_name:
            raise ValueError(f"node_name: expected no slash, found {self.node_name!r}")
        check_name("node_name", f"/{self.node_name}")
        for type_ in self.definitions:
            try:
                dds_type(type_)
            except ValueError as error:
                raise ValueError(f"definitions: {error}") from None
        if any(s.answers_to for s in self.subscriptions) and self.keys != "rmw_zenoh":
            raise ValueError(
                'answers_to: expected keys = "rmw_zenoh", whose messages are numbered and whose '
                f'nodes are seen to go, found keys = "{self.keys}"'
            )
        for done in (s for s in self.subscriptions if s.use == "done"):
            if len([s for s in self.subscriptions if s.is_completed_by(done)]) != 1:
                raise ValueError(
                    f'{done.topic}: as = "done": expected one estimate with the same answers_to, '
                    "and of the same source if there are several"
                )


def import_mapping(topic: str, path: str) -> Callable[[Any, Any], Any]:
    """Import a function ``module:function``; a `ValueError` if there is no such function."""
    imported = _imported(topic, "mapping", path)
    if not callable(imported):
        raise ValueError(f"{topic}: mapping: expected a function, found {imported!r}")
    function: Callable[[Any, Any], Any] = imported
    return function


def event_type(publication: OwnPublication) -> type[Event]:
    """Import the type of a publication's events; a `ValueError` if there is none."""
    kind = _imported(publication.topic, "event", publication.event)
    if not (isinstance(kind, type) and issubclass(kind, Event)):
        raise ValueError(f"{publication.topic}: event: expected a type of event, found {kind!r}")
    return kind


def _imported(topic: str, setting: str, path: str) -> Any:
    try:
        return pkgutil.resolve_name(path)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"{topic}: {setting}: expected something that can be imported, found {path!r}: {error}"
        ) from None
