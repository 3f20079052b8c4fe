"""A mesh file made ready for a world: in its place, in parts, with what is solid of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import unique_name
from sims.scans.settings import UNITS, MeshSpec
from sims.scans.solids import find_floor, voxel_boxes
from sims.scans.textures import extended, fitted

MOST_TRIANGLES = 4000  # of a part: what is out of view or hidden is left out part by part
CLUSTER = 64  # triangles that the rasteriser leaves out together
MOST_OBJECTS = 1000  # that are told apart: each costs physics some time
FARTHEST = 20_000.0  # metres from the origin, where float32 still tells 2 mm apart
MANY_BOXES = 10_000  # 0.15 ms a step of the physics
ALPHA_CUTOFF = 0.5  # of images whose alpha is opacity
_UP = {  # rows of the turn from a file's axes to x north, y west, z up
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
}


class Part(NamedTuple):
    """Neighbouring triangles of one object and one material; NWU, metres."""

    name: str  # `<object>.chunk<number>`
    material: int
    points: npt.NDArray[np.float32]  # shape (n, 3)
    corners: npt.NDArray[np.int32]  # shape (m, 3)
    normals: npt.NDArray[np.float32]  # shape (n, 3)
    places: npt.NDArray[np.float32] | None  # shape (n, 2)
    colours: npt.NDArray[np.uint8] | None  # shape (n, 4)


class Prepared(NamedTuple):
    """What a world needs of a mesh file; NWU, metres."""

    parts: tuple[Part, ...]
    materials: tuple[Material, ...]
    hulls: tuple[Part, ...]  # solid by their convex hulls, if not `parts` are
    boxes: Floats  # solid boxes: low and high corner, shape (k, 6)
    floor: float | None  # height of the ground's plane
    baked: bool
    extent: Floats  # low and high corner of all triangles, shape (2, 3)
    notes: tuple[str, ...]  # sentences: what was left out, or guessed


def prepare(file: MeshFile, spec: MeshSpec, solids: MeshFile | None = None) -> Prepared:
    """Return what a world needs of a file.

    Args:
        solids: The file that `spec.solid` names.

    Raises:
        MeshError: The mesh is too far away or too large for `spec.voxel`.
    """
    notes = list(file.left_out)
    pieces = [_placed(piece, file, spec) for piece in file.pieces if len(piece.corners)]
    extent = _extent(pieces)
    _check_extent(extent, spec)
    notes += _odd_size(extent)
    baked = spec.light == "baked" or (spec.light == "auto" and _is_baked(file))
    parts = tuple(_parts(_few_objects(pieces, notes)))
    points, corners = joined(pieces)
    floor: float | None = None
    if spec.floor == "auto":
        floor, reason = find_floor(points, corners)
        if floor is None:
            notes.append(f"floor: there is no plane below the mesh: {reason}")
    elif spec.floor != "none":
        floor = spec.floor
    collision = [_placed(piece, file, spec) for piece in file.solids]
    hulls: tuple[Part, ...] = ()
    boxes = np.empty((0, 6))
    if solids is not None:
        hulls = tuple(_parts([_placed(piece, solids, spec) for piece in solids.pieces], math.inf))
    elif spec.solid == "hulls":
        hulls = tuple(_parts(collision, math.inf))
    elif spec.solid == "voxels":
        points, corners = joined(collision) if collision else (points, corners)
        if floor is not None:  # a plane stands for the ground, which may be kilometres wide
            corners = corners[points[corners, 2].max(axis=1) > floor + 0.5 * spec.voxel]
        try:
            boxes = voxel_boxes(points, corners, spec.voxel, floor)
        except MeshError as error:
            longest = float((extent[1] - extent[0]).max())
            raise MeshError(
                f"{error}. Or is the unit wrong? The mesh is {longest:.4g} m long"
            ) from None
        if len(boxes) > MANY_BOXES:
            notes.append(
                f"solid: {len(boxes):,} boxes, which slow the physics; a voxel of "
                f"{2.0 * spec.voxel:g} m makes fewer"
            )
    return Prepared(
        parts, tuple(_materials(file, spec, notes)), hulls, boxes, floor, baked, extent,
        tuple(notes),
    )  # fmt: skip


def _placed(piece: Piece, file: MeshFile, spec: MeshSpec) -> Piece:
    """Return a piece in the world's axes."""
    unit = spec.unit if isinstance(spec.unit, float) else UNITS.get(spec.unit, file.unit or 1.0)
    turn = np.array(_UP[(file.up or "z") if spec.up == "auto" else spec.up], np.float64)
    angle = -math.radians(spec.heading)
    cosine, sine = math.cos(angle), math.sin(angle)
    turn = np.stack([cosine * turn[0] - sine * turn[1], sine * turn[0] + cosine * turn[1], turn[2]])
    north, east, down = spec.position
    points = _turned(piece.points * unit, turn) + np.array((north, -east, -down))
    normals = piece.normals
    if normals is not None:
        normals = _turned(normals.astype(np.float64), turn).astype(np.float32)
    return piece._replace(points=points, normals=normals)


