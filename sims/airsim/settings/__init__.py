"""AirSim's settings.json as a configuration of ours."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sims.airsim.settings.interpret import interpret
from sims.airsim.settings.keys import Keys
from sims.airsim.settings.lenient_json import parse

__all__ = ["read"]


def read(text: str, path: str, warn: Callable[[str], None], world: str = "hall") -> dict[str, Any]:
    """Return what a TOML file of ours would hold that says the same.

    Args:
        text: Of a settings.json.
        path: Its name, for messages.
        warn: Called with a line on each thing that is odd, and each that is not honoured.
        world: Name or path of the world.

    Raises:
        ConfigError: It is no JSON, or asks for what is not simulated here.
    """
    name = Path(path).name
    found, strict, oddities = parse(text, name)
    notes = [f"{name}: {oddity}" for oddity in oddities]
    table = interpret(Keys(found, f"{name}: ", notes), strict, world)
    for line in dict.fromkeys(notes):
        warn(line)
    return table
