"""Reader of PLY, as text and in both byte orders.

Vertex colours, normals and texture coordinates are read, also those that MeshLab writes for the
corners of each face (``texcoord``, ``texnumber``) with the images of its ``TextureFile`` comments.
Faces of more than three corners are cut into a fan.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sims.scans.images import Images, opaque
from sims.scans.mesh_file import Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import (
    LeftOut,
    check_size,
    fan,
    parse_numbers,
    refuse_cloud,
)
from sims.scans.transforms import turned

_TYPES = {
    "char": "i1",
    "double": "f8",
    "float": "f4",
    "float32": "f4",
    "float64": "f8",
    "int": "i4",
    "int16": "i2",
    "int32": "i4",
    "int8": "i1",
    "short": "i2",
    "uchar": "u1",
    "uint": "u4",
    "uint16": "u2",
    "uint32": "u4",
    "uint8": "u1",
    "ushort": "u2",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLACES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


class _Property(NamedTuple):
    name: str
    type: str
    length: str = ""  # type of a list's length; empty for a number


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


class _List(NamedTuple):
    """Lists of all rows, one after the other."""

    counts: npt.NDArray[np.int64]
    values: npt.NDArray[Any]


_Rows = dict[str, npt.NDArray[Any] | _List]


def read_ply(path: Path) -> MeshFile:
    """Read a ``.ply`` with faces.

    Raises:
        MeshError: It is damaged, or a cloud of points.
    """
    data = path.read_bytes()
    order, elements, images, start = _header(path, data)
    body = _Text(path, data[start:]) if order == "=" else _Binary(path, data, start, order)
    left_out = LeftOut()
    rows: dict[str, _Rows] = {}
    for element in elements:
        rows[element.name] = body.rows(element)
        if element.name not in ("vertex", "face"):
            left_out.note(f"elements {element.name!r}", count=element.rows)
    vertices, faces = rows.get("vertex", {}), rows.get("face", {})
    if not {"x", "y", "z"} <= vertices.keys():
        raise MeshError(f"{path}: expected vertices with x, y and z")
    points = _columns(vertices, ("x", "y", "z")).astype(np.float64)
    polygons = faces.get("vertex_indices", faces.get("vertex_index"))
    if not isinstance(polygons, _List) or not len(polygons.counts):
        if "tristrips" in rows:
            raise MeshError(f"{path}: expected faces, found strips: save it again, as MeshLab does")
        if "f_dc_0" in vertices:
            raise MeshError(f"{path}: expected triangles, found Gaussian splats: export a mesh")
        refuse_cloud(path, len(points))
    numbers = polygons.values.astype(np.int64)
    if len(numbers) and not 0 <= int(numbers.min()) <= int(numbers.max()) < len(points):
        raise MeshError(
            f"{path}: expected faces of vertices from 0 to {len(points) - 1}, found "
            f"{int(numbers.min())} to {int(numbers.max())}"
        )
    corners, polygon = fan(polygons.counts)
    check_size(path, len(corners))
    left_out.note("faces of fewer than 3 corners", count=int(np.count_nonzero(polygons.counts < 3)))
    colours = _colours(vertices)
    if colours is None and _colours(faces) is not None:
        left_out.note("colours of faces", "only those of vertices are drawn")
    places: Floats | None = None
    for names in _PLACES:
        if set(names) <= vertices.keys():
            places = _columns(vertices, names).astype(np.float64)
    normals: npt.NDArray[np.float32] | None = None
    if {"nx", "ny", "nz"} <= vertices.keys():
        normals = turned(_columns(vertices, ("nx", "ny", "nz")), np.eye(4))
    vertex = numbers[corners]
    wedges = faces.get("texcoord")
    if isinstance(wedges, _List) and (wedges.counts == 2 * polygons.counts).all():
        # Each corner is its own vertex: two faces may see one in different places of the image.
        places = wedges.values.astype(np.float64).reshape(-1, 2)
        corner = corners.reshape(-1)
        points, places = points[numbers[corner]], places[corner]
        normals = None if normals is None else normals[numbers[corner]]
        colours = None if colours is None else colours[numbers[corner]]
        vertex = np.arange(len(corner)).reshape(-1, 3)
    elif wedges is not None:
        left_out.note("texture coordinates of faces", "not one for each corner")
    if places is not None:
        if not np.isfinite(places).all():
            raise MeshError(f"{path}: expected finite texture coordinates")
        places[:, 1] = 1 - places[:, 1]
    sources = Images([path.parent], left_out)
    pictures = [sources.load(image) for image in images]
    materials = [
        Material(name, image=None if picture is None else opaque(picture))
        for name, picture in zip(images, pictures, strict=True)
    ] or [Material()]
    of_polygon = np.zeros(len(polygons.counts), np.int64)
    texture = faces.get("texnumber")
    if texture is not None and not isinstance(texture, _List):
        of_polygon = np.clip(texture.astype(np.int64), 0, len(materials) - 1)
    pieces = []
    for material in np.unique(of_polygon):
        rows_of = of_polygon[polygon] == material
        if not rows_of.any():
            continue
        pieces.append(
            Piece(
                object=path.stem,
                material=int(material),
                points=points,
                corners=vertex[rows_of].astype(np.int32),
                normals=normals,
                places=None if places is None else places.astype(np.float32),
                colours=colours,
            )
        )
    return MeshFile(
        pieces=tuple(pieces),
        materials=tuple(materials),
        sources=tuple(sources.paths),
        left_out=left_out.sentences(),
    )


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], list[str], int]:
    """Return the byte order, the elements, the images' names, and where the header ends."""
    end = data.find(b"end_header")
    newline = data.find(b"\n", end)
    if data[:3] != b"ply" or end < 0:
        raise MeshError(f"{path}: expected a header of PLY, found {data[:20]!r}")
    order, elements, images = "", [], []
    for line in data[:end].decode("utf-8", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", kind, *_]:
                order = _ORDERS.get(kind, "")
            case ["comment", "TextureFile", *_]:
                images.append(line.split(None, 2)[2])
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name] if elements:
                if not {count, kind} <= _TYPES.keys() or _TYPES[count][0] == "f":
                    raise MeshError(f"{path}: expected types of PLY, found {line!r}")
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise MeshError(f"{path}: expected a line of PLY's header, found {line[:80]!r}")
    if not order:
        raise MeshError(f"{path}: expected a format ({', '.join(_ORDERS)}) in its header")
    return order, elements, images, newline + 1 if newline >= 0 else len(data)


