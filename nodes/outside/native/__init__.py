"""The native interface: images and IMU samples for a program that runs outside, without ROS.

    client          the program's side: one file of standard library and numpy, to be copied
    visnav_link.hpp the same for C++17; ``python -m nodes.outside.native`` prints the folder that it
    is in endpoint        the run's side
    answers         what comes from the program, checked
    description     what the program is told about cameras and IMU

docs/reference/link.md has the protocol, byte by byte.
"""

from nodes.outside.native.answers import LinkAnswer, LinkError, describe
from nodes.outside.native.endpoint import Endpoint

__all__ = ["Endpoint", "LinkAnswer", "LinkError", "describe"]
