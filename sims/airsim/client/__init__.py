"""A node in the place of the simulator, which feeds a run from a server of AirSim's."""

from sims.airsim.client.node import AirsimClient
from sims.airsim.client.remote import AirsimClientConfig, RemoteCamera

__all__ = ["AirsimClient", "AirsimClientConfig", "RemoteCamera"]