class _Text:
    """Numbers of a text, whatever the lines."""

    def __init__(self, path: Path, text: bytes) -> None:
        self._path = path
        self._numbers = parse_numbers(
            text, np.float64, len(text.split()), f"{path}: below its header"
        )
        self._at = 0

    def rows(self, element: _Element) -> _Rows:
        numbers = self._numbers[self._at :]
        if not element.properties:
            return {}
        if not any(item.length for item in element.properties):
            width = len(element.properties)
            self._need(element, element.rows * width)
            self._at += element.rows * width
            table = numbers[: element.rows * width].reshape(-1, width)
            return {
                item.name: table[:, column].astype(item.type)
                for column, item in enumerate(element.properties)
            }
        self._need(element, element.rows)
        even = self._even(element, numbers)
        return even if even is not None else self._uneven(element)

    def _even(self, element: _Element, numbers: Floats) -> _Rows | None:
        """Return rows whose lists are as long as those of the first row, else None."""
        columns, at = [], 0
        for item in element.properties:
            if at >= len(numbers):
                return None
            length = int(numbers[at]) if item.length else 1
            if item.length:
                at += 1
            columns.append((item, at, length))
            at += length
        if length < 0 or at <= 0 or element.rows * at > len(numbers):
            return None
        table = numbers[: element.rows * at].reshape(-1, at)
        rows: _Rows = {}
        for item, column, length in columns:
            values = table[:, column : column + max(length, 0)]
            if not item.length:
                rows[item.name] = values[:, 0].astype(item.type)
            elif length < 0 or (table[:, column - 1] != length).any():
                return None
            else:
                counts = np.full(element.rows, length)
                rows[item.name] = _List(counts, values.reshape(-1).astype(item.type))
        self._at += element.rows * at
        return rows

    def _uneven(self, element: _Element) -> _Rows:
        numbers, at = self._numbers.tolist(), self._at
        walks: dict[str, tuple[list[int], list[float]]] = {
            item.name: ([], []) for item in element.properties
        }
        for _ in range(element.rows):
            for item in element.properties:
                counts, values = walks[item.name]
                length = 1
                if item.length:
                    length = int(numbers[at]) if at < len(numbers) else -1
                    at += 1
                if length < 0 or at + length > len(numbers):
                    self._need(element, len(numbers) + 1)
                counts.append(length)
                values += numbers[at : at + length]
                at += length
        self._at = at
        return _walked(element, walks)

    def _need(self, element: _Element, count: int) -> None:
        if count > len(self._numbers) - self._at:
            raise MeshError(
                f"{self._path}: expected {element.rows} elements {element.name!r}, found the "
                f"file's end after {len(self._numbers)} numbers"
            )


