"""Finding patches of key frames in an image, each warped as the image should show it.

A patch is always compared with the key frame in which it was first seen, so that no error
accumulates, and it is warped, so that neither distance nor slant shifts it.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry.images import Floats, Grey, follow_both_ways

SAME = 0.5
"""Least correlation of a patch with what is found: flow finds noise wherever it begins, and so says
of any expected place that it is right."""

Rows = npt.NDArray[np.int64]

MARGIN = 4
"""Pixels by which a patch may lie off the place expected."""


class Patches(msgspec.Struct, frozen=True, eq=False):
    """Patches to look for.

    Attributes:
        source: Number of the image that each is cut from, shape (n,).
        pixels: Its centre there, column and row, shape (n, 2).
        expected: Its centre in the new image, shape (n, 2).
        warps: Pixels of the new image by pixels of the old one, shape (n, 2, 2).
    """

    source: Rows
    pixels: Floats
    expected: Floats
    warps: Floats

    def take(self, rows: Rows) -> Patches:
        """Return some of them."""
        return Patches(self.source[rows], self.pixels[rows], self.expected[rows], self.warps[rows])


def half_width(window: int) -> int:
    """Return how many pixels beside its centre the search for a patch touches."""
    return window // 2 + MARGIN + 1


def find_patches(
    patches: Patches, images: Mapping[int, Grey], image: Grey, window: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return where patches are, shape (n, 2), and which of them were found, shape (n,).

    Args:
        patches: At least one; expected `half_width` or more from the image's edge.
        images: Those that they are cut from, by number.
        image: Where to look.
        window: Side of what is compared, pixels; odd, 7 or more.
    """
    half = half_width(window)
    side = 2 * half + 1
    centre = np.rint(patches.expected)
    wanted = _cut_warped(patches, images, centre, half)
    # One tall image of squares each, so that one call follows them all.
    corner = centre.astype(int) - half
    views = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    there = np.ascontiguousarray(views[corner[:, 1], corner[:, 0]]).reshape(-1, side)
    middle = np.stack([np.full(len(centre), half), np.arange(len(centre)) * side + half], axis=1)
    start = middle + patches.expected - centre
    end, good = follow_both_ways(wanted, there, start, start, window, 0)
    shift = end - start.astype(np.float32)  # which is where the flow starts
    good &= np.abs(shift).max(axis=1) < MARGIN
    inner = slice(half - window // 2, half + window // 2 + 1)
    wanted = wanted.reshape(-1, side, side)[:, inner, inner]
    good &= correlation(wanted, around(image, centre + shift, window)) > SAME
    return patches.expected + shift, good


def around(image: Grey, pixels: Floats, window: int) -> Grey:
    """Return the squares of an image around pixels, shape (n, 2); shape (n, window, window)."""
    steps = np.arange(window, dtype=np.float32) - window // 2
    x, y = pixels.T.astype(np.float32)[..., None] + steps
    columns, rows = np.tile(x, window), np.repeat(y, window, axis=1)  # a square a row
    found = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.uint8).reshape(-1, window, window)


def correlation(one: Grey, other: Grey) -> Floats:
    """Return how well squares, shape (n, w, w), correlate, shape (n,)."""
    pair = np.stack([one.reshape(len(one), -1), other.reshape(len(one), -1)]).astype(np.float64)
    pair -= pair.mean(axis=2, keepdims=True)
    size = np.sqrt((pair**2).sum(axis=2)).prod(axis=0)
    return np.asarray((pair[0] * pair[1]).sum(axis=1) / np.maximum(size, 1e-9))


def _cut_warped(patches: Patches, images: Mapping[int, Grey], centre: Floats, half: int) -> Grey:
    """Return the squares around `centre` as the new image should show them, one above another."""
    side = 2 * half + 1
    steps = np.arange(-half, half + 1, dtype=np.float32)
    back = np.linalg.inv(patches.warps).astype(np.float32)
    offset = (centre - patches.expected).astype(np.float32)
    # Where in the old image a square's pixel (x, y) lies: pixels + back @ (offset + (x, y)).
    origin = patches.pixels.astype(np.float32) + (back @ offset[:, :, None])[:, :, 0]
    across = origin.T[:, :, None] + back[:, :, 0].T[:, :, None] * steps
    columns, rows = across[:, :, None] + (back[:, :, 1].T[:, :, None] * steps)[..., None]
    cut = np.empty((len(centre), side, side), np.uint8)
    for number in np.unique(patches.source).tolist():
        here = np.flatnonzero(patches.source == number)
        cut[here] = cv2.remap(
            images[number],
            columns[here].reshape(-1, side),
            rows[here].reshape(-1, side),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, side, side)
    return cut.reshape(-1, side)
