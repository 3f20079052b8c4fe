"""Runtime: nodes as coroutines on a single event loop, with typed, awaitable channels.

Read the core in this order:

- Writing a node: `node` (its `host` is the run), with its `channels.declarations` of `ports` and
  `bundles`.
- Delivery of events: `channels.sender` and `streams`, as `run.graph` has connected them, through
  `channels.links` if imperfect; who may send in which name: `channels.sources`; its speed:
  `channels.tasks`, `run.event_loop`.
- Time: `time.clock`, `lockstep`, `stepping`; limits in `time.real_time`.
- A run: `run.node_runner`, `run_state`, `node_services` (what nodes ask for, with the `instruments`
  of observers), `parameters`, `supervisor`, `execute`; `watchdogs` find the node that blocks the
  loop or holds up the run.
- Results: the digest in `channels.wire`, `summary` (made by `run.summarise`), `run.results`,
  `logs`.
- `config`: the file, and changes during a run; `units`, `paths` and `changeable` are types of
  settings.
- `workers`: objects in processes of their own. `channels.hold`, `answers`: outside systems.
- `channels.wire`: events as bytes. `run.others`: other processes of a run. `figures`: those of a
  verdict.

`testing` is for tests of nodes. `tools` is no part of the core: the command line, the monitor,
tracing and sweeps.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runtime.changeable import Changeable
    from runtime.channels.bundles import Bundle
    from runtime.channels.ports import Input, Output, every, on
    from runtime.channels.streams import Stream
    from runtime.errors import RefusedError, VisnavError
    from runtime.node import Node, NodeConfig
    from runtime.time.clock import Clock, Tick
    from runtime.units import Duration
    from runtime.workers.worker import Worker

__all__ = [
    "Bundle", "Changeable", "Clock", "Duration", "Input", "Node", "NodeConfig", "Output",
    "RefusedError", "Stream", "Tick", "VisnavError", "Worker", "every", "on",
]  # fmt: skip

_PLACES = {
    "changeable": ("Changeable",),
    "channels.bundles": ("Bundle",),
    "channels.ports": ("Input", "Output", "every", "on"),
    "channels.streams": ("Stream",),
    "errors": ("RefusedError", "VisnavError"),
    "node": ("Node", "NodeConfig"),
    "time.clock": ("Clock", "Tick"),
    "units": ("Duration",),
    "workers.worker": ("Worker",),
}


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` when it is first asked for, and what it needs, no more."""
    for module, names in _PLACES.items():
        if name in names:
            globals()[name] = value = getattr(import_module(f"{__name__}.{module}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
