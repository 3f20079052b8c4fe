"""Textures as the rasteriser reads them: the texels of all images in all sizes, in one array."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from sims.cameras.layouts import address
from sims.cameras.surfaces import colours_texture, texture_bytes

Image = npt.NDArray[np.uint8]
MOST_TEXELS = (1 << 31) - 1  # the rasteriser numbers them with 31 bits
_WHITE = 2  # white ones, before all others


class TexturePlace(NamedTuple):
    """Texture among all texels: where it begins, its size (a cube's six sides below each other)."""

    start: int
    width: int
    height: int
    channels: int
    is_cube: bool


def places_of(
    model: Any, library: Any, images: Mapping[str, Image]
) -> tuple[list[TexturePlace | None], int]:
    """Return the place of each texture, None for vertices' colours, and the number of all texels.

    Args:
        images: Those of which the model has only the name, by this.

    Raises:
        ValueError: There is no room for so many.
    """
    colours = {colours_texture(model, mesh) for mesh in range(model.nmesh)}
    colours -= set(model.mat_texid.ravel().tolist())
    places: list[TexturePlace | None] = []
    count = _WHITE
    for number in range(model.ntex):
        if number in colours:
            places.append(None)
            continue
        name = model.texture(number).name
        width, height = int(model.tex_width[number]), int(model.tex_height[number])
        if name in images:
            height, width = images[name].shape[:2]
        is_cube = model.tex_type[number] != mujoco.mjtTexture.mjTEXTURE_2D
        if is_cube and height == width:  # all of its faces
            height *= 6
        channels = int(model.tex_nchannel[number])
        places.append(TexturePlace(count, width, height, channels, is_cube))
        count += int(library.raster_texel_count(width, height, int(is_cube)))
        if count > MOST_TEXELS:
            raise ValueError(
                f"texture {name or number}: expected fewer than 2³¹ texels of all textures and "
                f"their smaller copies, found more with its {width} x {model.tex_height[number]}"
            )
    return places, count


def fill(
    texels: npt.NDArray[np.uint32],
    model: Any,
    library: Any,
    images: Mapping[str, Image],
    places: list[TexturePlace | None],
) -> None:
    """Write the textures of a model, and two white texels, each to its place."""
    texels[:_WHITE] = 0xFFFFFF
    for number, place in enumerate(places):
        if place is None:
            continue
        data = texture_bytes(model, number, images.get(model.texture(number).name))
        if place.height * place.width > len(data):
            data = np.tile(data, (6, 1))
        start, width, height, channels, is_cube = place
        library.raster_fill(
            address(texels[start:]), width, height, channels, address(data), int(is_cube)
        )
