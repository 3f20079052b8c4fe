"""Client node in place of the simulator: feeds a run from an AirSim server."""

from sims.airsim.client.node import AirsimClient
from sims.airsim.client.remote import AirsimClientConfig, RemoteCamera

__all__ = ["AirsimClient", "AirsimClientConfig", "RemoteCamera"]
