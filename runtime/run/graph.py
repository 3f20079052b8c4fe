"""Connections from outputs to listeners: a pure function of the nodes, before the first event.

Every output of a node is connected to the inputs and handlers of all *other* nodes that know its
type of event, in the order of the nodes in the file and of the declarations in each node.
"""

from __future__ import annotations

import dis
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

from events import (
    Announcement,
    CameraAnnouncement,
    DepthImage,
    Event,
    Image,
    LidarAnnouncement,
    LidarScan,
    Odometry,
    PoseEstimate,
    PoseStamped,
    TrajectoryEstimate,
    VehicleAnnouncement,
)
from runtime.channels.links import Link
from runtime.channels.sender import Deliver, Listener, Tap
from runtime.channels.sources import SourceOwners
from runtime.channels.tasks import Fault
from runtime.config.model import NodeSpec
from runtime.node import Node, senders

Links = Mapping[str, Mapping[str, Link]]  # link before each port, by node and port

Wrap = Callable[[str, Deliver], Deliver]
"""Wrapper of handlers: from a node's name and a handler to the function called instead."""


def unwrapped(_: str, deliver: Deliver) -> Deliver:
    """Return a handler unchanged."""
    return deliver


def listeners(
    node: Node[Any],
    links: Mapping[str, Link],
    fault: Fault | None = None,
    wrap: Wrap = unwrapped,
) -> list[Listener]:
    """Return a node's inputs, fields of bundles and handlers, in order."""
    receivers = []
    sources = node.sources

    def add(
        port: str, deliver: Deliver, events: Any, source: str | None, stream: Any = None
    ) -> None:
        if port in links:
            deliver, stream = _linked(links[port], wrap(node.name, deliver), fault), None
        elif stream is None:  # a stream's reader is wrapped already, with its task
            deliver = wrap(node.name, deliver)
        receivers.append(Listener(node.name, deliver, events, source, stream))

    for name in node.declared.listening:
        if name in node.declared.handlers:
            handles = node.declared.handlers[name]
            add(name, getattr(node, name), handles.events, sources.get(name, handles.source))
        elif name in node.declared.bundles:
            matcher, declared = getattr(node, name), node.declared.bundles[name]
            matcher.deliver = matcher.stream.offer
            if name in links:
                matcher.deliver = _linked(links[name], matcher.deliver, fault)
            for field, slot in matcher.slots.items():
                port = f"{name}.{field}"
                of_all = None if slot.kind == "all" else sources.get(name, declared.source)
                add(port, slot.add, (declared.fields[field].event,), sources.get(port, of_all))
        else:
            input_, stream = node.declared.inputs[name], getattr(node, name)
            source = sources.get(name, input_.source)
            add(name, stream.offer, (input_.event,), source, stream)
    return receivers


def connect(
    nodes: Sequence[Node[Any]],
    links: Links | None = None,
    taps: Iterable[Tap] = (),
    fault: Fault | None = None,
    last: Iterable[Listener] = (),
    elsewhere: Callable[[str], Iterable[Listener]] = lambda _: (),
    wrap: Wrap = unwrapped,
    owners: SourceOwners | None = None,
    deaf: Collection[str] = (),
) -> list[Listener]:
    """Freeze the listeners of every output, and return all listeners of this process.

    May be called again when nodes come or go.

    Args:
        nodes: In the order in which they receive events.
        fault: Called with listeners that raise; without it, `send` raises what they do.
        elsewhere: Given ``node.port``, returns its listeners in other processes.
        wrap: Puts something round the nodes' handlers.
        deaf: Names of nodes that may send, and receive nothing any more.
    """
    connected = [
        listener
        for node in nodes
        if node.name not in deaf
        for listener in listeners(node, (links or {}).get(node.name, {}), fault, wrap)
    ]
    connected += last
    for node in nodes:
        others = [listener for listener in connected if listener.node != node.name]
        for sender in senders(node).values():
            sender.connect([*elsewhere(sender.name), *others], taps, fault, owners)
    return connected


def truth_receivers(
    listeners: Iterable[Listener], announcements: Iterable[Announcement]
) -> set[str]:
    """Return the nodes that receive true poses of announced vehicles or cameras."""
    truths = [
        (Odometry if isinstance(a, VehicleAnnouncement) else PoseStamped, a.source)
        for a in announcements
        if isinstance(a, VehicleAnnouncement | CameraAnnouncement)
    ]
    return {
        listener.node
        for listener in listeners
        if any(listener.receives(*truth) for truth in truths)
    } - {"run"}


def sensors_read(
    listeners: Iterable[Listener], announcements: Iterable[Announcement]
) -> dict[str, set[str]]:
    """Return the announced cameras and lidars whose images and scans each node receives."""
    events: dict[type[Announcement], tuple[type[Event], ...]] = {
        CameraAnnouncement: (Image, DepthImage),
        LidarAnnouncement: (LidarScan,),
    }
    sources = [(kind, a.source) for a in announcements for kind in events.get(type(a), ())]
    read: dict[str, set[str]] = {}
    for listener in listeners:
        for kind, source in sources:
            # Grey images beside coloured ones have a source of their own, below the camera's.
            if listener.receives(kind, source) or listener.receives(kind, f"{source}/grey"):
                read.setdefault(listener.node, set()).add(source)
    return read


