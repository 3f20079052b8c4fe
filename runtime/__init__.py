"""The runtime: nodes as coroutines on one event loop that talk through typed, awaitable channels.

Read the core in this order:

- What an author writes: `node` (its `host` is the run), with its declarations in `ports`, `bundles`
  and `declarations`.
- How an event gets from node to node: `sender`, `streams`, `links`, `graph`; and what makes it
  quick: `tasks`, `task_factory`.
- Time: `schedule`, `clock`, `lockstep`, `real_clock`, `time_limits`.
- A run: `node_runner`, `node_host`, `startup`, `run_state`, `supervisor`, `execute`, `event_loop`.
- What a run leaves: `digest`, `summary` (with `part_summaries`, `environment`), `results`, `logs`.
- `config`: the file; `units` and `paths` are types of settings.
- `workers`: objects in processes of their own. `hold`, `owed`, `answers`: systems that are outside.
- `watchdogs`, `code_location`: who blocks the loop or holds up the run.
- `parameter_server`: settings that change in a run. `instruments`: hooks for who looks on.
- `wire` and `peers`: events as bytes, and a run in several processes.

`testing` is for tests of nodes. `tools` is no part of the core: the command line, the monitor,
tracing and sweeps.
"""

import signal as _signal
import sys as _sys

# Until `runtime.__main__` has taken over, Ctrl-C ends the process without a traceback.
if _sys.argv[:1] == ["-m"] and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)

from runtime import neighbours as _neighbours  # noqa: F401  # first, as it checks `events`
from runtime.channels.bundles import Bundle
from runtime.channels.ports import Input, Output, every, on
from runtime.channels.streams import Stream
from runtime.config.parameters import Changeable
from runtime.errors import RefusedError, VisnavError
from runtime.node import Node, NodeConfig
from runtime.time.clock import Clock
from runtime.time.schedule import Tick
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
