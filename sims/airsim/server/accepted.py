"""Methods that are accepted, and of which nothing comes: scripts only need them not to fail.

Most are of AirSim's marks, weather, lights and gains. The log names each that is called, once.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sims.airsim.server.methods import rpc

if TYPE_CHECKING:
    from sims.airsim.server.node import AirsimServer

_MARKS = "Accept without effect: marks are not drawn."
_FOG = "Accept without effect: a world's fog is that of its file."
_SUN = "Accept without effect: a world's lights are those of its file."
_LIGHT = "Return ``False``: a world's lights are those of its file."
_GAINS = "Accept without effect: gains are settings of the vehicle's node.", "kp ki kd vehicle_name"
_SHOWN = "duration is_persistent"

ACCEPTED = {
    "simEnableWeather": (_FOG, "is_enabled"),
    "simSetWeatherParameter": (_FOG, "parameter value"),
    "simSetTimeOfDay": (_SUN, "is_enabled start is_start_dst speed interval move_sun"),
    "simFlushPersistentMarkers": (_MARKS, ""),
    "simPlotPoints": (_MARKS, f"points rgba size {_SHOWN}"),
    "simPlotLineStrip": (_MARKS, f"points rgba thickness {_SHOWN}"),
    "simPlotLineList": (_MARKS, f"points rgba thickness {_SHOWN}"),
    "simPlotArrows": (_MARKS, f"starts ends rgba thickness arrow_size {_SHOWN}"),
    "simPlotStrings": (_MARKS, "strings positions scale rgba duration"),
    "simPlotTransforms": (_MARKS, f"poses scale thickness {_SHOWN}"),
    "simPlotTransformsWithNames": (
        _MARKS,
        "poses names scale thickness text_scale text_rgba duration",
    ),
    "simSetTraceLine": (_MARKS, "rgba thickness vehicle"),
    "simSetLightIntensity": (_LIGHT, "name intensity"),
    "simSetWorldLightIntensity": (_LIGHT, "name intensity"),
    "simSetWorldLightVisibility": (_LIGHT, "name is_visible"),
    "simSetVehicleLightIntensity": (_LIGHT, "vehicle name intensity"),
    "simSetVehicleLightVisibility": (_LIGHT, "vehicle name is_visible"),
    "setAngleRateControllerGains": _GAINS,
    "setAngleLevelControllerGains": _GAINS,
    "setVelocityControllerGains": _GAINS,
    "setPositionControllerGains": _GAINS,
    "simRunConsoleCommand": ("Return ``False``: there is no Unreal Engine.", "command"),
}
"""What each does, which begins with what it returns, and its arguments, which may be anything."""


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


def _handler(method: str, description: str, arguments: str) -> Callable[..., Any]:
    result = False if description.startswith("Return") else None

    def accept(self: Accepted, *_: Any) -> bool | None:
        self.call(method)
        return result

    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    names = [inspect.Parameter(name, kind) for name in ("self", *arguments.split())]
    accept.__doc__, accept.__annotations__ = description, dict.fromkeys(arguments.split(), Any)
    accept.__dict__["__signature__"] = inspect.Signature(names)
    return rpc(method)(accept)


for _name, (_text, _arguments) in ACCEPTED.items():
    setattr(Accepted, _name, _handler(_name, _text, _arguments))
