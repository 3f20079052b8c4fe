"""Runtime: nodes as coroutines on a single event loop, with typed, awaitable channels.

Read the core in this order:

- Writing a node: `node` (its `host` is the run), with its declarations in `channels.ports` and
  `channels.bundles`.
- Delivery of events: `channels.sender` and `streams`, as `run.graph` has connected them;
  its speed: `channels.tasks`, `run.event_loop`.
- Time: `time.clock` and `lockstep`.
- A run: `run.node_runner`, `run_state` (with the instruments of observers), `supervisor`,
  `execute`; `watchdogs` find the node that blocks the loop or holds up the run.
- Results: the digest in `channels.wire`, `summary` (made by `run.summarise`), `run.results`,
  `logs`.
- `config`: the file, and changes during a run; `units` and `paths` are types of settings.
- `workers`: objects in processes of their own. `channels.hold`, `answers`: outside systems.
- `channels.wire`: events as bytes. `peers`: a run in several processes. `figures`: those of a
  verdict.

`testing` is for tests of nodes. `tools` is no part of the core: the command line, the monitor,
tracing and sweeps.
"""

import signal as _signal
import sys as _sys

# Until `runtime.__main__` has taken over, Ctrl-C ends the process without a traceback.
if _sys.argv[:1] == ["-m"] and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)

from runtime import extras as _extras  # noqa: F401  # first, as it checks `events`
from runtime.channels.bundles import Bundle
from runtime.channels.ports import Input, Output, every, on
from runtime.channels.streams import Stream
from runtime.config.parameters import Changeable
from runtime.errors import RefusedError, VisnavError
from runtime.node import Node, NodeConfig
from runtime.time.clock import Clock, Tick
from runtime.units import Duration
from runtime.workers.worker import Worker

__all__ = [
    "Bundle", "Changeable", "Clock", "Duration", "Input", "Node", "NodeConfig", "Output",
    "RefusedError", "Stream", "Tick", "VisnavError", "Worker", "every", "on",
]  # fmt: skip
