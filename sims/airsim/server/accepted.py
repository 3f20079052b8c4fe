"""Methods that are accepted, and of which nothing comes: scripts only need them not to fail.

Most are of AirSim's marks, weather, lights and gains. The log names each that is called, once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sims.airsim.server.methods import rpc
from sims.airsim.structures import Pose, Vector3r

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

_COLOUR = list[float]
_SHOWN = {"duration": float, "is_persistent": bool}
_POINTS = {"points": list[Vector3r], "rgba": _COLOUR}
_LINES = _POINTS | {"thickness": float} | _SHOWN
_MARKS = "Accept without effect: marks are not drawn."
_FOG = "Accept without effect: a world's fog is that of its file."
_LIGHT = "Return ``False``: a world's lights are those of its file."
_GAINS = (
    "Accept without effect: gains are settings of the vehicle's node.",
    {"kp": list[float], "ki": list[float], "kd": list[float], "vehicle_name": str},
)

ACCEPTED: dict[str, tuple[str, dict[str, Any]]] = {
    "simEnableWeather": (_FOG, {"is_enabled": bool}),
    "simSetWeatherParameter": (_FOG, {"parameter": int, "value": float}),
    "simSetTimeOfDay": (
        "Accept without effect: a world's lights are those of its file.",
        {"is_enabled": bool, "start": str, "is_dst": bool, "speed": float, "interval": float}
        | {"move_sun": bool},
    ),
    "simFlushPersistentMarkers": (_MARKS, {}),
    "simPlotPoints": (_MARKS, _POINTS | {"size": float} | _SHOWN),
    "simPlotLineStrip": (_MARKS, _LINES),
    "simPlotLineList": (_MARKS, _LINES),
    "simPlotArrows": (
        _MARKS,
        {"starts": list[Vector3r], "ends": list[Vector3r], "rgba": _COLOUR, "thickness": float}
        | {"arrow_size": float}
        | _SHOWN,
    ),
    "simPlotStrings": (
        _MARKS,
        {"strings": list[str], "positions": list[Vector3r], "scale": float, "rgba": _COLOUR}
        | {"duration": float},
    ),
    "simPlotTransforms": (
        _MARKS,
        {"poses": list[Pose], "scale": float, "thickness": float} | _SHOWN,
    ),
    "simPlotTransformsWithNames": (
        _MARKS,
        {"poses": list[Pose], "names": list[str], "scale": float, "thickness": float}
        | {"text_scale": float, "text_rgba": _COLOUR, "duration": float},
    ),
    "simSetTraceLine": (_MARKS, {"rgba": _COLOUR, "thickness": float, "vehicle": str}),
    "simSetLightIntensity": (_LIGHT, {"name": str, "intensity": float}),
    "simSetWorldLightIntensity": (_LIGHT, {"name": str, "intensity": float}),
    "simSetWorldLightVisibility": (_LIGHT, {"name": str, "is_visible": bool}),
    "simSetVehicleLightIntensity": (_LIGHT, {"vehicle": str, "name": str, "intensity": float}),
    "simSetVehicleLightVisibility": (_LIGHT, {"vehicle": str, "name": str, "is_visible": bool}),
    "setAngleRateControllerGains": _GAINS,
    "setAngleLevelControllerGains": _GAINS,
    "setVelocityControllerGains": _GAINS,
    "setPositionControllerGains": _GAINS,
    "simRunConsoleCommand": ("Return ``False``: there is no Unreal Engine.", {"command": str}),
}
"""What each does, which begins with what it returns, and its parameters."""


class Accepted:
    """The methods of `ACCEPTED`."""

    def __init__(self, server: AirsimServer) -> None:
        self._log = server.log
        self._called: set[str] = set()

    def call(self, method: str) -> None:
        """Log that a method is called, if it is the first time."""
        if method not in self._called:
            self._called.add(method)
            self._log.warning("%s has no effect here", method)


def _handler(method: str, description: str, parameters: dict[str, Any]) -> Callable[..., Any]:
    result = False if description.startswith("Return") else None

    def accept(self: Accepted, *_: Any) -> bool | None:
        self.call(method)
        return result

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    names = [inspect.Parameter(name, kind) for name in ("self", *parameters)]
    accept.__doc__, accept.__annotations__ = description, parameters
    accept.__dict__["__signature__"] = inspect.Signature(names)
    return rpc(method)(accept)


for _name, (_text, _parameters) in ACCEPTED.items():
    setattr(Accepted, _name, _handler(_name, _text, _parameters))
