"""Client node in place of the simulator: feeds a run from an AirSim server."""

from visnav_airsim.client.node import AirsimClient
from visnav_airsim.client.remote import AirsimClientConfig, RemoteCamera

__all__ = ["AirsimClient", "AirsimClientConfig", "RemoteCamera"]
