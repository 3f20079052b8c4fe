"""The image with which others are aligned where corners are few, and the way through a loss."""

from __future__ import annotations

import numpy as np

from nodes.estimators.odometry.images import Depth, Floats, Grey
from nodes.estimators.visual_odometry.alignment import Alignment, Reference, View, align

_UNSURE = 0.1
"""Metres of a position's standard deviation from which on an image says too little."""
_AGREE = 0.6
"""Least share of the points in view that must agree,"""
_AGREE_AGAIN = 0.8
"""the same of edges after a loss, when the alignment may have found the wrong ones,"""
_POINTS = 60
"""and their least number."""
_PRIOR = 0.02, 0.02
"""Standard deviations of the pose expected by constant velocity: metres, radians."""
_PRIOR_LOST = 0.3, 0.2
"""The same while tracking is lost."""
_READING = 0.5
"""Noise of the distance of a surface, as a share of that of one pixel."""


class References:
    """Aligns images with the last one that was made a reference.

    Args:
        matrix: K, shape (3, 3).
        noise: Standard deviation of one pixel's inverse depth, 1/m.
    """

    def __init__(self, matrix: Floats, noise: float) -> None:
        self._matrix = matrix
        self._noise = noise
        self._reference: Reference | None = None
        self._bridge: Reference | None = None
        self._known: tuple[Grey, Depth, Floats] | None = None

    def note(self, grey: Grey, inverse_of: Depth, pose: Floats, aligned: bool) -> None:
        """Remember an image whose pose is known; it becomes the reference should one be needed.

        Args:
            grey: Grey image.
            inverse_of: Inverse depth, as `inverse_depth` gives it.
            pose: World to camera, shape (4, 4).
            aligned: Whether the present reference served, and shall be kept.
        """
        self._known, self._bridge = (grey, inverse_of, pose), None
        if not aligned:
            self._reference = None

    def renew(self, view: View, pose: Floats) -> None:
        """Make a view the reference; its pose is world to camera, shape (4, 4)."""
        self._reference = self._made(view, pose)

    def align(self, view: View, starts: list[Floats], lost: bool) -> Alignment | None:
        """Return the alignment of a view with the reference, or with the last known image.

        Args:
            view: The view.
            starts: Expected poses to begin with, world to camera, shape (4, 4) each.
            lost: Whether these are guesses only.
        """
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
        """Return the alignment from one of some poses in which most edges agree."""
        tried = (self._align(reference, view, start, lost) for start in starts)
        return max((found for found in tried if found), key=lambda f: f.sharp, default=None)

    def carry(self, view: View, expected: Floats) -> Floats:
        """Return the pose of a view while tracking is lost.

        It is found by alignment with the lost images before it, or else is as expected.
        """
        found = None if self._bridge is None else self._align(self._bridge, view, expected, False)
        pose = expected if found is None else found.pose
        if found is None or found.share < _AGREE:
            self._bridge = self._made(view, pose) if self.suffices(view) else None
        return pose

    def suffices(self, view: View) -> bool:
        """Return whether a view shows enough for others to be aligned with it."""
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
