"""Search of an image for patches of key frames, each warped to the expected view.

Patches are compared with their first key frames, so no error accumulates, and warped, so neither
distance nor slant shifts them. `References` are the images with which others are aligned where
corners are few, and after a loss.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.estimators.odometry import Depth, Floats, Grey, follow_both_ways
from nodes.estimators.visual_odometry.alignment import Alignment, Reference, View, align

SAME = 0.5  # least correlation of a patch with its counterpart; flow alone would confirm any place
Rows = npt.NDArray[np.int64]

MARGIN = 4  # largest distance of a patch from its expected place, pixels


class Patches(msgspec.Struct, frozen=True, eq=False):
    """Patches to look for."""

    source: Rows  # number of each's image, shape (n,)
    pixels: Floats  # its centre there, column and row, shape (n, 2)
    expected: Floats  # its centre in the new image, shape (n, 2)
    warps: Floats  # pixels of the new image by pixels of the old one, shape (n, 2, 2)

    def take(self, rows: Rows) -> Patches:
        """Return some of them."""
        return Patches(self.source[rows], self.pixels[rows], self.expected[rows], self.warps[rows])


def half_width(window: int) -> int:
    """Return how many pixels beside its centre the search for a patch touches."""
    return window // 2 + MARGIN + 1


def find_patches(
    patches: Patches,  # at least one; expected `half_width` or more from the image's edge
    images: Mapping[int, Grey],  # their sources, by number
    image: Grey,
    window: int,  # side of the compared square, pixels; odd, 7 or more
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return the places of patches, shape (n, 2), and a mask of the found, shape (n,)."""
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
    """Return squares around `centre` as expected in the new image, stacked vertically."""
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


_UNSURE = 0.1  # largest standard deviation of position of a usable alignment, metres
_AGREE = 0.6  # least share of agreeing points in view
_AGREE_AGAIN = 0.8  # the same of edges after a loss, when these may be the wrong ones
_POINTS = 60  # and their least number
_PRIOR = 0.02, 0.02  # standard deviations of the pose by constant velocity: m, rad
_PRIOR_LOST = 0.3, 0.2  # the same while tracking is lost
_READING = 0.5  # noise of a surface's distance, relative to a single pixel's


class References:
    """Alignment of images with the last reference; noise is of one pixel's inverse depth, 1/m."""

    def __init__(self, matrix: Floats, noise: float) -> None:
        self._matrix, self._noise = matrix, noise
        self._reference: Reference | None = None
        self._bridge: Reference | None = None
        self._known: tuple[Grey, Depth, Floats] | None = None

    def note(self, grey: Grey, inverse_of: Depth, pose: Floats, aligned: bool) -> None:
        """Remember a grey image of known pose; `aligned` keeps the present reference."""
        self._known, self._bridge = (grey, inverse_of, pose), None
        if not aligned:
            self._reference = None

    def renew(self, view: View, pose: Floats) -> None:
        """Make a view the reference; its pose is world to camera, shape (4, 4)."""
        self._reference = self._made(view, pose)

    def align(self, view: View, starts: list[Floats], lost: bool) -> Alignment | None:
        """Return a view's alignment with the reference, or the last image, from initial poses."""
        found = None
        if self._reference is not None:
            found = self._best(self._reference, view, starts, lost)
        if found is None and self._known is not None:
            grey, inverse_of, pose = self._known
            if self._reference is None or (self._reference.pose != pose).any():
                self._reference = self._made(View.of(grey, inverse_of), pose)
                found = self._best(self._reference, view, starts, lost)
        return found

    def _best(
        self, reference: Reference, view: View, starts: list[Floats], lost: bool
    ) -> Alignment | None:
        """Return the alignment with most agreeing edges, from several initial poses."""
        tried = (self._align(reference, view, start, lost) for start in starts)
        return max((found for found in tried if found), key=lambda f: f.sharp, default=None)

    def carry(self, view: View, expected: Floats) -> Floats:
        """Return a view's pose while lost, by alignment with images before it, or as expected."""
        found = None if self._bridge is None else self._align(self._bridge, view, expected, False)
        pose = expected if found is None else found.pose
        if found is None or found.share < _AGREE:
            self._bridge = self._made(view, pose) if self.suffices(view) else None
        return pose

    def suffices(self, view: View) -> bool:
        """Return whether a view suffices as a reference of alignments."""
        start = np.eye(4)
        return self._align(self._made(view, start), view, start, False) is not None

    def _made(self, view: View, pose: Floats) -> Reference:
        return Reference.of(view, pose, self._matrix, self._noise)

    def _align(
        self, reference: Reference, view: View, expected: Floats, lost: bool
    ) -> Alignment | None:
        prior = _PRIOR_LOST if lost else _PRIOR
        found = align(reference, view, expected, self._matrix, _READING * self._noise, prior)
        enough = bool(found.agree.sum() >= _POINTS and found.agree.mean() > _AGREE)
        enough &= found.sharp > (_AGREE_AGAIN if lost else _AGREE)
        return found if enough and found.deviation() < _UNSURE else None
