"""MAVLink for outside programs: MAVSDK, ground stations, companion computers.

    `node`       settings and ports: the vehicle of the run; PX4, if that flies it
    `endpoint`   dispatch of received messages, and periodic ones
    `links`      sockets, parsers, signing, floods      bytes ↔ messages
    `vehicle`    what is known of the vehicle           events → telemetry, missions, parameters
    `flight`     modes, commands, offboard              messages → set-points

Facts are of MAVLink's common dialect (mavlink.io), and of PX4's conventions, which programs expect.
"""

from visnav_mavlink.node import Mavlink, Px4, Px4Config
from visnav_mavlink.settings import MavlinkConfig

__all__ = ["Mavlink", "MavlinkConfig", "Px4", "Px4Config"]