def _turned(vectors: Floats, turn: Floats) -> Floats:
    """Return vectors times a matrix, with the same bits on every machine (BLAS has its own)."""
    x, y, z = vectors.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in turn], axis=-1)


def _extent(pieces: Sequence[Piece]) -> Floats:
    low = np.min([piece.points.min(axis=0) for piece in pieces], axis=0)
    high = np.max([piece.points.max(axis=0) for piece in pieces], axis=0)
    return np.stack([low, high])


def _check_extent(extent: Floats, spec: MeshSpec) -> None:
    if abs(extent).max() <= FARTHEST:
        return
    north, west, _ = ((extent[0] + extent[1]) / 2.0).tolist()
    up = float(extent[0, 2])
    position = [round(a - b, 1) for a, b in zip(spec.position, (north, -west, -up), strict=True)]
    raise MeshError(
        f"mesh: expected all within {FARTHEST / 1000:g} km of the origin, found x from "
        f"{extent[0, 0]:.0f} to {extent[1, 0]:.0f} m, y from {extent[0, 1]:.0f} to "
        f"{extent[1, 1]:.0f} m: bring it near by position = {position}, or say its unit"
    )


def _odd_size(extent: Floats) -> Iterator[str]:
    longest = float((extent[1] - extent[0]).max())
    if longest > 3000.0 or longest < 1.0:
        yield (
            f'unit: the mesh is {longest:.3g} m long; if that is wrong, say its unit: "mm", "cm", '
            '"m", "km", "in", "ft", or metres'
        )


def _is_baked(file: MeshFile) -> bool:
    used = {piece.material for piece in file.pieces}
    if any(file.materials[number].unlit for number in used):
        return True
    coloured = any(piece.colours is not None for piece in file.pieces) or any(
        file.materials[number].image is not None for number in used
    )
    return coloured and not file.lit and all(piece.normals is None for piece in file.pieces)


def joined(pieces: Sequence[Piece | Part]) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Return points and corners of several pieces as those of one."""
    starts = np.cumsum([0] + [len(piece.points) for piece in pieces])
    corners = [piece.corners + start for piece, start in zip(pieces, starts, strict=False)]
    points = np.concatenate([piece.points for piece in pieces])
    return points.astype(np.float64), np.concatenate(corners).astype(np.int32)


def _few_objects(pieces: Sequence[Piece], notes: list[str]) -> list[Piece]:
    """Return pieces of at most `MOST_OBJECTS` objects: the smallest become one."""
    counts: dict[str, int] = {}
    for piece in pieces:
        counts[piece.object] = counts.get(piece.object, 0) + len(piece.corners)
    if len(counts) <= MOST_OBJECTS:
        return list(pieces)
    largest = sorted(counts, key=lambda name: -counts[name])[: MOST_OBJECTS - 1]
    alone, rest = set(largest), "rest"
    notes.append(
        f"{len(counts) - len(alone)} of {len(counts)} objects, the smallest, are one object "
        f"({rest}) in segmentation"
    )
    return _by_material([p if p.object in alone else p._replace(object=rest) for p in pieces])


def _by_material(pieces: Iterable[Piece]) -> list[Piece]:
    """Return pieces of which those of one object and material, with the same fields, are joined."""
    groups: dict[tuple[object, ...], list[Piece]] = {}
    for piece in pieces:
        fields = (piece.normals is None, piece.places is None, piece.colours is None)
        groups.setdefault((piece.object, piece.material, *fields), []).append(piece)
    result = []
    for group in groups.values():
        points, corners = joined(group)
        first = group[0]
        normals, places, colours = (
            None
            if getattr(first, field) is None
            else np.concatenate([getattr(p, field) for p in group])
            for field in ("normals", "places", "colours")
        )
        result.append(
            Piece(first.object, first.material, points, corners, normals, places, colours)
        )
    return result


def _parts(pieces: Iterable[Piece], most: float = MOST_TRIANGLES) -> Iterator[Part]:
    """Yield the parts of all pieces, of at most so many triangles each."""
    numbers: dict[str, int] = {}
    names: dict[str, str] = {}
    taken: set[str] = set()
    for piece in pieces:
        if piece.object not in names:
            base = re.sub(r"[^\w.+-]+", "_", piece.object).strip("_")[:60] or "object"
            names[piece.object] = unique_name(base, taken)
        name = names[piece.object]
        corners = _with_area(piece)
        normals = _normals(piece, corners) if piece.normals is None else piece.normals
        for chosen in _cut(piece.points[corners].mean(axis=1), most) if len(corners) else ():
            number = numbers.get(name, 0)
            numbers[name] = number + 1
            yield _part(f"{name}.chunk{number}", piece, corners[chosen], normals)


def _with_area(piece: Piece) -> npt.NDArray[np.int32]:
    a, b, c = piece.points.astype(np.float32)[piece.corners].astype(np.float64).transpose(1, 0, 2)
    return np.asarray(piece.corners[(np.cross(b - a, c - a) != 0.0).any(axis=1)])


def _normals(piece: Piece, corners: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Return normals of vertices: the mean of their triangles', by area."""
    a, b, c = piece.points[corners].transpose(1, 0, 2)
    areas = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    sums = [
        np.bincount(corners.ravel(), weights=areas[:, axis], minlength=len(piece.points))
        for axis in range(3)
    ]
    normals = np.stack(sums, axis=-1)
    length = np.sqrt((normals * normals).sum(axis=1, keepdims=True))
    return np.where(length > 0.0, normals / np.maximum(length, 1e-300), (0.0, 0.0, 1.0)).astype(
        np.float32
    )


