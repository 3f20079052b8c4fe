"""The runtime: nodes as coroutines on one event loop, talking through awaitable channels.

Read in this order: `node` (what an author writes), `ports` and `bundles` (what it declares),
`sender`, `streams` and `links` (how an event gets from one node to another), `steps` (why that is
quick), `schedule`, `clock`, `lockstep` and `realtime` (time), `worker` and `shared` (slow work),
`graph`, `life`, `supervisor`, `execute`, `driver`, `results` and `summary` (a run, its end, its
folder), `config` and `paths` (the file), `preflight` (what `check` says of it), `wire` and `peers`
(a run in several processes). `parameters` and `changing` (settings that change in a run),
`watchdog`, `standstill` and `places` (who holds it up), `costs`, `probes`, `tracing` and `monitor`
(looking on) can wait. `testing` is for tests of nodes.
"""

from runtime import neighbours as _neighbours  # noqa: F401  # first, as it checks `events`
from runtime.bundles import Bundle
from runtime.clock import Clock
from runtime.config.parameters import Changeable
from runtime.errors import RefusedError, VisnavError
from runtime.node import Node, NodeConfig
from runtime.ports import Input, Output, every, on
from runtime.schedule import Tick
from runtime.streams import Stream
from runtime.units import Duration
from runtime.workers.worker import Worker

__all__ = [
    "Bundle",
    "Changeable",
    "Clock",
    "Duration",
    "Input",
    "Node",
    "NodeConfig",
    "Output",
    "RefusedError",
    "Stream",
    "Tick",
    "VisnavError",
    "Worker",
    "every",
    "on",
]
