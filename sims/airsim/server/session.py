"""Methods that are of no vehicle: the handshake, and what the server says of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sims.airsim.server.methods import rpc

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer


class Session:
    """The handshake."""

    def __init__(self, server: AirsimServer) -> None:
        self._server = server

    @rpc("ping")
    def ping(self) -> bool:
        """Answer ``True``."""
        return True

    @rpc("getServerVersion")
    def server_version(self) -> int:
        """Return 4, with which the clients of AirSim and of Cosys-AirSim are content."""
        return 4

    @rpc("getMinRequiredClientVersion")
    def least_client_version(self) -> int:
        """Return 1, with which the clients of AirSim and of Cosys-AirSim are content."""
        return 1

    @rpc("listVehicles")
    def vehicles(self) -> list[str]:
        """Return the names of all vehicles, sorted."""
        return sorted(self._server.vehicles)