class _Binary:
    def __init__(self, path: Path, data: bytes, at: int, order: str) -> None:
        self._path = path
        self._data = data
        self._at = at
        self._order = order

    def rows(self, element: _Element) -> _Rows:
        if not element.properties:
            return {}
        names = {item.name for item in element.properties}
        if len(names) < len(element.properties):
            raise MeshError(f"{self._path}: {element.name}: expected each property once")
        if not any(item.length for item in element.properties):
            dtype = np.dtype([(item.name, self._order + item.type) for item in element.properties])
            table = self._table(element, dtype)
            return {name: table[name] for name in names}
        self._need(element, element.rows)
        even = self._even(element)
        return even if even is not None else self._uneven(element)

    def _table(self, element: _Element, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        self._need(element, element.rows * dtype.itemsize)
        table = np.frombuffer(self._data, dtype, element.rows, self._at)
        self._at += element.rows * dtype.itemsize
        return table

    def _even(self, element: _Element) -> _Rows | None:
        """Return rows whose lists are as long as those of the first row, else None."""
        fields: list[tuple[Any, ...]] = []
        at = self._at
        for number, item in enumerate(element.properties):
            kind = np.dtype(self._order + item.type)
            if not item.length:
                fields.append((f"v{number}", kind))
                at += kind.itemsize
                continue
            head = np.dtype(self._order + item.length)
            if at + head.itemsize > len(self._data):
                return None
            length = int(np.frombuffer(self._data, head, 1, at)[0])
            at += head.itemsize + length * kind.itemsize
            if length < 0 or at > len(self._data):
                return None
            fields += [(f"n{number}", head), (f"v{number}", kind, (length,))]
        dtype = np.dtype(fields)
        if element.rows * dtype.itemsize > len(self._data) - self._at:
            return None
        table = np.frombuffer(self._data, dtype, element.rows, self._at)
        rows: _Rows = {}
        for number, item in enumerate(element.properties):
            values = table[f"v{number}"]
            if not item.length:
                rows[item.name] = values
                continue
            counts = table[f"n{number}"].astype(np.int64)
            if len(counts) and (counts != values.shape[1]).any():
                return None
            rows[item.name] = _List(counts, values.reshape(-1))
        self._at += element.rows * dtype.itemsize
        return rows

    def _uneven(self, element: _Element) -> _Rows:
        data, at = self._data, self._at
        walks: dict[str, tuple[list[int], list[Any]]] = {
            item.name: ([], []) for item in element.properties
        }
        order: Literal["little", "big"] = "little" if self._order == "<" else "big"
        parts = [
            (
                *walks[item.name],
                np.dtype(item.length).itemsize if item.length else 0,
                item.length[:1] == "i",
                np.dtype(item.type).itemsize,
            )
            for item in element.properties
        ]
        for _ in range(element.rows):
            for counts, values, head, signed, size in parts:
                length = 1
                if head:
                    length = int.from_bytes(data[at : at + head], order, signed=signed)
                    at += head
                end = at + length * size
                if length < 0 or end > len(data):
                    self._need(element, len(data))
                counts.append(length)
                values.append(data[at:end])
                at = end
        self._at = at
        return _walked(
            element,
            {
                item.name: (
                    walks[item.name][0],
                    np.frombuffer(b"".join(walks[item.name][1]), self._order + item.type),
                )
                for item in element.properties
            },
        )

    def _need(self, element: _Element, count: int) -> None:
        if count > len(self._data) - self._at:
            raise MeshError(
                f"{self._path}: expected {element.rows} elements {element.name!r}, found "
                f"{len(self._data) - self._at} bytes: the file is cut"
            )


def _walked(element: _Element, walks: dict[str, tuple[list[int], Any]]) -> _Rows:
    rows: _Rows = {}
    for item in element.properties:
        counts, values = walks[item.name]
        numbers = np.asarray(values).astype(item.type)
        rows[item.name] = _List(np.array(counts, np.int64), numbers) if item.length else numbers
    return rows


def _columns(rows: _Rows, names: tuple[str, ...]) -> npt.NDArray[Any]:
    columns = [rows[name] for name in names]
    return np.stack([column for column in columns if not isinstance(column, _List)], axis=1)


def _colours(rows: _Rows) -> npt.NDArray[np.uint8] | None:
    """Return sRGB and full alpha: what scans write as alpha is no opacity."""
    for names in _COLOURS:
        if not set(names) <= rows.keys():
            continue
        shades = _columns(rows, names)
        if shades.dtype.kind == "f":
            shades = np.rint(255 * np.clip(np.nan_to_num(shades), 0, 1))
        elif shades.dtype.itemsize > 1:
            shades = np.clip(shades, 0, 255) if shades.dtype.itemsize > 2 else shades // 257
        colours = np.full((len(shades), 4), 255, np.uint8)
        colours[:, :3] = shades
        return colours
    return None
