"""Reading of settings.json: its text, typed access, and notes on keys without effect."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

import json5

from events import Vector3
from runtime.errors import ConfigError, suggest

T = TypeVar("T")
ZERO = (0.0, 0.0, 0.0)

_LARGEST = 1e300

IGNORED = {
    key: reason
    for reason, keys in {
        "it changes only what Unreal shows": "ViewMode, TimeOfDay, SubWindows, CameraDirector, "
        "PawnPaths, PawnPath, RecordUIVisible, EngineSound, SpeedUnitFactor, SpeedUnitLabel, "
        "LogMessagesVisible, Default Environment, DrawDebugPoints, EnableTrace, UnrealEngine, "
        "SeeDocsAt, DrawSensor, ShowLosDebugLines, MoveWorldOrigin",
        "images are of one instant, in perspective, without errors": "MotionBlurAmount, "
        "TargetGamma, AutoExposureSpeed, AutoExposureBias, AutoExposureMaxBrightness, "
        "AutoExposureMinBrightness, OrthoWidth, DepthOfFieldFstop, DepthOfFieldFocalDistance, "
        "DepthOfFieldFocalRegion, PublishToRos, MotionBlurMax, ChromaticAberrationScale, "
        "LumenGIEnable, LumenReflectionEnable, LumenFinalQuality, LumenSceneDetail, "
        "LumenSceneLightningDetail",
        "time is simulated in steps of 1 ms": "ClockType",
        "vehicles fly by MuJoCo's physics, and bodies are solid": "PhysicsEngineName, "
        "EnableCollisions, EnableCollisionPassthrogh, EnableCollisionPassthrough",
        "clients may always command": "EnableRpc, RpcEnabled, AllowAPIAlways, RC",
        "vehicles carry all cameras and sensors": "ExternalCameras, External, ExternalLocal",
        "IDs begin as AirSim computes them from names": "SegmentationSettings, "
        "InitialInstanceSegmentation",
        "nothing is marked, and all is seen": "IgnoreMarked",
        "a lidar's turn is always whole": "LimitPoints",
        "it starts armed": "DefaultVehicleState",
        "only eph is simulated": "EpvInitial, EpvFinal, EpvTimeConstant, EPV_TimeConstant",
    }.items()
    for key in keys.split(", ")
}  # why known keys have no effect

_HOLDS = {
    "DefaultVehicleState": "Armed",
    **dict.fromkeys(("EnableRpc", "RpcEnabled", "AllowAPIAlways", "EnableCollisions"), True),
    "ExternalLocal": True,
}  # values of these that hold here; so do 0, false and an empty text of all


def parse(text: str, file_name: str) -> tuple[dict[str, Any], str, list[str]]:
    """Parse JSON with comments, trailing commas, NaN and infinities; errors name the file.

    Returns:
        Its values; the text as strict JSON; notes on what AirSim would not have taken.

    Raises:
        ConfigError: It is no JSON, no object, or nested too deep.
    """
    strict = text.removeprefix("\ufeff")
    notes: list[str] = []

    def collect(entries: Iterable[tuple[str, Any]]) -> dict[str, Any]:
        pairs = list(entries)
        counts = Counter(key for key, _ in pairs)
        repeated = [key for key in counts if counts[key] > 1]
        notes.extend(
            f"{key!r} stands there more than once: the last one counts" for key in repeated
        )
        return dict(pairs)

    def constant(name: str) -> float:
        notes.append(f"{name}: AirSim itself refuses that")
        return float(name)

    try:
        try:
            table = json.loads(strict, object_pairs_hook=collect, parse_constant=constant)
        except json.JSONDecodeError as error:
            notes.clear()
            loose = json5.loads(strict, object_pairs_hook=collect)
            table = json.loads(json.dumps(loose))  # which joins surrogate pairs
            place = f"line {error.lineno}, column {error.colno}"
            notes.append(f"{place}: AirSim itself refuses that: {error.msg}")
            strict = json.dumps(table, ensure_ascii=False)
        json.dumps(table, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{file_name}: expected Unicode, found half a surrogate pair") from None
    except RecursionError:
        raise ConfigError(
            f"{file_name}: expected objects and lists less deep in one another"
        ) from None
    except ValueError as error:
        raise ConfigError(_printable(f"{file_name}: expected JSON, found: {error}")) from None
    if not isinstance(table, dict):
        raise ConfigError(f"{file_name}: expected an object {{…}}, found {strict.strip()!r:.80}")
    return table, strict, notes


class Keys:
    """JSON object with access to its keys by name.

    What is not given, null or NaN has its default, as in AirSim. What is of the wrong type is a
    `ConfigError`. `notes` get lines on what is not honoured, which begin with `path`: where the
    object stands, as ``settings.json: `` and then the keys.
    """

    def __init__(self, table: Mapping[str, Any], path: str, notes: list[str]) -> None:
        self._table = table
        self._path = path
        self._notes = notes
        self._read_keys: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._table

    def number(self, key: str, default: T) -> float | T:
        """Return a finite number."""
        value = self._get(key, int | float, "a finite number")
        if value is None or value != value:
            return default
        if abs(value) > _LARGEST:
            raise self.error(key, f"expected a finite number, found {value!r:.80}")
        return float(value)

    def positive(self, key: str, default: float) -> float:
        """Return a number above 0."""
        value = self.number(key, default)
        if value <= 0.0:
            raise self.error(key, f"expected a number above 0, found {value:g}")
        return value

    def whole(self, key: str, default: int) -> int:
        """Return a whole number; 256.0 counts as whole."""
        value = self.number(key, default)
        if value != int(value):
            raise self.error(key, f"expected a whole number, found {value:g}")
        return int(value)

    def numbers(self, keys: str, default: float = 0.0) -> list[float]:
        """Return the numbers of several keys, given with blanks between."""
        return [self.number(key, default) for key in keys.split()]

    def mount(self, position: Vector3 = ZERO, orientation: Vector3 = ZERO) -> dict[str, Any]:
        """Return our `position` and `orientation`; the arguments replace missing numbers."""
        pose: dict[str, Any] = {}
        places = (("position", "X Y Z", position), ("orientation", "Roll Pitch Yaw", orientation))
        for field, keys, usual in places:
            numbers = self.numbers(keys, math.nan)
            if not all(map(math.isnan, numbers)):
                pairs = zip(numbers, usual, strict=True)
                pose[field] = [
                    default if math.isnan(number) else number for number, default in pairs
                ]
        return pose

    def flag(self, key: str, default: bool = False) -> bool:
        """Return true or false."""
        value = self._get(key, bool, "true or false")
        return default if value is None else bool(value)

    def text(self, key: str, default: str = "") -> str:
        """Return a text."""
        value = self._get(key, str, "a text")
        return default if value is None else str(value)

    def table(self, key: str) -> Keys:
        """Return an inner object; empty if missing."""
        return Keys(self._get(key, dict, "an object") or {}, self._at(key), self._notes)

    def tables(self, key: str) -> Iterator[tuple[str, Keys]]:
        """Yield name and content of each object in an inner object, sorted by name."""
        outer = self.table(key)
        for name in sorted(outer._table):
            yield name, outer.table(name)

    def entries(self, key: str) -> Iterator[Keys]:
        """Yield the objects of an inner list."""
        listed = enumerate(self._get(key, list, "a list") or ())
        inner = Keys({f"{key}[{index}]": value for index, value in listed}, self._path, self._notes)
        for name in inner._table:
            yield inner.table(name)

    def done(self) -> None:
        """Add a note for each key never read, unless its value has no effect here."""
        for key, value in self._table.items():
            so_anyway = key in IGNORED and (not value or value != value or value == _HOLDS.get(key))
            if key not in self._read_keys and not so_anyway:
                unknown = f"no such setting is known{suggest(key, self._read_keys)}"
                self.add_note(key, f"ignored: {IGNORED.get(key, unknown)}")

    def add_note(self, key: str, text: str) -> None:
        """Add a note about a key, or about the whole object if the key is empty."""
        self._notes.append(_printable(f"{self._at(key)}: {text}"))

    def error(self, key: str, text: str) -> ConfigError:
        """Return an error about a key, or about the whole if the key is empty."""
        return ConfigError(_printable(f"{self._at(key)}: {text}"))

    def _get(self, key: str, type_: Any, expected: str) -> Any:
        self._read_keys.append(key)
        value = self._table.get(key)
        if value is None or (
            isinstance(value, type_) and isinstance(value, bool) == (type_ is bool)
        ):
            return value
        raise self.error(key, f"expected {expected}, found {value!r:.80}")

    def _at(self, key: str) -> str:
        between = "." if key and not self._path.endswith(": ") else ""
        return f"{self._path}{between}{key}"


def _printable(line: str) -> str:
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
