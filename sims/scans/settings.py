"""Settings of a world from a mesh file."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from events import Vector3
from runtime.paths import InputPath, NameOrPath

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Unit = Literal["mm", "cm", "m", "km", "in", "ft"]
SUFFIXES = (
    ".glb",
    ".gltf",
    ".obj",
    ".ply",
    ".stl",
    ".dae",
    ".world",
    ".sdf",
)  # of mesh files
UNITS: dict[str, float] = {
    "mm": 0.001,
    "cm": 0.01,
    "m": 1.0,
    "km": 1000.0,
    "in": 0.0254,
    "ft": 0.3048,
}


class MeshSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a mesh file becomes a world.

    Attributes:
        up: Axis of the file that points up. ``auto``: what the format or file says (y: glTF), else
            z. Of a file with y up, its x is north and its z east; with z up, its x is north and its
            y west.
        unit: Unit of the file, by name or in metres. ``auto``: what the file says, else metres.
        position: Place of the file's origin in ``map``, metres NED.
        heading: Direction of what would be north, degrees clockwise from north.
        floor: ``auto``: a solid plane at the height of the ground, if the mesh has level ground;
            ``none``; or the plane's height, metres up.
        light: ``baked``: the images are what is seen; ``lit``: they are lit, from above and all
            round. ``auto``: baked if the file says so, or has colours and no lights or normals.
        image: Image of what has texture coordinates and no image, as some baked scans come with.
        double_sided: Draw all triangles from behind, too: of a room whose faces point outwards.
        solid: What vehicles touch. ``voxels``: boxes about the surfaces, or about the file's own
            collision shapes; ``hulls``: convex hulls of the parts; ``none``: the floor alone; or
            another mesh file in the same axes and unit, whose objects' convex hulls are solid.
        voxel: Edge of a voxel, metres; surfaces are solid up to as much too far out.
        texture_size: Most columns and rows of an image; larger ones are made smaller.
    """

    up: Literal["auto", "x", "y", "z"] = "auto"
    unit: Literal["auto"] | Unit | Positive = "auto"
    position: Vector3 = (0.0, 0.0, 0.0)
    heading: float = 0.0
    floor: Literal["auto", "none"] | float = "auto"
    light: Literal["auto", "baked", "lit"] = "auto"
    image: InputPath = ""
    double_sided: bool = False
    solid: NameOrPath = "voxels"
    voxel: Annotated[float, msgspec.Meta(ge=0.01, le=10.0)] = 0.1
    texture_size: Annotated[int, msgspec.Meta(ge=16, le=16384)] = 4096


USUAL = MeshSpec()
