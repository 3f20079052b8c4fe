"""The map: key frames with their landmarks, and the search of an image for their patches.

Rows are in the order of age. Landmarks are corners, the best of each empty square of the image: J.
Shi and C. Tomasi, "Good Features to Track", CVPR 1994.

Patches are compared with their first key frames, so no error accumulates, and warped, so neither
distance nor slant shifts them. `References` are the images with which others are aligned where
corners are few, and after a loss.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from events.geometry import inverse
from nodes.estimators.images import Depth, Floats, Grey
from nodes.estimators.optical_flow import follow_both_ways
from nodes.estimators.pose import intrinsics, rays
from nodes.estimators.relocalization import DescribedPoints, detect_and_describe
from nodes.estimators.surfaces import Surfaces, surfaces_at
from nodes.estimators.visual_odometry.alignment import Alignment, Reference, View, align

_SHRUNK, _GROWN, _SHEARED = 0.6, 2.0, 2.5  # limits of a landmark's look relative to the first
_MEAN_OF = 20.0  # depth readings in the mean of a landmark's depth; a moving mean beyond
_CONTRADICTS = 5.0  # largest difference of a depth reading from a landmark's, standard deviations
_FARTHEST = 0.01  # least inverse depth, 1/m
_HIDES = 0.05  # least difference of another surface from a landmark, relative to inverse depth


_LANDMARK = np.dtype(
    [
        ("place", float, 3),  # metres in the world
        ("keyframe", np.int64),  # number of its first key frame; ascending in a table
        ("pixel", float, 2),  # there
        ("directions", float, (3, 3)),  # in the world: change by a column, by a row; the ray
        ("origin", float, 3),  # of the ray
        ("inverse", float),  # depth along it, 1/m
        ("slope", float, 2),  # its change by column and by row, 1/m
        ("readings", float),  # of depth, in the mean
        ("missed", np.int64),  # times in a row
        ("inactive_until", np.int64),
    ]
)


class Landmarks:
    """Points of the world, by rows of `table`."""

    def __init__(self, matrix: Floats) -> None:
        self._matrix = matrix
        self.table = np.empty(0, _LANDMARK)

    def __len__(self) -> int:
        return len(self.table)

    def add(self, number: int, pose: Floats, pixels: Floats, surfaces: Surfaces) -> Rows:
        """Add landmarks of a key frame and return their rows.

        Args:
            number: Number of the key frame, not less than any before.
            pose: World to camera, shape (4, 4).
            surfaces: Those of the landmarks, all continuous.
        """
        in_world, new = inverse(pose), np.zeros(len(pixels), _LANDMARK)
        fx, fy, *_ = intrinsics(self._matrix)
        axes = np.zeros((len(new), 3, 3))
        axes[:, 0, 0], axes[:, 1, 1] = 1 / fx, 1 / fy
        axes[:, :, 2] = rays(pixels, self._matrix)
        directions = in_world[:3, :3] @ axes
        new["directions"], new["origin"] = directions, in_world[:3, 3]
        new["place"] = in_world[:3, 3] + directions[:, :, 2] / surfaces.inverse[:, None]
        new["keyframe"], new["pixel"] = number, pixels
        new["inverse"], new["slope"], new["readings"] = surfaces.inverse, surfaces.slope, 1.0
        self.table = np.concatenate([self.table, new])
        return np.arange(len(self) - len(new), len(self))

    def forget_before(self, number: int) -> int:
        """Remove landmarks of earlier key frames; return their number."""
        removed = int(np.searchsorted(self.table["keyframe"], number))
        self.table = self.table[removed:]
        return removed

    def in_view(self, pose: Floats, size: tuple[int, int], margin: float, rows: Rows) -> Rows:
        """Return those of some landmarks in an image, or outside by at most `margin`.

        Args:
            pose: World to camera, shape (4, 4).
            size: Width and height.
            margin: Pixels; below zero for those well inside.
        """
        pixels, z = self.project(pose, rows)
        inside = (pixels > -margin).all(axis=1) & (pixels < np.array(size) - 1 + margin).all(axis=1)
        return rows[inside & (z > 0.05)]

    def project(self, pose: Floats, rows: Rows) -> tuple[Floats, Floats]:
        """Return the pixels of landmarks, shape (n, 2), and their depth, metres, shape (n,)."""
        fx, fy, cx, cy = intrinsics(self._matrix)
        points = self.table["place"][rows] @ pose[:3, :3].T + pose[:3, 3]
        z = points[:, 2]
        ahead = np.where(z > 0.05, z, 1.0)
        return np.stack([fx * points[:, 0] / ahead + cx, fy * points[:, 1] / ahead + cy], 1), z

    def unhidden(self, pose: Floats, inverse_depth: Depth, rows: Rows, noise: float) -> Rows:
        """Return those of some landmarks, all in view, where no other surface is measured.

        Args:
            pose: World to camera, shape (4, 4).
            inverse_depth: As of `odometry.inverse_depth`, shape (h, w).
            noise: Standard deviation of a reading, 1/m.
        """
        pixels, z = self.project(pose, rows)
        column, row = np.rint(pixels).astype(int).T
        measured = inverse_depth[row, column]
        off = np.abs(measured - 1.0 / z)
        return np.asarray(rows[(measured <= 0) | (off < np.maximum(_HIDES / z, 4 * noise))])

    def active(self, now: int, rows: Rows) -> Rows:
        """Return those of some landmarks to search now, as set by `update_found`."""
        return np.asarray(rows[self.table["inactive_until"][rows] <= now])

    def patches(self, pose: Floats, rows: Rows) -> tuple[Rows, Patches]:
        """Return rows whose view is alike enough, and patches, warped by planes' homographies."""
        fx, fy, *_ = intrinsics(self._matrix)
        expected, z = self.project(pose, rows)
        landmarks = self.table[rows]
        x = (landmarks["place"] @ pose[:3, :3].T + pose[:3, 3]) / z[:, None]
        turn = pose[:3, :3] @ landmarks["directions"][:, :, :2]
        origin = landmarks["origin"] @ pose[:3, :3].T + pose[:3, 3]
        # A neighbour's point, times its inverse depth, is direction + inverse depth × origin.
        change = turn + origin[:, :, None] * landmarks["slope"][:, None]
        change /= (landmarks["inverse"] * z)[:, None, None]
        warps = np.stack(
            [
                fx * (change[:, 0] - x[:, :1] * change[:, 2]),
                fy * (change[:, 1] - x[:, 1:2] * change[:, 2]),
            ],
            axis=1,
        )
        area = np.linalg.det(warps)
        good = (area > _SHRUNK**2) & (area < _GROWN**2)
        good &= np.abs(warps).max(axis=(1, 2)) < _SHEARED
        landmarks = landmarks[good]
        patches = Patches(landmarks["keyframe"], landmarks["pixel"], expected[good], warps[good])
        return rows[good], patches

    def update_found(self, now: int, matched: Rows, missed: Rows) -> None:
        """Record found landmarks; repeatedly missed ones are left out the longer."""
        self.table["missed"][matched] = 0
        self.table["missed"][missed] += 1
        self.table["inactive_until"][missed] = now + 1 + self.table["missed"][missed] ** 2

    def fuse(self, pose: Floats, rows: Rows, read: Surfaces, noise: float) -> None:
        """Move landmarks along their first rays to the mean of all readings (noise in 1/m)."""
        _, z = self.project(pose, rows)
        use = read.continuous & (np.abs(read.inverse - 1.0 / z) < _CONTRADICTS * noise)
        rows, inverse = rows[use], read.inverse[use]
        origin = self.table["origin"][rows] @ pose[2, :3] + pose[2, 3]
        ahead = self.table["directions"][rows, :, 2] @ pose[2, :3]
        beyond = 1.0 / inverse - origin
        updated = ahead / beyond
        # By how much the reading's noise grows on its way to the first key frame.
        gain = updated / (beyond * inverse**2)
        use = (beyond > 0.05) & (gain > 0.2)
        rows, updated, weight = rows[use], updated[use], 1.0 / gain[use] ** 2
        landmarks = self.table[rows]
        total = landmarks["readings"] + weight
        landmarks["inverse"] += (updated - landmarks["inverse"]) * weight / total
        landmarks["readings"] = np.minimum(total, _MEAN_OF)
        landmarks["place"] = (
            landmarks["origin"] + landmarks["directions"][:, :, 2] / landmarks["inverse"][:, None]
        )
        self.table[rows] = landmarks

    def change_depths(self, changes: Floats) -> None:
        """Change all inverse depths, 1/m, shape (n,), as far as they stay ahead."""
        table = self.table
        table["inverse"] = np.maximum(table["inverse"] + changes, _FARTHEST)
        table["place"] = table["origin"] + table["directions"][:, :, 2] / table["inverse"][:, None]


