"""Finding patches of key frames in a picture, each warped as the picture should show it.

A patch is compared with its own first sight and never with its last, so that nothing adds up; and
it is compared as it looks from here, so that neither distance nor slant moves it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from nodes.visual_odometry.tracker import Floats, Grey

Rows = npt.NDArray[np.int64]

MARGIN = 4
"""Pixels by which a patch may lie off the place expected."""
_ROUND_TRIP = 0.5
"""Pixels by which a patch followed there and back may miss itself."""
_ENDS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_FLAT = 1e-4
"""Least eigenvalue that OpenCV's optical flow takes for texture."""


class Patches(msgspec.Struct, frozen=True, eq=False):
    """Patches to look for.

    Attributes:
        source: Which picture each is cut from, shape (n,).
        pixels: Its centre there, column and row, shape (n, 2).
        expected: Its centre in the new picture, shape (n, 2).
        warps: Pixels of the new picture by pixels of the old one, shape (n, 2, 2).
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
    patches: Patches, pictures: Mapping[int, Grey], image: Grey, window: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return where patches are, shape (n, 2), and which of them were found, shape (n,).

    Args:
        patches: At least one; expected `half_width` or more from the picture's edge.
        pictures: Those that they are cut from.
        image: Where to look.
        window: Side of what is compared, pixels; odd.
    """
    half = half_width(window)
    side = 2 * half + 1
    centre = np.rint(patches.expected)
    wanted = _cut_warped(patches, pictures, centre, half)
    # One tall picture of squares each, so that one call follows them all.
    corner = centre.astype(int) - half
    views = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    there = np.ascontiguousarray(views[corner[:, 1], corner[:, 0]]).reshape(-1, side)
    middle = np.stack([np.full(len(centre), half), np.arange(len(centre)) * side + half], axis=1)
    start = (middle + patches.expected - centre).astype(np.float32).reshape(-1, 1, 2)
    end, arrived = _follow(wanted, there, start, start, window)
    back, returned = _follow(there, wanted, end, start, window)
    moved = (end - start).reshape(-1, 2).astype(np.float64)
    miss = np.abs(back - start).reshape(-1, 2).max(axis=1)
    good = arrived & returned & (miss < _ROUND_TRIP) & (np.abs(moved).max(axis=1) < MARGIN)
    return patches.expected + moved, good


def _cut_warped(patches: Patches, pictures: Mapping[int, Grey], centre: Floats, half: int) -> Grey:
    """Return the squares around `centre` as the new picture should show them, one upon another."""
    side = 2 * half + 1
    steps = np.arange(-half, half + 1, dtype=np.float32)
    back = np.linalg.inv(patches.warps).astype(np.float32)
    offset = (centre - patches.expected).astype(np.float32)
    # Where in the old picture a square's pixel (x, y) lies: pixels + back @ (offset + (x, y)).
    origin = patches.pixels.astype(np.float32) + (back @ offset[:, :, None])[:, :, 0]
    grid = (
        origin[:, None, None]
        + back[:, None, None, :, 0] * steps[None, None, :, None]
        + back[:, None, None, :, 1] * steps[None, :, None, None]
    )
    no_second: Any = None  # the maps are of two channels
    cut = np.empty((len(centre), side, side), np.uint8)
    for number in np.unique(patches.source).tolist():
        rows = np.flatnonzero(patches.source == number)
        cut[rows] = cv2.remap(
            pictures[number],
            grid[rows].reshape(-1, side, 2),
            no_second,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, side, side)
    return cut.reshape(-1, side)


def _follow(
    before: Grey,
    after: Grey,
    start: npt.NDArray[np.float32],
    guess: npt.NDArray[np.float32],
    window: int,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    end, arrived, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        guess.copy(),
        winSize=(window, window),
        maxLevel=0,
        criteria=_ENDS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_FLAT,
    )
    return np.asarray(end, np.float32), np.asarray(arrived).ravel() == 1
