"""External program of a run: started, fed, judged and ended by the run.

`node` is the node; `launch` says where and with what the program is started, and what is written
for it; `program` is the process and what feeds it; `guard` ends all that it has started.
"""

from nodes.outside.process.node import Process

__all__ = ["Process"]