def _cut(middles: Floats, most: float) -> Iterator[npt.NDArray[np.intp]]:
    """Yield the numbers of neighbouring triangles, halved along the longest side until few.

    The rasteriser leaves out `CLUSTER` triangles in a row at a time, so these are neighbours, too.
    """
    waiting = [np.arange(len(middles))]
    part: list[npt.NDArray[np.intp]] = []
    room = 0  # triangles that the present part still gets
    while waiting:
        chosen = waiting.pop()
        if not room and len(chosen) <= most:
            room = len(chosen)
        if room and len(chosen) <= CLUSTER:
            part.append(np.sort(chosen))
            room -= len(chosen)
            if not room:
                yield np.concatenate(part)
                part = []
            continue
        places = middles[chosen]
        axis = int(np.argmax(places.max(axis=0) - places.min(axis=0)))
        order = np.argsort(places[:, axis], kind="stable")
        half = -(-len(order) // (2 * CLUSTER)) * CLUSTER
        waiting += [chosen[order[half:]], chosen[order[:half]]]


def _part(
    name: str, piece: Piece, corners: npt.NDArray[np.int32], normals: npt.NDArray[np.float32]
) -> Part:
    used, first, numbers = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(first)  # vertices in the order in which they are used
    used, numbers = used[order], np.argsort(order)[numbers]
    points = piece.points[used].astype(np.float32)
    return Part(
        name,
        piece.material,
        points,
        numbers.reshape(-1, 3).astype(np.int32),
        normals[used],
        None if piece.places is None else piece.places[used],
        None if piece.colours is None else piece.colours[used],
    )


def _materials(file: MeshFile, spec: MeshSpec, notes: list[str]) -> Iterator[Material]:
    """Yield the materials with images as they are drawn; equal images stay one array."""
    corners: dict[int, list[npt.NDArray[np.float32]]] = {}  # by the image
    placed = set()
    for piece in file.pieces:
        if piece.places is not None:
            placed.add(piece.material)
            image = file.materials[piece.material].image
            corners.setdefault(id(image), []).append(piece.places[piece.corners])
    drawn: dict[tuple[int, bool], npt.NDArray[np.uint8]] = {}
    smaller = seen_through = 0
    for number, material in enumerate(file.materials):
        material = material._replace(double_sided=material.double_sided or spec.double_sided)
        if material.image is None or number not in placed:
            yield material._replace(image=None)
            continue
        cutoff, key = material.cutoff, id(material.image)
        alpha = material.image.shape[2] == 4
        if alpha and not cutoff and material.blend and material.image[..., 3].min() < 250:
            cutoff, seen_through = ALPHA_CUTOFF, seen_through + 1
        if (key, bool(cutoff)) not in drawn:
            image = fitted(material.image, spec.texture_size)
            smaller += image.shape != material.image.shape
            if not cutoff:
                image = np.ascontiguousarray(image[..., :3])
                image = extended(image, np.concatenate(corners[key]))
            drawn[key, bool(cutoff)] = image
        yield material._replace(image=drawn[key, bool(cutoff)], cutoff=cutoff)
    if smaller:
        notes.append(f"{smaller} images were made smaller, to texture_size = {spec.texture_size}")
    if seen_through:
        notes.append(
            f"{seen_through} images with an alpha of opacity: below {ALPHA_CUTOFF:g} nothing is "
            "drawn, above it is opaque"
        )
