"""Settings with units, as they stand in a TOML file."""

from __future__ import annotations

import math
import re

# casefold() turns the micro sign µ into the Greek letter μ, which looks the same.
_UNITS = {"ns": 1e-9, "us": 1e-6, "μs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
_DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(ns|us|μs|ms|s|min|h)\s*")
_LONGEST = 2**63 / 1e9  # what 64 bits of nanoseconds hold: 292 years


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
        elif isinstance(value, str) and (match := _DURATION.fullmatch(value.casefold())):
            seconds = float(match[1]) * _UNITS[match[2]]
        if not 0 <= seconds < _LONGEST:
            raise ValueError('expected a duration such as 0.5, "80ms" or "2min"')
        return cls(seconds)