_OURS = frozenset({"nodes", "sims"})  # rooms whose bridges and replays are known to make nothing up


def relays(cls: type[Node[Any]]) -> bool:
    """Return whether a node's estimates are those of others; see `Node.relays_estimates`."""
    from runtime.extras import is_ours

    package = cls.__module__.partition(".")[0]
    return cls.relays_estimates and (package in _OURS or is_ours(package))


def sends_estimates(node: Node[Any]) -> bool:
    """Return whether a node has sent an estimated pose or trajectory."""
    return any(
        issubclass(event, PoseEstimate | TrajectoryEstimate)
        for sender in senders(node).values()
        for event in sender.sent()
    )


def edges(nodes: Sequence[tuple[str, type[Node[Any]]]]) -> list[tuple[str, str, str, str, str]]:
    """Return the graph as (sender, output, event, receiver, input), from the classes alone."""
    graph = []
    for sender, sending in nodes:
        for output, declared in sending.declared.outputs.items():
            for receiver, receiving in nodes:
                if receiver == sender:
                    continue
                for port, events in input_types(receiving).items():
                    listener = Listener(receiver, _nothing, events)
                    if listener.may_receive(declared.event):
                        graph.append((sender, output, declared.event.__name__, receiver, port))
    return graph


def edges_of(specs: Sequence[NodeSpec]) -> list[tuple[str, str, str, str, str]]:
    """Return the graph of a file's nodes, without outputs that their settings leave unused."""
    by_name = {spec.name: spec for spec in specs}

    def used(sender: str, output: str) -> bool:
        when = by_name[sender].node.declared.outputs[output].when
        return not when or bool(getattr(by_name[sender].config, when))

    graph = edges([(spec.name, spec.node) for spec in specs])
    return [edge for edge in graph if used(edge[0], edge[1])]


def input_types(cls: type[Node[Any]]) -> dict[str, tuple[Any, ...]]:
    """Return the event types of a class's inputs, fields of bundles and handlers."""
    types: dict[str, tuple[Any, ...]] = {}
    for name in cls.declared.listening:
        if name in cls.declared.handlers:
            types[name] = cls.declared.handlers[name].events
        elif name in cls.declared.bundles:
            fields = cls.declared.bundles[name].fields
            types |= {f"{name}.{field}": (member.event,) for field, member in fields.items()}
        else:
            types[name] = (cls.declared.inputs[name].event,)
    return types


def unconnected(nodes: Sequence[tuple[str, type[Node[Any]]]]) -> list[tuple[str, str, str]]:
    """Return the inputs without any possible sender, as (node, port, event).

    A handler that is never called is nothing to warn of: most nodes can do more than is asked.
    """
    connected = {(receiver, port) for *_, receiver, port in edges(nodes)}
    return [
        (name, port, " or ".join(e.__name__ for e in events))
        for name, cls in nodes
        for port, events in input_types(cls).items()
        if port not in cls.declared.handlers
        and (name, port) not in connected
        and port not in cls.declared.optional_fields()
    ]


def circles(nodes: Sequence[tuple[str, type[Node[Any]]]]) -> list[str]:
    """Return circles of handlers, each always sending an event handled by the next."""
    after = {
        (name, handler): [
            (f"{name}.{output} → {other}.{another}", (other, another))
            for output in _always_sends(cls, handler)
            for other, receiving in nodes
            for another, handles in receiving.declared.handlers.items()
            if other != name
            and handles.source is None
            and issubclass(cls.declared.outputs[output].event, handles.events)
        ]
        for name, cls in nodes
        for handler in cls.declared.handlers
    }
    unique: dict[frozenset[str], str] = {}

    def follow(place: tuple[str, str], way: dict[tuple[str, str], str]) -> None:
        for step, following in after[place]:
            if following in way:
                steps = [*way.values(), step]
                steps = steps[[*way].index(following) + 1 :]
                unique.setdefault(frozenset(steps), ", ".join(steps))
            elif following > next(iter(way)):  # else it was found from there
                follow(following, {**way, following: step})

    for place in after:
        follow(place, {place: ""})
    return list(unique.values())


def _always_sends(cls: type[Node[Any]], handler: str) -> list[str]:
    """Return the outputs always used by a handler; none if there are branches."""
    code = list(dis.get_instructions(inspect.unwrap(getattr(cls, handler))))
    names = {op.argval for op in code if op.opname in {"LOAD_ATTR", "LOAD_METHOD"}}
    if "send" not in names or any(op.is_jump_target for op in code):
        return []
    return [output for output in cls.declared.outputs if output in names]


def _linked(link: Link, deliver: Deliver, fault: Fault | None) -> Deliver:
    """Put a link before a port; errors of delayed deliveries go to `fault`, too."""
    return link.to(deliver, None if fault is None else lambda error: fault(deliver, error))


def _nothing(_: Any) -> None:
    pass