class MapMatch(msgspec.Struct, frozen=True, eq=False):
    """Landmarks of the map found in an image, and the pose from them."""

    pose: Floats  # world to camera, shape (4, 4)
    rows: Rows  # landmarks found, shape (n,)
    pixels: Floats  # their pixels, shape (n, 2)
    agree: npt.NDArray[np.bool_]  # mask of those that agree with the pose, shape (n,)
    missed: Rows

    @classmethod
    def without_landmarks(cls, pose: Floats) -> MapMatch:
        """Return a match without landmarks, for a pose known otherwise."""
        no_rows = np.empty(0, np.int64)
        return cls(pose, no_rows, np.empty((0, 2)), np.empty(0, np.bool_), no_rows)

    @property
    def share(self) -> float:
        """Share of the searched landmarks in agreement with the pose."""
        return float(self.agree.sum()) / (len(self.rows) + len(self.missed))


ORB_POINTS = 500  # number of points describing an image


class Keyframe(msgspec.Struct, frozen=True, eq=False):
    """Grey image, and pose (world to camera, shape (4, 4)), of some landmarks' first sight."""

    image: Grey
    pose: Floats


class Described:
    """A key frame's points for relocalization, described when a lost camera first asks for them.

    Args:
        inverse_depths: As of `inverse_depth`; released once described.
        matrix: K, shape (3, 3).
        noise: Standard deviation of inverse depth, 1/m.
    """

    def __init__(
        self, frame: Keyframe, inverse_depths: Depth, matrix: Floats, noise: float
    ) -> None:
        self._source: tuple[Keyframe, Depth] | None = frame, inverse_depths
        self._matrix, self._noise = matrix, noise

    @functools.cached_property
    def points(self) -> DescribedPoints:
        """The points, in the world."""
        assert self._source is not None
        (frame, inverse_depths), self._source = self._source, None
        pixels, descriptors = detect_and_describe(frame.image, ORB_POINTS)
        surfaces = surfaces_at(inverse_depths, pixels, self._noise)
        continuous, in_world = surfaces.continuous, inverse(frame.pose)
        points = rays(pixels[continuous], self._matrix) / surfaces.inverse[continuous, None]
        return DescribedPoints(
            points @ in_world[:3, :3].T + in_world[:3, 3], descriptors[continuous]
        )


