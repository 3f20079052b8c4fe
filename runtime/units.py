"""Settings with units, as they stand in a TOML file."""

from __future__ import annotations

import math
import re
from typing import Any

# casefold() turns the micro sign µ into the Greek letter μ, which looks the same.
_UNITS = {"ns": 1e-9, "us": 1e-6, "μs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_DURATION = re.compile(r"\s*(-?)([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*([^\W\d_]+)\s*")
_LONG_NAMES = {"sec": "s", "second": "s", "m": "min", "minute": "min", "hr": "h", "hour": "h"}
_LONG_NAMES |= {"msec": "ms", "millisecond": "ms", "usec": "us", "microsecond": "us"}
_LONGEST = 2**63 / 1e9  # what 64 bits of nanoseconds hold: 292 years


class Duration(float):
    """Seconds, written as a number or with a unit: ``"80ms"``, ``"1.5 s"``, ``"2min"``."""

    @classmethod
    def parse(cls, value: object) -> Duration:
        """Read a non-negative number or a text like ``"80ms"``; or raise `ValueError`."""
        seconds = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            seconds = value
        elif isinstance(value, str) and (match := _DURATION.fullmatch(value.casefold())):
            sign, number, unit = match.groups()
            if unit not in _UNITS:
                meant = _LONG_NAMES.get(unit.removesuffix("s"))
                guess = f' (did you mean "{sign}{number}{meant}"?)' if meant else ""
                raise ValueError(
                    f'found "{value.strip()}", of no known unit{guess}; expected a duration in ns, '
                    "us, ms, s, min or h"
                )
            seconds = float(sign + number) * _UNITS[unit]
        if seconds < 0:
            raise ValueError("expected a duration that is not negative")
        if not 0 <= seconds < _LONGEST:
            raise ValueError('expected a duration such as 0.5, "80ms" or "2min"')
        return cls(seconds)


class Latency(Duration):
    """A duration short by nature: a latency, delay, jitter, exposure.

    ``latency = 40`` is rarely meant as 40 s: a number without a unit is taken up to `LONGEST_BARE`
    only. For 40 s write ``"40s"``.
    """

    @classmethod
    def parse(cls, value: object) -> Latency:
        """Read a duration, up to `LONGEST_BARE` without a unit; or raise `ValueError`."""
        latency = cls(super().parse(value))
        if not isinstance(value, str) and latency > LONGEST_BARE:
            raise ValueError(
                f"expected a unit beside a number above {LONGEST_BARE:g}, since a number alone is "
                f'in seconds (did you mean "{value}ms"? or "{value}s")'
            )
        return latency


LONGEST_BARE = 1.0  # longest `Latency` (s) as a number without a unit


def plain(value: Any) -> float | str:
    """Return a duration as in a file, equal when read back; for `msgspec`."""
    if isinstance(value, Latency) and value > LONGEST_BARE:
        return f"{float(value)!r}s"
    return float(value)


ROUNDING = 1e-6  # least figure that is more than rounding: micrometres, millionths of a degree


def significant(value: float, digits: int = 4) -> str:
    """Return a figure with significant digits and no exponent; 0 below `ROUNDING`."""
    if not math.isfinite(value):
        return f"{value:g}"
    if abs(value) < ROUNDING:
        return "0"
    decimals = digits - 1 - int(f"{value:.{digits - 1}e}".partition("e")[2])
    text = f"{round(value, decimals):.{max(decimals, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
