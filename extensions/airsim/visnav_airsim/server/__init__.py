"""Server for scripts written for AirSim."""

from visnav_airsim.server.node import AirsimServer, AirsimServerConfig

__all__ = ["AirsimServer", "AirsimServerConfig"]
