"""Worlds to fly in: geometry, materials and lights, without vehicles and cameras.

A built-in world costs physics little (primitives, all in the world body) and is made to be seen:
textures are drawn from a seed, and nothing repeats for long.
"""

from sims.worlds.builder import CLEARANCE, TOURS
from sims.worlds.dynamics import Dynamics, Motion, Scene
from sims.worlds.loading import WORLDS, WorldError, load_scene, load_world

__all__ = [
    "CLEARANCE",
    "TOURS",
    "WORLDS",
    "Dynamics",
    "Motion",
    "Scene",
    "WorldError",
    "load_scene",
    "load_world",
]
