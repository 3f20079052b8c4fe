"""Methods that are of no vehicle: the handshake, and what the server says of itself."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sims.airsim.server.methods import RpcError, rpc
from sims.cameras.spec import CameraSpec, camera_info, eyes

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

    @rpc("getSettingsString")
    def settings(self) -> Awaitable[str] | str:
        """Return the settings.json of the server's settings, or else one that says what runs."""
        given = self._server.config.settings
        if not given:
            return json.dumps(self._described())
        if given.lstrip().startswith("{"):
            return given

        async def read() -> str:
            try:
                return await self._server.offload(Path(given).read_text, "utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise RpcError(f"settings: expected a readable file, found: {error}") from None

        return read()

    def _described(self) -> dict[str, Any]:
        """Return the vehicles with their starts and cameras as settings.json has them."""
        vehicles = {}
        for name, vehicle in self._server.vehicles.items():
            type_ = "SimpleFlight" if hasattr(vehicle.config, "imu") else "ComputerVision"
            cameras = (eye for camera in vehicle.config.cameras for eye in eyes(camera))
            vehicles[name] = {
                "VehicleType": type_,
                **dict(zip("XYZ", vehicle.origin, strict=True)),
                "Cameras": {camera.name: _described_camera(camera) for camera in cameras},
            }
        types = {vehicle["VehicleType"] for vehicle in vehicles.values()}
        mode = "ComputerVision" if types == {"ComputerVision"} else "Multirotor"
        return {"SettingsVersion": 1.2, "SimMode": mode, "Vehicles": vehicles}


def _described_camera(camera: CameraSpec) -> dict[str, Any]:
    info = camera_info(camera)
    fov = math.degrees(2 * math.atan(info.width / (2 * info.fx)))
    size = {"Width": info.width, "Height": info.height, "FOV_Degrees": fov}
    return {
        **dict(zip("XYZ", camera.position, strict=True)),
        **dict(zip(("Roll", "Pitch", "Yaw"), camera.orientation, strict=True)),
        "CaptureSettings": [{"ImageType": type_, **size} for type_ in range(8)],
    }
