"""A program that runs beside the run: started with it, fed by it, judged, and ended with it.

settings        what stands in the file
launch, files   where and with what the program is started, and what is written for it
program, guard  the process, and the end of all that it has started
exposures       the images of one exposure, put together
link_feed       what is sent through `nodes.outside.native`, and the answers
"""

from nodes.outside.process.node import Process

__all__ = ["Process"]