RIM = 12  # pixels at the edge of the image without corners: patches need a neighbourhood
_APART = 10  # least distance of a new corner from another, pixels
_BLOCK = 5
_TEXTURE = 1.5e-4  # least eigenvalue of a corner in OpenCV's scale: above noise of two grey levels


def squares(pixels: Floats, spacing: int) -> Floats:
    """Return the number of each pixel's square, shape (n,)."""
    column, row = np.floor(pixels.T / spacing)
    return np.asarray(row * 65536 + column)


def find_corners(
    image: Grey,
    spacing: int,  # side of a square, pixels
    existing: Floats,  # other corners, column and row, shape (m, 2)
) -> Floats:
    """Return corners in empty squares, as whole pixels (column, row), shape (n, 2)."""
    strength = np.asarray(cv2.cornerMinEigenVal(image, _BLOCK))
    height, width = image.shape
    mask = np.zeros((height, width), bool)
    mask[RIM : height - RIM, RIM : width - RIM] = True
    for column, row in np.rint(existing).astype(int).tolist():
        mask[
            max(row - _APART, 0) : row + _APART + 1, max(column - _APART, 0) : column + _APART + 1
        ] = 0
    down, across = -(-height // spacing), -(-width // spacing)
    whole = np.zeros((down * spacing, across * spacing), np.float32)
    whole[:height, :width] = np.where(mask, strength, 0)
    blocks = whole.reshape(down, spacing, across, spacing).swapaxes(1, 2).reshape(-1, spacing**2)
    best = blocks.argmax(axis=1)
    square = np.arange(len(blocks))
    corners = np.stack(
        [square % across * spacing + best % spacing, square // across * spacing + best // spacing],
        axis=1,
    )
    corners = corners[blocks[square, best] > _TEXTURE].astype(np.float64)
    free = ~np.isin(squares(corners, spacing), squares(existing, spacing))
    return np.asarray(corners[free])


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
    expected = _cut_warped(patches, images, centre, half)
    # One tall image of squares each, so that one call follows them all.
    corner = centre.astype(int) - half
    views = np.lib.stride_tricks.sliding_window_view(image, (side, side))
    searched = np.ascontiguousarray(views[corner[:, 1], corner[:, 0]]).reshape(-1, side)
    middle = np.stack([np.full(len(centre), half), np.arange(len(centre)) * side + half], axis=1)
    start = middle + patches.expected - centre
    end, good = follow_both_ways(expected, searched, start, start, window, 0)
    shift = end - start.astype(np.float32)  # which is where the flow starts
    good &= np.abs(shift).max(axis=1) < MARGIN
    inner = slice(half - window // 2, half + window // 2 + 1)
    expected = expected.reshape(-1, side, side)[:, inner, inner]
    good &= correlation(expected, around(image, centre + shift, window)) > SAME
    return patches.expected + shift, good


def around(image: Grey, pixels: Floats, window: int) -> Grey:
    """Return the squares of an image around pixels, shape (n, 2); shape (n, window, window)."""
    steps = np.arange(window, dtype=np.float32) - window // 2
    x, y = pixels.T.astype(np.float32)[..., None] + steps
    columns, rows = np.tile(x, window), np.repeat(y, window, axis=1)  # a square a row
    patches = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(patches, np.uint8).reshape(-1, window, window)


def correlation(first: Grey, second: Grey) -> Floats:
    """Return how well squares, shape (n, w, w), correlate, shape (n,)."""
    pair = np.stack([first.reshape(len(first), -1), second.reshape(len(first), -1)]).astype(
        np.float64
    )
    pair -= pair.mean(axis=2, keepdims=True)
    size = np.sqrt((pair**2).sum(axis=2)).prod(axis=0)
    return np.asarray((pair[0] * pair[1]).sum(axis=1) / np.maximum(size, 1e-9))


def _cut_warped(patches: Patches, images: Mapping[int, Grey], centre: Floats, half: int) -> Grey:
    """Return squares around `centre` as expected in the new image, stacked vertically."""
    side = 2 * half + 1
    steps = np.arange(-half, half + 1, dtype=np.float32)
    to_source = np.linalg.inv(patches.warps).astype(np.float32)
    offset = (centre - patches.expected).astype(np.float32)
    # A square's pixel (x, y) in the old image: pixels + to_source @ (offset + (x, y)).
    origin = patches.pixels.astype(np.float32) + (to_source @ offset[:, :, None])[:, :, 0]
    across = origin.T[:, :, None] + to_source[:, :, 0].T[:, :, None] * steps
    columns, rows = across[:, :, None] + (to_source[:, :, 1].T[:, :, None] * steps)[..., None]
    cut = np.empty((len(centre), side, side), np.uint8)
    for number in np.unique(patches.source).tolist():
        members = np.flatnonzero(patches.source == number)
        cut[members] = cv2.remap(
            images[number],
            columns[members].reshape(-1, side),
            rows[members].reshape(-1, side),
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
        self._last: tuple[Grey, Depth, Floats] | None = None

    def remember(self, grey: Grey, inverse_depths: Depth, pose: Floats, aligned: bool) -> None:
        """Store a grey image of known pose; `aligned` keeps the present reference."""
        self._last, self._bridge = (grey, inverse_depths, pose), None
        if not aligned:
            self._reference = None

    def renew(self, view: View, pose: Floats) -> None:
        """Make a view the reference; its pose is world to camera, shape (4, 4)."""
        self._reference = self._make_reference(view, pose)

    def align(self, view: View, starts: list[Floats], lost: bool) -> Alignment | None:
        """Return a view's alignment with the reference, or the last image, from initial poses."""
        alignment = None
        if self._reference is not None:
            alignment = self._best(self._reference, view, starts, lost)
        if alignment is None and self._last is not None:
            grey, inverse_depths, pose = self._last
            if self._reference is None or (self._reference.pose != pose).any():
                self._reference = self._make_reference(View.of(grey, inverse_depths), pose)
                alignment = self._best(self._reference, view, starts, lost)
        return alignment

    def _best(
        self, reference: Reference, view: View, starts: list[Floats], lost: bool
    ) -> Alignment | None:
        """Return the alignment with most agreeing edges, from several initial poses."""
        tried = (self._align(reference, view, start, lost) for start in starts)
        return max((a for a in tried if a), key=lambda f: f.sharp, default=None)

    def carry(self, view: View, expected: Floats) -> Floats:
        """Return a view's pose while lost, by alignment with images before it, or as expected."""
        alignment = (
            None if self._bridge is None else self._align(self._bridge, view, expected, False)
        )
        pose = expected if alignment is None else alignment.pose
        if alignment is None or alignment.share < _AGREE:
            self._bridge = self._make_reference(view, pose) if self.suffices(view) else None
        return pose

    def suffices(self, view: View) -> bool:
        """Return whether a view suffices as a reference of alignments."""
        start = np.eye(4)
        return self._align(self._make_reference(view, start), view, start, False) is not None

    def _make_reference(self, view: View, pose: Floats) -> Reference:
        return Reference.of(view, pose, self._matrix, self._noise)

    def _align(
        self, reference: Reference, view: View, expected: Floats, lost: bool
    ) -> Alignment | None:
        prior = _PRIOR_LOST if lost else _PRIOR
        alignment = align(reference, view, expected, self._matrix, _READING * self._noise, prior)
        enough = bool(alignment.agree.sum() >= _POINTS and alignment.agree.mean() > _AGREE)
        enough &= alignment.sharp > (_AGREE_AGAIN if lost else _AGREE)
        return alignment if enough and alignment.deviation() < _UNSURE else None
