"""Textures of a mesh: their size, and the colour of what lies between their used parts."""

from __future__ import annotations

import numpy as np

from sims.scans.textures import extended, fitted

CORNER = np.array(
    [[[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]], [[0.5, 0.0], [0.5, 0.5], [0.0, 0.5]]], np.float32
)


def test_large_images_are_made_smaller_in_proportion() -> None:
    image = np.full((100, 40, 3), 7, np.uint8)
    assert fitted(image, 50).shape == (50, 20, 3)
    assert fitted(image, 100).shape == image.shape


def test_unused_texels_have_the_colour_of_the_nearest_used_one() -> None:
    image = np.zeros((32, 32, 3), np.uint8)
    image[:17, :17] = (200, 100, 50)  # edges touch a texel more
    filled = extended(image, CORNER)
    assert (filled == (200, 100, 50)).all()
    assert not image[17:].any()  # the original stays


def test_used_texels_stay_even_where_triangles_overlap() -> None:
    image = np.arange(32 * 32 * 3, dtype=np.uint64).reshape(32, 32, 3).astype(np.uint8)
    filled = extended(image, np.concatenate([CORNER, CORNER]))
    np.testing.assert_array_equal(filled[:15, :15], image[:15, :15])


def test_images_that_repeat_stay() -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    assert extended(image, CORNER * 3.0) is image
    assert extended(image, CORNER[:0]) is image
