"""Who hears whom: a pure function of the nodes, made before the first event.

Every output of a node is connected to the inputs and handlers of all *other* nodes that know its
type of event, in the order of the nodes in the file and of the declarations in each node.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from runtime.node import Node, senders
from runtime.sender import Listener, Tap
from runtime.steps import Fault

Sources = Mapping[str, Mapping[str, str]]
"""Node to port to the source that the port is narrowed to."""


def listeners(node: Node[Any], sources: Mapping[str, str]) -> list[Listener]:
    """Return a node's inputs and handlers, in order."""
    found = []
    for name in node.declared.listening:
        handles = node.declared.handlers.get(name)
        if handles is not None:
            source = sources.get(name, handles.source)
            found.append(Listener(node.name, getattr(node, name), handles.events, source))
        else:
            declared = node.declared.inputs[name]
            stream = getattr(node, name)
            source = sources.get(name, declared.source)
            found.append(Listener(node.name, stream.offer, (declared.event,), source, stream))
    return found


def connect(
    nodes: Sequence[Node[Any]],
    sources: Sources,
    taps: Iterable[Tap] = (),
    fault: Fault | None = None,
    last: Iterable[Listener] = (),
) -> None:
    """Freeze every output's listeners. May be called again when nodes come or go.

    Args:
        nodes: In the order in which they hear events.
        sources: Ports narrowed by the file.
        taps: See every event first.
        fault: Told of listeners that raise; without it, `send` raises what they do.
        last: Listeners after all nodes.
    """
    heard = [listener for n in nodes for listener in listeners(n, sources.get(n.name, {}))]
    heard += last
    for node in nodes:
        others = [listener for listener in heard if listener.node != node.name]
        for sender in senders(node).values():
            sender.connect(others, taps, fault)


def edges(nodes: Sequence[tuple[str, type[Node[Any]]]]) -> list[tuple[str, str, str, str, str]]:
    """Return the graph as (sender, output, event, receiver, input), from the classes alone."""
    found = []
    for sender, sending in nodes:
        for output, declared in sending.declared.outputs.items():
            for receiver, receiving in nodes:
                if receiver == sender:
                    continue
                for port, events in heard_types(receiving).items():
                    listener = Listener(receiver, _nothing, events)
                    if listener.may_hear(declared.event):
                        found.append((sender, output, declared.event.__name__, receiver, port))
    return found


def heard_types(cls: type[Node[Any]]) -> dict[str, tuple[Any, ...]]:
    """Return the event types of a class's inputs and handlers."""
    return {
        name: cls.declared.handlers[name].events
        if name in cls.declared.handlers
        else (cls.declared.inputs[name].event,)
        for name in cls.declared.listening
    }


def unconnected(nodes: Sequence[tuple[str, type[Node[Any]]]]) -> list[tuple[str, str, str]]:
    """Return the inputs that no node can send to, as (node, port, event).

    A handler that is never called is nothing to warn of: most nodes can do more than is asked.
    """
    connected = {(receiver, port) for *_, receiver, port in edges(nodes)}
    return [
        (name, port, " or ".join(e.__name__ for e in events))
        for name, cls in nodes
        for port, events in heard_types(cls).items()
        if port in cls.declared.inputs and (name, port) not in connected
    ]


def _nothing(_: Any) -> None:
    pass
