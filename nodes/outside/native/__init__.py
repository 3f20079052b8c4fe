"""Native interface: images, measurements and estimates for an external program, without ROS.

`client` is the program's side, one file of standard library and numpy, to be copied, and
``visnav_link.hpp`` the same for C++17; ``python -m nodes.outside.native`` prints the folder that
both are in. `endpoint` is the run's side, `answers` checks what comes from the program and tells it
of the run. docs/reference/link.md has the protocol, byte by byte.
"""

from nodes.outside.native.answers import (
    LinkAnswer,
    LinkError,
    LinkOrder,
    LinkTrajectory,
    describe,
)
from nodes.outside.native.endpoint import Endpoint

__all__ = ["Endpoint", "LinkAnswer", "LinkError", "LinkOrder", "LinkTrajectory", "describe"]
