"""A door for MAVLink's programs: MAVSDK, ground stations, companion computers.

    `node`       ports: the vehicle of the run
    `door`       who gets which message
    `links`      sockets, parsers, signing, floods      bytes ↔ messages
    `vehicle`    what is known of the vehicle           events → telemetry
    `flight`     modes, commands, offboard              messages → set-points
    `missions`   missions and parameters, their protocols
    `px4`        the other way round: PX4 flies the vehicle, by `hil`

Facts are of MAVLink's common dialect (mavlink.io), and of PX4's conventions, which programs expect.
"""

from nodes.mavlink.node import Mavlink
from nodes.mavlink.px4 import Px4
from nodes.mavlink.settings import MavlinkConfig, Px4Config

__all__ = ["Mavlink", "MavlinkConfig", "Px4", "Px4Config"]
