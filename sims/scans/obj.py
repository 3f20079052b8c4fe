"""Reader of Wavefront's OBJ and MTL, a whole file's numbers at a time.

Faces of more than three corners are cut into a fan, which is right for convex ones. A material's
colour (``Kd``) is not applied to its image (``map_Kd``): most programs write a grey there that
they do not mean.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sims.scans.images import Image, Images, find, opaque
from sims.scans.mesh_file import Colour, Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import (
    LeftOut,
    check_size,
    fan,
    join,
    parse_numbers,
    refuse_cloud,
)
from sims.scans.transforms import turned

Integers = npt.NDArray[np.int64]

_POINT, _PLACE, _NORMAL, _FACE, _OTHER = range(1, 6)
_MAPS = {
    "bump": "normal maps",
    "disp": "displacement maps",
    "map_bump": "normal maps",
    "map_ke": "emission maps",
    "map_ks": "specular maps",
    "map_ns": "specular maps",
    "map_pm": "roughness maps",
    "map_pr": "roughness maps",
    "norm": "normal maps",
    "refl": "reflection maps",
}
_ELEMENTS = {
    b"l": "lines",
    b"p": "points",
    b"curv": "curves",
    b"curv2": "curves",
    b"surf": "surfaces",
}
_NOT_FOUND = "not found; its materials are drawn white"


def read_obj(path: Path) -> MeshFile:
    """Read an ``.obj`` with the ``.mtl`` files and the images that it names."""
    return _Reader(path).read()


class _Faces(NamedTuple):
    """Corners of all faces as numbers from 0; -1 where a face gives none."""

    lines: Integers
    counts: Integers
    points: Integers
    places: Integers
    normals: Integers


class _Vectors(NamedTuple):
    """What the numbers of faces mean, from 0."""

    points: Floats
    colours: npt.NDArray[np.uint8] | None
    places: Floats
    normals: Floats


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._left_out = LeftOut()
        self._sources: list[Path] = []  # of materials and images
        text = path.read_bytes()
        if b"\\\n" in text or b"\\\r\n" in text:
            text = re.sub(rb"\\\r?\n", b" ", text)
        if b"\n" not in text:
            text = text.replace(b"\r", b"\n")
        self._split(text)
        if np.isin(self._text[self._starts], (ord(" "), ord("\t"))).any():
            self._split(re.sub(rb"(?m)^[ \t]+", b"", text))
        self._kinds = self._classify()

    def _split(self, text: bytes) -> None:
        self._text = np.frombuffer(text + b"\n", np.uint8)
        ends = np.flatnonzero(self._text == ord("\n"))
        self._starts = np.concatenate([[0], ends[:-1] + 1])
        self._lengths = ends - self._starts + 1

    def _classify(self) -> npt.NDArray[np.uint8]:
        last = len(self._text) - 1
        first, second, third = (self._text[np.minimum(self._starts + i, last)] for i in range(3))
        space, letter_v = second <= ord(" "), first == ord("v")
        kinds = np.full(len(first), _OTHER, np.uint8)
        kinds[letter_v & space] = _POINT
        kinds[letter_v & (second == ord("t")) & (third <= ord(" "))] = _PLACE
        kinds[letter_v & (second == ord("n")) & (third <= ord(" "))] = _NORMAL
        kinds[(first == ord("f")) & space] = _FACE
        kinds[(first <= ord(" ")) | (first == ord("#"))] = 0
        return kinds

    def read(self) -> MeshFile:
        points, colours = self._points()
        vectors = _Vectors(
            points,
            colours,
            places=self._vectors(_PLACE, "vt", 1, 2),
            normals=self._vectors(_NORMAL, "vn", 3, 3),
        )
        faces = self._faces(len(points), len(vectors.places), len(vectors.normals))
        if not len(faces.counts) and len(points):
            refuse_cloud(self._path, len(points))
        triangles, polygons = fan(faces.counts)
        check_size(self._path, len(triangles))
        few = int(np.count_nonzero(faces.counts < 3))
        self._left_out.note("faces of fewer than 3 corners", count=few)
        objects, names, libraries, groups = self._groups(faces.lines)
        materials = self._materials(names, libraries)
        of_triangle = groups[polygons]
        if not len(triangles):
            return MeshFile((), (), left_out=self._left_out.sentences())
        order = np.argsort(of_triangle, kind="stable")
        numbers, begins = np.unique(of_triangle[order], return_index=True)
        pieces = []
        for number, rows in zip(numbers, np.split(order, begins[1:]), strict=True):
            index, material = divmod(int(number), len(names))
            corners = triangles[rows].reshape(-1)
            pieces.append(self._piece(objects[index], material, corners, faces, vectors))
        return MeshFile(
            pieces=tuple(pieces),
            materials=tuple(materials),
            sources=tuple(self._sources),
            left_out=self._left_out.sentences(),
        )

    def _piece(
        self, name: str, material: int, corners: Integers, faces: _Faces, vectors: _Vectors
    ) -> Piece:
        """Return the triangles of some corners; what differs in any number is its own vertex."""
        points, colours, places, normals = vectors
        point, place, normal = faces.points[corners], faces.places[corners], faces.normals[corners]
        placed, lit = bool((place >= 0).any()), bool((normal >= 0).all())
        columns = [point, *([place] if placed else []), *([normal] if lit else [])]
        first, vertex = join(*columns)
        where: npt.NDArray[np.float32] | None = None
        if placed:
            self._left_out.note(
                "corners without texture coordinates",
                "drawn in their image's corner",
                int(np.count_nonzero(place < 0)),
            )
            where = np.zeros((len(first), 2), np.float32)
            given = place[first] >= 0
            where[given] = places[place[first][given]]
            where[:, 1] = 1 - where[:, 1]
            if not np.isfinite(where).all():
                raise MeshError(f"{self._path}: expected finite texture coordinates (vt)")
        return Piece(
            object=name,
            material=material,
            points=points[point[first]],
            corners=vertex.reshape(-1, 3),
            normals=turned(normals[normal[first]], np.eye(4)) if lit else None,
            places=where,
            colours=None if colours is None else colours[point[first]],
        )

    # Numbers.

    def _block(self, kind: int, prefix: int) -> tuple[npt.NDArray[np.uint8], Integers]:
        """Return the bytes of all lines of a kind without their keyword, and where lines start."""
        chosen = self._kinds == kind
        block = self._text[np.repeat(chosen, self._lengths)]
        lengths = self._lengths[chosen]
        starts = np.cumsum(lengths) - lengths
        for i in range(prefix):
            block[starts + i] = ord(" ")
        if (block == ord("#")).any():
            blank = re.sub(rb"#[^\n]*", lambda match: b" " * len(match[0]), block.tobytes())
            block = np.frombuffer(bytearray(blank), np.uint8)
        return block, starts

    def _parsed(
        self, block: npt.NDArray[np.uint8], dtype: type[Any], count: int, keyword: str
    ) -> npt.NDArray[Any]:
        return parse_numbers(block.tobytes(), dtype, count, f"{self._path}: behind {keyword}")

    def _rows(self, kind: int, keyword: str, least: int) -> tuple[Floats, Integers]:
        """Return the numbers of all lines of a kind, and how many each line has."""
        block, starts = self._block(kind, len(keyword))
        if not len(starts):
            return np.zeros(0), starts
        counts = _tokens(block, starts)
        if int(counts.min()) < least:
            row = int(np.argmax(counts < least))
            line = int(np.flatnonzero(self._kinds == kind)[row]) + 1
            raise MeshError(
                f"{self._path}: line {line}: expected at least {least} numbers behind {keyword}, "
                f"found {int(counts[row])}"
            )
        return self._parsed(block, np.float64, int(counts.sum()), keyword), counts

    def _vectors(self, kind: int, keyword: str, least: int, width: int) -> Floats:
        """Return the first numbers of all lines of a kind, shape (n, width); 0 for what lacks."""
        values, counts = self._rows(kind, keyword, least)
        starts = np.cumsum(counts) - counts
        vectors = np.zeros((len(counts), width))
        for i in range(width):
            given = counts > i
            vectors[given, i] = values[starts[given] + i]
        return vectors

    def _points(self) -> tuple[Floats, npt.NDArray[np.uint8] | None]:
        values, counts = self._rows(_POINT, "v", 3)
        starts = np.cumsum(counts) - counts
        points = np.stack([values[starts + i] for i in range(3)], axis=1)
        coloured = counts >= 6
        if not coloured.any():
            return points, None
        first = starts[coloured] + 3 + (counts[coloured] == 7)
        shades = np.nan_to_num(np.stack([values[first + i] for i in range(3)], axis=1))
        colours = np.full((len(points), 4), 255, np.uint8)
        # From 0 to 1, but for the programs that write bytes.
        scale = 1 if float(shades.max()) > 1 else 255
        colours[coloured, :3] = np.rint(np.clip(shades * scale, 0, 255))
        return points, colours

    def _faces(self, points: int, places: int, normals: int) -> _Faces:
        block, starts = self._block(_FACE, 1)
        lines = np.flatnonzero(self._kinds == _FACE)
        if not len(lines):
            return _Faces(lines, lines, lines, lines, lines)
        for _ in range(2):  # "7/" and "7//" are "7"
            slash = block[:-1] == ord("/")
            block[:-1][slash & (block[1:] <= ord(" "))] = ord(" ")
        counts = _tokens(block, starts)
        slash = block == ord("/")
        slashes = _counts(slash, starts)
        double = _counts(slash & np.roll(slash, 1), starts)
        # How a line writes its corners: 0 "v", 1 "v/vt", 2 "v//vn", 3 "v/vt/vn".
        forms = np.full(len(lines), -1)
        forms[slashes == 0] = 0
        forms[(slashes == counts) & (double == 0)] = 1
        forms[(slashes == 2 * counts) & (double == counts)] = 2
        forms[(slashes == 2 * counts) & (double == 0)] = 3
        forms[counts == 0] = 0
        if (forms < 0).any():
            line = int(lines[np.argmax(forms < 0)])
            start = int(self._starts[line])
            raise MeshError(
                f"{self._path}: line {line + 1}: expected corners that are all alike (v, v/vt, "
                f"v//vn or v/vt/vn), found {self._text[start : start + 60].tobytes()!r}"
            )
        block[slash] = ord(" ")
        widths = np.array([1, 2, 2, 3])[forms]
        values = self._parsed(block, np.int64, int((widths * counts).sum()), "f")
        of_value, of_corner = np.repeat(forms, widths * counts), np.repeat(forms, counts)
        numbers = np.zeros((3, int(counts.sum())), np.int64)
        for form, columns in enumerate(([0], [0, 1], [0, 2], [0, 1, 2])):
            rows = values[of_value == form].reshape(-1, len(columns))
            for column, row in zip(columns, rows.T, strict=True):
                numbers[column, of_corner == form] = row
        corners = [
            self._resolved(numbers[i], count, kind, keyword, lines, counts)
            for i, (count, kind, keyword) in enumerate(
                ((points, _POINT, "v"), (places, _PLACE, "vt"), (normals, _NORMAL, "vn"))
            )
        ]
        return _Faces(lines, counts, *corners)

    def _resolved(
        self,
        numbers: Integers,
        count: int,
        kind: int,
        keyword: str,
        lines: Integers,
        counts: Integers,
    ) -> Integers:
        """Return numbers from 0 of numbers from 1 and of negative ones, which count backwards."""
        resolved = numbers - 1
        backwards = numbers < 0
        if backwards.any():
            before = np.cumsum(self._kinds == kind)[np.repeat(lines, counts)]
            resolved[backwards] = numbers[backwards] + before[backwards]
        wrong = (resolved >= count) | (resolved < 0)
        if kind != _POINT:
            lost = wrong & (numbers != 0)
            resolved[wrong] = -1
            self._left_out.note(
                f"corners with a {keyword} that is not in the file",
                "drawn without it",
                int(np.count_nonzero(lost)),
            )
        elif wrong.any():
            corner = int(np.argmax(wrong))
            raise MeshError(
                f"{self._path}: line {int(np.repeat(lines, counts)[corner]) + 1}: expected the "
                f"number of one of {count} {keyword}, found {int(numbers[corner])}"
            )
        return resolved

    # Names.

    def _groups(self, faces: Integers) -> tuple[list[str], list[str], list[str], Integers]:
        """Return names of objects, of materials and of libraries, and each face's group.

        A group is ``object * len(materials) + material``. Objects are those of ``o``, else ``g``.
        """
        others = np.flatnonzero(self._kinds == _OTHER)
        words = [
            self._text[start : start + length].tobytes().split(None, 1)
            for start, length in zip(self._starts[others], self._lengths[others], strict=True)
        ]
        keyword = b"o" if any(word[0] == b"o" for word in words) else b"g"
        objects, materials, libraries = {self._path.stem: 0}, {"": 0}, []
        changes, groups = [-1], [(0, 0)]
        current = (0, 0)
        for line, (word, *rest) in zip(others.tolist(), words, strict=True):
            name = b"".join(rest).decode("utf-8", "replace").strip()
            if word == keyword:
                index = objects.setdefault(name or self._path.stem, len(objects))
                current = (index, current[1])
            elif word == b"usemtl":
                current = (current[0], materials.setdefault(name, len(materials)))
            elif word == b"mtllib":
                libraries.append(name)
                continue
            else:
                self._left_out.note(_ELEMENTS.get(word, ""), count=word in _ELEMENTS)
                continue
            changes.append(line)
            groups.append(current)
        numbers = np.array([index * len(materials) + material for index, material in groups])
        of_face = numbers[np.searchsorted(np.array(changes), faces) - 1]
        return list(objects), list(materials), libraries, of_face

    def _materials(self, names: list[str], libraries: list[str]) -> list[Material]:
        """Return the materials of some names; images are sought beside the MTL and the mesh."""
        folder = self._path.parent
        known: dict[str, tuple[Path, dict[str, str]]] = {}
        for library in dict.fromkeys(libraries):
            # A line names one file, with spaces, or several.
            for part in [library] if find(library, [folder]) else library.split():
                path = find(part, [folder])
                if path is None:
                    self._left_out.note(f"material file {part!r}", _NOT_FOUND)
                else:
                    known |= {name: (path, values) for name, values in _entries(path).items()}
        unknown = [name for name in names if name and name not in known]
        self._left_out.note("materials that no file describes", "drawn white", len(unknown))
        images = {path: Images([path.parent, folder], self._left_out) for path, _ in known.values()}
        materials = [
            self._material(known[name][0], name, known[name][1], images[known[name][0]])
            if name in known
            else Material(name)
            for name in names
        ]
        for path, source in images.items():
            self._sources += [path, *source.paths]
        return materials

    def _material(self, path: Path, name: str, values: dict[str, str], images: Images) -> Material:
        for keyword in values.keys() & _MAPS.keys():
            self._left_out.note(_MAPS[keyword])
        alpha = 1.0
        if "d" in values:
            alpha = _number(path, name, "d", values["d"].removeprefix("-halo"))
        elif "tr" in values:
            alpha = 1 - _number(path, name, "Tr", values["tr"])
        if not 0 < alpha < 1:  # MeshLab means "opaque" by "Tr 1", by which others mean "invisible"
            alpha = 1.0
        image: Image | None = None
        mask: Image | None = None
        if values.get("map_kd"):
            image = images.load(self._image_name(values["map_kd"]))
        if values.get("map_d") and image is not None:
            mask = images.load(self._image_name(values["map_d"]))
            if mask is not None and mask.shape[:2] != image.shape[:2]:
                self._left_out.note("alpha maps of another size than their image")
                mask = None
        if image is not None:
            image = opaque(image)
        if image is not None and mask is not None:
            shades = mask[..., 3:] if mask.shape[2] == 4 else mask[..., :1]
            image = np.concatenate([image, shades], axis=2)
        colour: Colour = (1.0, 1.0, 1.0, alpha)
        shade = values.get("kd", "").split()
        if image is None and len(shade) >= 3:
            red, green, blue = (
                min(max(_number(path, name, "Kd", value), 0.0), 1.0) for value in shade[:3]
            )
            colour = (red, green, blue, colour[3])
        return Material(
            name=name,
            colour=colour,
            image=image,
            cutoff=0.5 if mask is not None else 0.0,
            blend=colour[3] < 1,
        )

    def _image_name(self, value: str) -> str:
        """Return the file's name of a map, which may have options before it."""
        match = re.match(r"(?:-[a-z]+(?:\s+(?:on|off|[rgbmlz]|[-+.\d][-+.\de]*))*\s+)*", value)
        assert match is not None  # it matches nothing, too
        self._left_out.note("images with options in the MTL", "drawn without them", bool(match[0]))
        return value[match.end() :]


def _entries(path: Path) -> dict[str, dict[str, str]]:
    """Return the values of each material of an MTL file by their keyword in small letters."""
    entries: dict[str, dict[str, str]] = {}
    entry: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        keyword, _, value = line.strip().replace("\t", " ").partition(" ")
        if keyword.lower() == "newmtl":
            entry = entries.setdefault(value.strip(), {})
        else:
            entry[keyword.lower()] = value.strip()
    return entries


def _number(path: Path, material: str, keyword: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise MeshError(f"{path}: {material}: expected a number behind {keyword}, found {value!r}")
    return number


def _tokens(block: npt.NDArray[np.uint8], starts: Integers) -> Integers:
    """Return how many words each line has."""
    begins = block > ord(" ")
    begins[1:] &= block[:-1] <= ord(" ")
    return _counts(begins, starts)


def _counts(marked: npt.NDArray[np.bool_], starts: Integers) -> Integers:
    """Return how many bytes of each line are marked."""
    before = np.searchsorted(np.flatnonzero(marked), starts)
    return np.diff(before, append=np.count_nonzero(marked))
