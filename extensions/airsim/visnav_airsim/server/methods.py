"""Table of methods: from a call's name and arguments to a handler.

A group of methods is a class whose functions are marked with `rpc`. The name, the annotated
parameters and the docstring of each give arity, conversion, errors and documentation.
"""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TypeVar

import msgspec

from runtime.errors import CommandError
from runtime.logs import NodeLogger

Flavour = Literal["airsim", "cosys"]

Finite = Annotated[float, msgspec.Meta(ge=-3.5e38, le=3.5e38)]
"""Finite number in the float32 range of AirSim's clients, for parameters of handlers
and fields of structures; others are refused with the field's place.
"""

F = TypeVar("F", bound=Callable[..., Any])

LONGEST_NAME = 100  # characters of an unknown method's name that are repeated in the answer

_MARKS = "Accept without effect: marks are not drawn."
_FOG = "Accept without effect: a world's fog is that of its file."
_SUN = "Accept without effect: a world's lights are those of its file."
_LIGHT = "Return ``False``: a world's lights are those of its file."
_GAINS = "Accept without effect: gains are settings of the vehicle's node.", "kp ki kd vehicle_name"
_SHOWN = "duration is_persistent"

WITHOUT_EFFECT = {
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
"""Description of each method, result first, and its arguments, of any type.
Scripts only need these methods not to fail.
"""

_UNSUPPORTED = {
    r"sim\w*Detection\w*|simGetDetections": "make boxes of the segmentation image instead",
    r"sim\w*(Lens|Filmback|Foc)\w*": "cameras are ideal or have the lens of the "
    "run's file; simSetCameraFov sets the field of view",
    r"simSwapTextures|simSetObjectMaterial\w*": "a world's textures are those of its file",
    r"simCreateVoxelGrid": "a server writes no files for its clients",
    r"moveByManual|moveByRC": "there is no remote control",
    r"setSafety": "there are no safety checks",
    r"setCarControls|getCarState|getCarControls": "there are no cars",
    r"simSetExtForce": "there are no external forces but the wind",
    r"get(Echo|UWB|Wifi|GPULidar)\w*|sim\w*(Echo|UWB|Wifi|GPULidar)\w*": "there is no such sensor",
    r"sim\w*Annotation\w*": "there are no annotation layers; use the segmentation image",
    r"sim\w*InstanceSegmentation\w*": "use simSetSegmentationObjectID and the segmentation image",
}


class RpcError(Exception):
    """Call refused by the server; the text is sent to the client."""


EXPECTED_ERRORS = (RpcError, ValueError, msgspec.ValidationError, CommandError)
"""Errors of handlers caused by the client; any other error is a bug of the server."""


class Caller(Protocol):
    """Client of a call."""

    address: str  # of the client, for messages
    flavour: Flavour  # whose structures it expects; a handler may set it


class Named:
    """Base of handlers' arguments in place of clients' names, such as vehicles."""


def rpc(name: str, *, cosys: int | None = None) -> Callable[[F], F]:
    """Mark a function of a group as the handler of a method.

    Its parameters are converted as annotated (whole numbers to floats, maps to structures, names to
    what has them); one annotated with `Caller` gets the client. Defaults stand for arguments that a
    flavour lacks. What a handler does before its first wait is done when it is called, in the order
    of the requests: one that waits is a plain function that returns an awaitable.

    Args:
        cosys: Number of arguments of Cosys-AirSim's clients, if another; a call then tells whose
            client it is.
    """

    def mark(function: F) -> F:
        function.__dict__["rpc"] = name, cosys
        return function

    return mark


class Method(NamedTuple):
    """Method: a row of the table, and of the documentation."""

    name: str  # on the wire
    call: Callable[..., Any]  # the handler
    parameters: dict[str, Any]  # types of its arguments on the wire, by their names
    description: str  # first line of the handler's docstring
    # What its arguments that are names become, by their positions.
    named: dict[int, Any] = {}  # noqa: RUF012  # never changed
    defaults: tuple[Any, ...] = ()  # of its last arguments
    wants_caller: bool = False  # whether the client is its first argument
    # Number of arguments of Cosys-AirSim's clients, if it is another than AirSim's.
    cosys: int | None = None


class Table:
    """All methods by name, of groups with functions marked by `rpc`.

    Args:
        finders: Functions from a name to its object, by the kinds that handlers ask for.
    """

    def __init__(
        self,
        groups: Iterable[object],
        log: NodeLogger,
        finders: Mapping[Any, Callable[[str], Any]] | None = None,
    ) -> None:
        self._log, self._finders = log, finders or {}
        self._called: set[str] = set()
        self.methods = constant_methods(self._record_ignored)
        for group in groups:
            methods = methods_of(group)
            assert not methods.keys() & self.methods.keys(), methods.keys() & self.methods.keys()
            self.methods |= methods
        # Of the tuple of all arguments.
        self._shapes = {
            name: tuple.__class_getitem__(tuple(method.parameters.values()) or ((),))
            for name, method in self.methods.items()
        }

    def call(self, caller: Caller, name: str, arguments: list[Any]) -> Awaitable[Any] | Any:
        """Call a method, and return its result or an awaitable of the result.

        Raises:
            RpcError: With rpclib's text: no such method, wrong arguments, or it cannot be served.
        """
        method = self.methods.get(name)
        count = len(arguments)
        if method is None:
            name = name[:LONGEST_NAME]
            if reason := reason_unsupported(name):
                raise RpcError(thrown(name, count, f"not supported by visnav-runtime: {reason}"))
            raise RpcError(
                f"rpclib: server could not find function '{name}' with argument count {count}."
            )
        most, missing = len(method.parameters), len(method.parameters) - count
        if not 0 <= missing <= len(method.defaults):
            expected = method.cosys if caller.flavour == "cosys" and method.cosys else most
            raise RpcError(
                f"rpclib: Function '{name}' was called with an invalid number of arguments. "
                f"Expected: {expected}, got: {count}"
            )
        if method.cosys is not None and count in (most, method.cosys):
            caller.flavour = "cosys" if count == method.cosys else "airsim"
        defaults = method.defaults[len(method.defaults) - missing :]
        try:
            converted = list(msgspec.convert([*arguments, *defaults], self._shapes[name]))
            for index, kind in method.named.items():
                converted[index] = self._finders[kind](converted[index])
            return method.call(*((caller,) if method.wants_caller else ()), *converted)
        except RecursionError:
            raise RpcError(thrown(name, count, "the arguments are nested too deeply")) from None
        except EXPECTED_ERRORS as error:
            raise RpcError(thrown(name, count, str(error))) from None

    def _record_ignored(self, method: str) -> None:
        if method not in self._called:
            self._called.add(method)
            self._log.warning("%s has no effect here", method)


def reason_unsupported(method: str) -> str:
    """Return the reason for a missing AirSim method; empty if AirSim has none either."""
    for pattern, reason in _UNSUPPORTED.items():
        if re.fullmatch(pattern, method):
            return reason
    return ""


def thrown(name: str, count: int, text: str) -> str:
    """Return rpclib's text of an exception in a handler."""
    return (
        f"rpclib: function '{name}' (called with {count} arg(s)) threw an exception. "
        f"The exception contained this information: {text}."
    )


def constant_methods(record: Callable[[str], None] = lambda _: None) -> dict[str, Method]:
    """Return the methods with constant answers; `record` is called for those without effect."""
    content = "with which the clients of AirSim and of Cosys-AirSim are content."
    rows: list[tuple[str, Callable[..., Any], str, str]] = [
        ("ping", lambda: True, "Answer ``True``.", ""),
        ("getServerVersion", lambda: 4, f"Return 4, {content}", ""),
        ("getMinRequiredClientVersion", lambda: 1, f"Return 1, {content}", ""),
    ]
    for name, (description, arguments) in WITHOUT_EFFECT.items():
        result = False if description.startswith("Return") else None

        def accept(*_: Any, name: str = name, result: bool | None = result) -> bool | None:
            record(name)
            return result

        rows.append((name, accept, description, arguments))
    return {
        name: Method(name, call, dict.fromkeys(arguments.split(), Any), description)
        for name, call, description, arguments in rows
    }


def methods_of(group: object) -> dict[str, Method]:
    """Return the methods of a group by name; those of its class, too, for the documentation."""
    marked = (function for _, function in inspect.getmembers(group, callable))
    methods = (_method(function, *function.rpc) for function in marked if hasattr(function, "rpc"))
    return {method.name: method for method in methods}


def _method(function: Callable[..., Any], name: str, cosys: int | None) -> Method:
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = {
        parameter.name: parameter.default
        for parameter in inspect.signature(function).parameters.values()
        if parameter.name != "self"
    }
    types = {name: hints[name] for name in parameters}
    wants_caller = Caller in types.values()
    if wants_caller:
        types = {name: type_ for name, type_ in types.items() if type_ is not Caller}
    named = {index: type_ for index, type_ in enumerate(types.values()) if _is_named(type_)}
    types = {name: str if _is_named(type_) else type_ for name, type_ in types.items()}
    defaults = tuple(value for value in parameters.values() if value is not inspect.Parameter.empty)
    description = (inspect.getdoc(function) or "").partition("\n")[0]
    return Method(name, function, types, description, named, defaults, wants_caller, cosys)


def _is_named(type_: Any) -> bool:
    kind = typing.get_args(type_)[0] if typing.get_origin(type_) is Annotated else type_
    return isinstance(kind, type) and issubclass(kind, Named)
