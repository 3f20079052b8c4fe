"""Worlds to fly in, by name or path: geometry, materials, lights; no vehicles, no cameras.

A built-in world costs physics little (primitives, all in the world body) and is made to be seen:
textures are drawn from a seed, and nothing repeats for long. A package adds its own by entry points
of the group ``visnav.worlds``: functions like those in `WORLDS`.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from runtime import VisnavError
from runtime.errors import CommandError
from runtime.extras import WORLDS as GROUP
from runtime.extras import others
from sims.scans.mesh_file import MeshError
from sims.scans.settings import SUFFIXES, USUAL, MeshSpec
from sims.worlds.builder import CLEARANCE, TOURS
from sims.worlds.dynamics import Dynamics, Motion, Scene
from sims.worlds.field import field
from sims.worlds.forest import forest
from sims.worlds.hall import hall
from sims.worlds.indoors import corridor, office
from sims.worlds.mocap import mocap
from sims.worlds.yard import night, yard

__all__ = [
    "CLEARANCE", "TOURS", "WORLDS", "Dynamics", "Motion", "Scene", "WorldError", "load_scene",
    "load_world",
]  # fmt: skip

WORLDS: dict[str, Callable[[int, bool], mujoco.MjSpec | Scene]] = {
    "hall": hall,
    "yard": yard,
    "corridor": corridor,
    "office": office,
    "night": night,
    "forest": forest,
    "field": field,
    "mocap": mocap,
}  # built-in worlds by name: functions of a seed and `bare`; a `Scene` if parts move by themselves


class WorldError(VisnavError, ValueError):
    """Unknown world, or an invalid world file."""


def load_world(name_or_path: str | Path, seed: int = 0, *, bare: bool = False) -> mujoco.MjSpec:
    """Return a world without its self-moving parts; see `load_scene`."""
    return load_scene(name_or_path, seed, bare=bare).spec


def load_scene(
    name_or_path: str | Path,
    seed: int = 0,
    *,
    bare: bool = False,
    mesh: MeshSpec = USUAL,
    aside: dict[str, Any] | None = None,
) -> Scene:
    """Return a world, ready for vehicles and cameras; MuJoCo's warnings go to the log from then on.

    Args:
        name_or_path: A name in `WORLDS` or of another package's world, or the path of an MJCF or
            mesh file (what has such a suffix, contains a slash, or is a `Path`).
        seed: Seed of a built-in world's textures, and of what lies on shelves. A file has none.
        bare: Leave out a built-in world's images, and all of a mesh that is only seen.
        mesh: How a mesh file becomes a world.
        aside: Takes the images of a mesh file, by the names of its textures; these have one texel
            then.

    Raises:
        WorldError: No such name or file, the file is no MJCF that compiles and no mesh of use, or a
            package's world cannot be built; the message names the package.
    """
    # Else they would go to a file of MuJoCo's in whatever folder the run was started.
    mujoco.set_mju_user_warning(logging.getLogger("visnav.mujoco").warning)
    text = str(name_or_path)
    suffix = Path(text).suffix.lower()
    if suffix in SUFFIXES:
        return Scene(_from_mesh(Path(name_or_path), mesh, bare, aside))
    if mesh != USUAL:
        raise WorldError(f'mesh: expected a mesh file as the world, found "{text}"')
    if isinstance(name_or_path, Path) or "/" in text or suffix == ".xml":
        return Scene(_from_file(Path(name_or_path)))
    built = WORLDS[text](seed, bare) if text in WORLDS else _from_package(text, seed, bare)
    return built if isinstance(built, Scene) else Scene(built)


def _from_package(name: str, seed: int, bare: bool) -> mujoco.MjSpec | Scene:
    offers = {offer.name: offer for offer in reversed(others(GROUP))}
    if name not in offers:
        known = sorted({*WORLDS, *offers})
        near = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        raise WorldError(
            f"world: expected one of {', '.join(known)}, or a path to an .xml or mesh file, "
            f'found "{name}"{hint}'
        )
    whose = f"world: {name} of the package {offers[name].package}"
    try:
        built = offers[name].load()(seed, bare)
    except CommandError as error:
        raise WorldError(f"world: {error}") from error
    except Exception as error:  # whatever a package does
        raise WorldError(f"{whose}: {type(error).__name__}: {error}") from error
    if not isinstance(built, mujoco.MjSpec | Scene):
        raise WorldError(f"{whose}: expected a mujoco.MjSpec or a Scene, found {built!r}")
    return built


def _from_mesh(path: Path, mesh: MeshSpec, bare: bool, aside: dict[str, Any] | None) -> Any:
    from sims.scans.world import mesh_world  # reading meshes takes libraries that few runs need

    try:
        return mesh_world(path, mesh, bare=bare, aside=aside)
    except MeshError as error:
        raise WorldError(f"world: {error}") from error


def _from_file(path: Path) -> Any:
    place = path.expanduser()
    if not place.is_file():
        what = "a directory" if place.is_dir() else "nothing"
        raise WorldError(f"world: {place}: expected an MJCF file, found {what}")
    try:
        spec = mujoco.MjSpec.from_file(str(place))
        # Compiled here once, so that a mistake is reported as the file's and not as a vehicle's.
        spec.copy().compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise WorldError(
            f"world: {place}: expected an MJCF file that compiles, found: {reason}"
        ) from error
    return spec
