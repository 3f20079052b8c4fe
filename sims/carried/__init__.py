"""A body with every sensor, carried along a recorded motion."""

from sims.carried.node import Carried, CarriedConfig

__all__ = ["Carried", "CarriedConfig"]
