"""Surfaces of a model beyond what MJCF describes: two-sided, cut out, coloured by the vertex.

A model carries them in fields that MJCF leaves to its users (``docs/how-to/own-world.md``). The
rasteriser draws them; MuJoCo's renderer does not.
"""

from __future__ import annotations

from typing import Any, Literal

import mujoco
import numpy as np
import numpy.typing as npt

from events.camera_info import srgb_light

GEOM_USER = "geom_user"  # custom text: names of the geoms' user numbers, in order
COLOURS = ".colours"  # suffix of textures: `<mesh>.colours` has a texel for each vertex of the mesh

_Kind = mujoco.mjtObj


NumberName = Literal["double_sided", "alpha_cutoff"]


def geom_numbers(model: Any, name: NumberName) -> npt.NDArray[np.float64]:
    """Return a user number of all geoms by its name, shape (ngeom,); 0 where there is none."""
    text = mujoco.mj_name2id(model, _Kind.mjOBJ_TEXT, GEOM_USER)
    names: list[str] = []
    if text >= 0:
        start, size = int(model.text_adr[text]), int(model.text_size[text])
        names = model.text_data[start : start + size].rstrip(b"\0").decode().split()
    column = names.index(name) if name in names else model.nuser_geom
    if column >= model.nuser_geom:
        return np.zeros(model.ngeom)
    return np.array(model.geom_user[:, column], np.float64)


def texture_bytes(
    model: Any, texture: int, image: npt.NDArray[np.uint8] | None = None
) -> npt.NDArray[np.uint8]:
    """Return a texture's texels, row by row, shape (height · width, channels).

    Args:
        image: What the texture shows, if the model has it without texels.
    """
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    count = int(model.tex_width[texture]) * int(model.tex_height[texture])
    data = model.tex_data[start : start + count * channels] if image is None else image
    texels = np.ascontiguousarray(data).reshape(-1, channels)
    if model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        opacity = texels[:, 3:].copy()
        texels = np.rint(srgb_light() * 255.0).astype(np.uint8)[texels]  # as OpenGL decodes it
        texels[:, 3:] = opacity
    return texels


def colours_texture(model: Any, mesh: int) -> int:
    """Return the number of the texture with the colours of a mesh's vertices; -1 for none."""
    name = model.mesh(mesh).name
    return int(mujoco.mj_name2id(model, _Kind.mjOBJ_TEXTURE, name + COLOURS)) if name else -1


def vertex_colours(model: Any, mesh: int) -> npt.NDArray[np.float32] | None:
    """Return factors on the colours of a mesh's vertices: red, green, blue, opacity, shape (n, 4).

    Raises:
        ValueError: The texture is not 2D, has 1 or 2 channels, or fewer texels than vertices.
    """
    if (texture := colours_texture(model, mesh)) < 0:
        return None
    texels, count = texture_bytes(model, texture), int(model.mesh_vertnum[mesh])
    flat = model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if not flat or texels.shape[1] < 3 or len(texels) < count:
        raise ValueError(
            f"texture {model.texture(texture).name}: expected a 2d texture of 3 or 4 channels with "
            f"a texel for each of the {count} vertices, found {len(texels)} texels of "
            f"{texels.shape[1]} channels{'' if flat else ' of another type'}"
        )
    colours = np.ones((count, 4), np.float32)
    colours[:, : texels.shape[1]] = texels[:count].astype(np.float32) / np.float32(255.0)
    return colours


def undrawn_by_mujoco(model: Any) -> list[str]:
    """Return what a model asks of its surfaces that MuJoCo's renderer cannot draw, for the log."""
    undrawn = []
    drawn = model.geom_group < 3
    kinds: tuple[tuple[NumberName, str], ...] = (
        ("double_sided", "the back of double-sided geoms"),
        ("alpha_cutoff", "the gaps of cut-out geoms"),
    )
    for name, words in kinds:
        if count := int((geom_numbers(model, name) > 0.0)[drawn].sum()):
            undrawn.append(f"{words}: {count}")
    coloured = sum(colours_texture(model, mesh) >= 0 for mesh in range(model.nmesh))
    if coloured:
        undrawn.append(f"vertex colours of meshes: {coloured}")
    return undrawn
