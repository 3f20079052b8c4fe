"""A server for scripts that are written for AirSim."""

from sims.airsim.server.node import AirsimServer, AirsimServerConfig

__all__ = ["AirsimServer", "AirsimServerConfig"]
