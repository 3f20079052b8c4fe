"""Settings with units, as they stand in a TOML file."""

from __future__ import annotations

import math
import re

_UNITS = {"ns": 1e-9, "us": 1e-6, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(ns|us|µs|ms|s|min|h)\s*", re.I)


class Duration(float):
    """Seconds, written as a number or with a unit: ``"80ms"``, ``"1.5 s"``, ``"2min"``."""

    @classmethod
    def parse(cls, value: object) -> Duration:
        """Read a duration.

        Raises:
            ValueError: It is neither a non-negative number nor a text like ``"80ms"``.
        """
        seconds = math.nan
        if isinstance(value, int | float) and not isinstance(value, bool):
            seconds = value
        elif isinstance(value, str) and (match := _DURATION.fullmatch(value)):
            seconds = float(match[1]) * _UNITS[match[2].lower()]
        if not 0 <= seconds < math.inf:
            raise ValueError('expected a duration such as 0.5, "80ms" or "2min"')
        return cls(seconds)
