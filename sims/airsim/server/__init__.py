"""Server for scripts written for AirSim."""

from sims.airsim.server.node import AirsimServer, AirsimServerConfig

__all__ = ["AirsimServer", "AirsimServerConfig"]
