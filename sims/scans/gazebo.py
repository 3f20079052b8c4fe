"""Reader of Gazebo's worlds and models (SDF 1.4 to 1.11): what stands in them, at rest.

Meshes are placed as Gazebo places them: COLLADA's unit is applied, its axis that points up is not.
A visual's own colour replaces that of a mesh, but not a mesh's image.
"""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sims.scans.collada import parse_xml
from sims.scans.images import Image, Images, opaque
from sims.scans.mesh_file import Colour, Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import LeftOut, check_size, unique_name
from sims.scans.transforms import (
    compose,
    moved,
    quaternion,
    rotation,
    scaling,
    seen,
    translation,
    turned,
    unit,
)

_PATHS = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "IGN_GAZEBO_RESOURCE_PATH")
_ROUND = 32
"""Sides of a cylinder, and meridians of a sphere."""

_NOT_READ = {
    "actor": "actors",
    "model_state": "states of models",
    "plugin": "plugins",
    "population": "populations",
    "road": "roads",
    "sensor": "sensors",
    "state": "saved states",
}
_FUEL = re.compile(r"https?://([^/]+)/1\.0/([^/]+)/models/([^/]+)(?:/(?:\d+|tip)/files/(.*))?")
"""Address of a model or of a file of it on Gazebo's server."""

_MOST_MODELS = 10_000
"""Of a world: a few models that include each other may stand for any number."""

_COLOURS: dict[str, Colour] = {
    "Gazebo/Black": (0.0, 0.0, 0.0, 1.0),
    "Gazebo/Blue": (0.0, 0.0, 1.0, 1.0),
    "Gazebo/DarkGrey": (0.175, 0.175, 0.175, 1.0),
    "Gazebo/DarkYellow": (0.7, 0.7, 0.0, 1.0),
    "Gazebo/FlatBlack": (0.1, 0.1, 0.1, 1.0),
    "Gazebo/Green": (0.0, 1.0, 0.0, 1.0),
    "Gazebo/Grey": (0.7, 0.7, 0.7, 1.0),
    "Gazebo/Orange": (1.0, 0.5088, 0.0468, 1.0),
    "Gazebo/Purple": (1.0, 0.0, 1.0, 1.0),
    "Gazebo/Red": (1.0, 0.0, 0.0, 1.0),
    "Gazebo/SkyBlue": (0.13, 0.44, 0.7, 1.0),
    "Gazebo/Turquoise": (0.0, 1.0, 1.0, 1.0),
    "Gazebo/White": (1.0, 1.0, 1.0, 1.0),
    "Gazebo/Yellow": (1.0, 1.0, 0.0, 1.0),
}
"""Plain ones of Gazebo's own scripts, which lie in no folder of the user's."""

_Reads = Callable[[Path], MeshFile]


def read_world(path: Path, read_mesh: _Reads) -> MeshFile:
    """Read a ``.world`` or ``.sdf`` with its models and their meshes; collisions are its solids.

    Args:
        read_mesh: Reads the mesh files that it names.

    Raises:
        MeshError: It is damaged, a model or mesh is missing, or a pose is relative to what is not
            in its model.
    """
    return _Reader(path, read_mesh).read()


class _Place(NamedTuple):
    """Where a part of the world stands."""

    matrix: Floats  # to the world
    path: Path  # file that it is in
    name: str = ""  # of the object that it belongs to: a model that is in no other
    depth: int = 0
    static: bool = False


class _Scope:
    """Frames of a model or world by name: links, joints, frames, and models in it."""

    def __init__(self, path: Path, element: ET.Element) -> None:
        self._path = path
        self._elements = {
            child.get("name") or (child.findtext("name") or "").strip(): child
            for tag in ("include", "model", "joint", "frame", "link")  # of two, the last counts
            for child in element.iterfind(tag)
        }
        self._elements.pop("", None)
        self._resolving: set[str] = set()

    def pose(self, element: ET.Element, default: str = "") -> Floats:
        """Return an element's pose in this scope's frame."""
        pose = element.find("pose")
        base = default
        if pose is not None:
            base = pose.get("relative_to") or pose.get("frame") or default
        return compose(self._frame(base), _matrix(self._path, pose))

    def _frame(self, name: str) -> Floats:
        if name in ("", "__model__", "world"):
            return np.eye(4)
        element = self._elements.get(name)
        if element is None or name in self._resolving:
            raise MeshError(
                f"{self._path}: a pose is relative to {name!r}: expected one of "
                f"{', '.join(sorted(self._elements))} in the same model, and no circle"
            )
        self._resolving.add(name)
        base = {
            "frame": element.get("attached_to") or "",
            "joint": (element.findtext("child") or "").strip(),
        }.get(element.tag, "")
        matrix = self.pose(element, base)
        self._resolving.remove(name)
        return matrix


class _Reader:
    def __init__(self, path: Path, read_mesh: _Reads) -> None:
        self._path = path
        self._read_mesh = read_mesh
        self._left_out = LeftOut()
        self._told: dict[str, list[str]] = {}  # sentences of meshes, and of which
        self._pieces: list[Piece] = []
        self._solids: list[Piece] = []
        self._materials: list[Material] = []
        self._meshes: dict[Path, tuple[MeshFile, int]] = {}  # with the place of its materials
        self._documents: dict[Path, ET.Element] = {}
        self._missing: dict[str, None] = {}
        self._names: set[str] = set()
        self._models = 0
        self._triangles = 0
        self._lit = False
        self._sources: dict[Path, None] = {}

    def read(self) -> MeshFile:
        root = parse_xml(self._path)
        if root.tag not in ("sdf", "gazebo"):
            raise MeshError(f"{self._path}: expected SDF, found <{root.tag}>")
        worlds = root.findall("world")
        self._left_out.note("further worlds", "not drawn", max(len(worlds) - 1, 0))
        self._contents(worlds[0] if worlds else root, _Place(np.eye(4), self._path))
        if self._missing:
            fuel = next((uri for uri in self._missing if _FUEL.match(uri)), "")
            raise MeshError(
                f"{self._path}: expected {', '.join(self._missing)} beside it, in models/, in a "
                f"folder above or in one of ${' $'.join(_PATHS)}, found none"
                + (f": gz fuel download -u '{fuel}'" if fuel else "")
            )
        return MeshFile(
            pieces=tuple(self._pieces),
            materials=tuple(self._materials),
            up="z",
            unit=1.0,
            lit=self._lit,
            solids=tuple(self._solids),
            sources=tuple(self._sources),
            left_out=(
                *self._left_out.sentences(),
                *(f"{', '.join(names)}: {sentence}" for sentence, names in self._told.items()),
            ),
        )

    # Models.

    def _contents(self, element: ET.Element, place: _Place) -> None:
        """Read what is in a world or model."""
        scope = _Scope(place.path, element)
        for child in element:
            match child.tag:
                case "model":
                    matrix = compose(place.matrix, scope.pose(child))
                    self._model(child, place._replace(matrix=matrix), child.get("name"))
                case "include":
                    self._include(child, place, scope)
                case "link":
                    self._link(child, place, scope)
                case tag:
                    self._note(tag)

    def _model(self, model: ET.Element, place: _Place, name: str | None) -> None:
        self._models += 1
        if place.depth > 20 or self._models > _MOST_MODELS:
            raise MeshError(
                f"{place.path}: expected at most 20 models in each other and {_MOST_MODELS} in "
                "all, found more"
            )
        if model.get("placement_frame"):
            raise MeshError(f"{place.path}: {name}: expected a model without placement_frame")
        static = place.static or (model.findtext("static") or "").strip() in ("1", "true")
        if not static and model.find("link") is not None:
            self._left_out.note("models that are not static", "they stand still")
        title = place.name or unique_name(name or "model", self._names)
        inner = place._replace(name=title, depth=place.depth + 1, static=static)
        self._contents(model, inner)

    def _include(self, include: ET.Element, place: _Place, scope: _Scope) -> None:
        uri = (include.findtext("uri") or "").strip()
        if include.find("placement_frame") is not None:
            raise MeshError(f"{place.path}: {uri}: expected an include without placement_frame")
        folder = self._find(uri if "://" in uri else f"model://{uri}", place.path.parent)
        if folder is None:
            name = uri.rstrip("/").rpartition("/")[2].lower().replace(" ", "_")
            if name == "sun":
                self._lit = True
            elif name == "ground_plane":
                self._ground(compose(place.matrix, scope.pose(include)), place.name)
            else:
                self._missing[uri] = None
            return
        file = self._model_file(folder)
        if file not in self._documents:
            self._documents[file] = parse_xml(file)
        root = self._documents[file]
        self._lit = self._lit or root.find("light") is not None
        for model in root.findall("model"):
            placed = include.find("pose") is not None  # which replaces the model's own
            pose = scope.pose(include) if placed else _Scope(file, root).pose(model)
            inner = place._replace(path=file, matrix=compose(place.matrix, pose))
            name = (include.findtext("name") or "").strip() or model.get("name") or "model"
            self._model(model, inner, name)

    def _model_file(self, folder: Path) -> Path:
        """Return the newest SDF of a model's folder."""
        config = folder / "model.config"
        file = folder if folder.is_file() else folder / "model.sdf"
        if config.is_file():
            self._sources[config] = None
            versions: list[tuple[list[int], str]] = []
            for element in parse_xml(config).findall("sdf"):
                parts = (element.get("version") or "0").split(".")
                numbers = [int(part) for part in parts if part.isdecimal()]
                versions.append((numbers, (element.text or "").strip()))
            if versions:
                file = folder / max(versions)[1]
        self._sources[file] = None
        return file

    def _ground(self, matrix: Floats, name: str) -> None:
        """Add Gazebo's own model of a plane, which lies in no folder of the user's."""
        shape = _placed(_plane(100.0, 100.0, np.array([0.0, 0.0, 1.0])), matrix)
        material = self._add_material(Material("ground_plane", (0.8, 0.8, 0.8, 1.0)))
        title = name or unique_name("ground_plane", self._names)
        self._add(shape, title, material, self._pieces)
        self._add(shape, title, material, self._solids)

    def _find(self, uri: str, folder: Path) -> Path | None:
        """Return the file or folder of a URI, or None; a model is also sought in paths."""
        fuel = _FUEL.match(uri)
        if fuel is not None:
            return _downloaded(*fuel.groups())
        scheme, separator, name = uri.partition("://")
        if not separator:
            scheme, name = "", uri
        if not name or "\0" in uri or scheme not in ("", "file", "model", "package"):
            return None
        roots = [folder]
        if scheme in ("model", "package", "file"):
            for above in (self._path.parent.resolve(), *self._path.parent.resolve().parents):
                roots += [above, above / "models"]
            for variable in _PATHS:
                roots += [Path(item) for item in os.environ.get(variable, "").split(":") if item]
            roots += list(folder.resolve().parents)
        for root in roots:
            try:
                if (root / name).exists():
                    return root / name
            except OSError:  # a name that is too long
                return None
        return None

    # Links.

    def _link(self, link: ET.Element, place: _Place, scope: _Scope) -> None:
        for child in link:
            match child.tag:
                case "visual" | "collision":
                    matrix = compose(place.matrix, scope.pose(child, link.get("name", "")))
                    self._geometry(child, place._replace(matrix=matrix), child.tag == "collision")
                case tag:
                    self._note(tag)

    def _note(self, tag: str) -> None:
        """Take note of an element that is no geometry."""
        self._lit |= tag == "light"
        if tag in _NOT_READ:
            self._left_out.note(_NOT_READ[tag], "not read")

    def _geometry(self, element: ET.Element, place: _Place, solid: bool) -> None:
        shapes = element.find("geometry")
        for shape in () if shapes is None else shapes:
            if shape.tag == "empty":
                continue
            if shape.tag == "mesh":
                self._mesh(element, shape, place, solid)
                continue
            triangles = _triangles(place.path, shape)
            if triangles is None:
                self._left_out.note(f"{'solid' if solid else 'drawn'} {shape.tag}s", "not read")
                continue
            placed = _placed(triangles, place.matrix)
            if solid:
                self._add(placed, place.name, 0, self._solids)
            else:
                grey = Material(place.name, (0.7, 0.7, 0.7, 1.0))
                material = self._add_material(self._look(element, place.path, grey))
                self._add(placed, place.name, material, self._pieces)

    def _add(self, piece: Piece, name: str, material: int, pieces: list[Piece]) -> None:
        self._triangles += len(piece.corners)
        check_size(self._path, self._triangles)
        pieces.append(piece._replace(object=name, material=material))

    def _mesh(self, element: ET.Element, shape: ET.Element, place: _Place, solid: bool) -> None:
        matrix, path, name, *_ = place
        uri = (shape.findtext("uri") or "").strip()
        file = self._find(uri, path.parent)
        if file is None:
            self._missing[uri] = None
            return
        file = file.resolve()
        if file not in self._meshes:
            self._meshes[file] = self._read_mesh(file), -1
            self._sources |= dict.fromkeys(self._meshes[file][0].sources)
        mesh, first = self._meshes[file]
        if first < 0 and not solid:
            first = len(self._materials)
            self._meshes[file] = mesh, first
            self._materials += mesh.materials
            for sentence in mesh.left_out:
                self._told.setdefault(sentence, []).append(file.name)
        scale = _numbers(path, shape.find("scale"), 3, (1.0, 1.0, 1.0)) * (mesh.unit or 1.0)
        matrix = compose(matrix, scaling(scale))
        pieces = mesh.pieces
        submesh = (shape.findtext("submesh/name") or "").strip()
        if submesh:
            pieces = tuple(piece for piece in pieces if piece.object == submesh)
            if not pieces:
                raise MeshError(
                    f"{path}: {name}: expected a submesh of {file.name} "
                    f"({', '.join(sorted({piece.object for piece in mesh.pieces}))}), found "
                    f"{submesh!r}"
                )
            if (shape.findtext("submesh/center") or "").strip() in ("1", "true"):
                points = np.concatenate([piece.points for piece in pieces])
                middle = (points.min(axis=0) + points.max(axis=0)) / 2
                matrix = compose(matrix, translation(-middle))
        changed: dict[int, int] = {}
        for piece in pieces:
            placed = _placed(piece, matrix)
            if solid:
                self._add(placed, name, 0, self._solids)
                continue
            number = first + piece.material
            if number not in changed:
                own = self._materials[number]
                look = self._look(element, path, own)
                changed[number] = number if look is own else self._add_material(look)
            self._add(placed, name, changed[number], self._pieces)

    # Materials.

    def _add_material(self, material: Material) -> int:
        self._materials.append(material)
        return len(self._materials) - 1

    def _look(self, visual: ET.Element, path: Path, own: Material) -> Material:
        """Return a mesh's own material as a visual changes it, the same object if it does not."""
        look = own
        material = visual.find("material")
        if material is not None:
            albedo = (material.findtext("pbr/metal/albedo_map") or "").strip()
            diffuse = material.find("diffuse")
            script = material.find("script")
            colour = None if diffuse is None else _colour(path, diffuse)
            image = self._image(albedo, [path.parent]) if albedo else None
            if script is not None and image is None:
                colour, image = self._script(script, path, colour)
            if image is not None:
                look = look._replace(image=opaque(image), colour=(1.0, 1.0, 1.0, 1.0))
            elif colour is not None and look.image is None:
                look = look._replace(colour=colour)
            if (material.findtext("double_sided") or "").strip() in ("1", "true"):
                look = look._replace(double_sided=True)
        clear = float(_numbers(path, visual.find("transparency"), 1, (0.0,))[0])
        if clear > 0:
            red, green, blue, alpha = look.colour
            look = look._replace(colour=(red, green, blue, alpha * (1 - min(clear, 1.0))))
        return look if look is own else look._replace(blend=look.colour[3] < 1)

    def _image(self, name: str, folders: list[Path]) -> Image | None:
        """Return an image by a URI or by its name in some folders."""
        file = self._find(name, folders[0])
        if file is not None and file.is_file():
            name, folders = file.name, [file.parent]
        images = Images(folders, self._left_out)
        image = images.load(name)
        self._sources |= dict.fromkeys(images.paths)
        return image

    def _script(
        self, script: ET.Element, path: Path, colour: Colour | None
    ) -> tuple[Colour | None, Image | None]:
        """Return the colour and the image of a material of OGRE's scripts: the first of each."""
        name = (script.findtext("name") or "").strip()
        uris = [(element.text or "").strip() for element in script.findall("uri")]
        folders = [file for file in (self._find(uri, path.parent) for uri in uris) if file]
        for folder in folders:
            files = [folder] if folder.is_file() else sorted(folder.glob("*.material"))
            for file in files:
                block = _block(file.read_text(encoding="utf-8", errors="replace"), name)
                if block is None:
                    continue
                self._sources[file] = None
                texture = re.search(r"\stexture\s+(\S+)", block)
                diffuse = re.search(r"\sdiffuse((?:\s+[\d.]+){3})", block)
                if diffuse is not None and colour is None:
                    red, green, blue = (min(float(word), 1.0) for word in diffuse[1].split())
                    colour = (red, green, blue, 1.0)
                near = [*(f if f.is_dir() else f.parent for f in folders), file.parent]
                return colour, self._image(texture[1], near) if texture else None
        if name not in _COLOURS:
            self._left_out.note(f"material script {name}", "not found; drawn in its own colour")
        return colour or _COLOURS.get(name), None


def _downloaded(host: str, owner: str, name: str, rest: str | None) -> Path | None:
    """Return where ``gz fuel download`` has put the newest version of a model, or None."""
    for folder in (".gz", ".ignition"):
        model = Path.home() / folder / "fuel" / host / owner.lower() / "models" / name.lower()
        if model.is_dir():
            versions = [path for path in model.iterdir() if path.name.isdecimal()]
            if versions:
                return max(versions, key=lambda path: int(path.name)) / (rest or "")
    return None


def _block(text: str, name: str) -> str | None:
    """Return what stands between the braces of a material in one of OGRE's scripts."""
    text = re.sub(r"//[^\n]*", "", text)
    head = re.search(
        rf"^\s*material\s+{re.escape(name)}(?:\s*:[^\n{{]*)?\s*\{{", text, re.MULTILINE
    )
    if head is None or not name:
        return None
    depth, start = 1, head.end()
    for brace in re.finditer(r"[{}]", text[start:]):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            return text[start : start + brace.start()]
    return text[start:]


def _numbers(
    path: Path, element: ET.Element | None, count: int, default: tuple[float, ...]
) -> Floats:
    if element is None or not (element.text or "").strip():
        return np.array(default)
    try:
        values = np.array([float(word) for word in (element.text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise MeshError(
            f"{path}: <{element.tag}>: expected {count} numbers, found "
            f"{(element.text or '')[:60]!r}"
        )
    return values


def _colour(path: Path, element: ET.Element) -> Colour:
    words = len((element.text or "").split())
    values = _numbers(path, element, min(max(words, 3), 4), (1.0, 1.0, 1.0, 1.0))
    red, green, blue, *alpha = (min(max(float(value), 0.0), 1.0) for value in values)
    return red, green, blue, alpha[0] if alpha else 1.0


def _matrix(path: Path, pose: ET.Element | None) -> Floats:
    """Return the transform of a pose: x y z and roll, pitch, yaw, or a quaternion."""
    if pose is None:
        return np.eye(4)
    if pose.get("rotation_format") == "quat_xyzw":
        values = _numbers(path, pose, 7, (0.0,) * 6 + (1.0,))
        x, y, z, w = values[3:].tolist()
        return compose(translation(values[:3]), quaternion(x, y, z, w))
    values = _numbers(path, pose, 6, (0.0,) * 6)
    angles = np.radians(values[3:]) if pose.get("degrees") in ("1", "true") else values[3:]
    matrix = translation(values[:3])
    for axis in (2, 1, 0):
        matrix = compose(matrix, rotation(np.eye(3)[axis], float(angles[axis])))
    return matrix


def _placed(piece: Piece, matrix: Floats) -> Piece:
    return piece._replace(
        points=moved(piece.points, matrix),
        corners=seen(piece.corners, matrix),
        normals=None if piece.normals is None else turned(piece.normals, matrix),
    )


# Shapes.


def _triangles(path: Path, shape: ET.Element) -> Piece | None:
    """Return the triangles of a primitive, or None for a kind that is not drawn."""

    def number(tag: str, default: float = 1.0) -> float:
        return float(_numbers(path, shape.find(tag), 1, (default,))[0])

    match shape.tag:
        case "box":
            return _box(_numbers(path, shape.find("size"), 3, (1.0,) * 3))
        case "plane":
            normal = _numbers(path, shape.find("normal"), 3, (0.0, 0.0, 1.0))
            width, length = _numbers(path, shape.find("size"), 2, (100.0, 100.0))
            return _plane(float(width), float(length), normal)
        case "sphere":
            return _sphere(np.full(3, number("radius")), 0.0)
        case "ellipsoid":
            return _sphere(_numbers(path, shape.find("radii"), 3, (1.0,) * 3), 0.0)
        case "capsule":
            return _sphere(np.full(3, number("radius")), number("length"))
        case "cylinder":
            return _cylinder(number("radius"), number("length"))
        case _:
            return None


def _cos(angles: Floats) -> Floats:
    cosines: Floats = np.cos(angles)
    return cosines.round(12)


def _sin(angles: Floats) -> Floats:
    sines: Floats = np.sin(angles)
    return sines.round(12)


def _grid(points: Floats, normals: Floats) -> Piece:
    """Return the triangles of points in rows and columns, shape (rows, columns, 3).

    Their image fills the grid; its upper edge is at the last row.
    """
    rows, columns, _ = points.shape
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(1, 0, rows))
    return Piece(
        object="",
        material=0,
        points=points.reshape(-1, 3),
        corners=np.stack([a, b, d, a, d, c], axis=-1).reshape(-1, 3),
        normals=normals.reshape(-1, 3).astype(np.float32),
        places=np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32),
    )


def _together(pieces: list[Piece]) -> Piece:
    starts = np.cumsum([0, *(len(piece.points) for piece in pieces[:-1])])
    corners = [piece.corners + start for piece, start in zip(pieces, starts, strict=True)]
    return Piece(
        object="",
        material=0,
        points=np.concatenate([piece.points for piece in pieces]),
        corners=np.concatenate(corners).astype(np.int32),
        normals=np.concatenate([piece.normals for piece in pieces if piece.normals is not None]),
        places=np.concatenate([piece.places for piece in pieces if piece.places is not None]),
    )


def _plane(width: float, length: float, normal: Floats) -> Piece:
    up = unit(normal)
    side = unit(np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [0.0, 0.0, 1.0], up))
    along = np.cross(up, side)
    u, v = np.meshgrid([-width / 2, width / 2], [-length / 2, length / 2])
    points = u[..., None] * side + v[..., None] * along
    return _grid(points, np.broadcast_to(up, points.shape))


def _box(size: Floats) -> Piece:
    sides = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = np.eye(3)[axis] * sign
            first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
            u, v = np.meshgrid([-0.5, 0.5], [-0.5, 0.5])
            points = (u[..., None] * first + v[..., None] * second + normal / 2) * size
            sides.append(_grid(points, np.broadcast_to(normal, points.shape)))
    return _together(sides)


def _sphere(radii: Floats, length: float) -> Piece:
    """Return an ellipsoid whose halves are `length` apart."""
    around = np.linspace(0, 2 * math.pi, _ROUND + 1)
    half = np.linspace(0, math.pi / 2, _ROUND // 4 + 1)
    latitude = np.concatenate([half - math.pi / 2, half])
    rise = np.repeat([-length / 2, length / 2], len(half))
    normals = np.stack(
        [
            _cos(latitude)[:, None] * _cos(around),
            _cos(latitude)[:, None] * _sin(around),
            np.broadcast_to(_sin(latitude)[:, None], (len(latitude), len(around))),
        ],
        axis=-1,
    )
    points = normals * radii
    points[..., 2] += rise[:, None]
    slopes = normals / radii
    length = np.sqrt((slopes * slopes).sum(axis=-1))[..., None]
    return _without_flat(_grid(points, slopes / length))


def _cylinder(radius: float, length: float) -> Piece:
    around = np.linspace(0, 2 * math.pi, _ROUND + 1)
    circle = np.stack([_cos(around), _sin(around), np.zeros_like(around)], axis=-1)
    up = np.array([0.0, 0.0, length / 2])
    side = _grid(np.stack([circle * radius - up, circle * radius + up]), np.stack([circle, circle]))
    caps = [
        _grid(
            np.stack([order * radius + sign * up, order * 0 + sign * up]),
            np.broadcast_to([0.0, 0.0, sign], (2, len(around), 3)),
        )
        for sign, order in ((1.0, circle), (-1.0, circle[::-1]))
    ]
    return _without_flat(_together([side, *caps]))


def _without_flat(shape: Piece) -> Piece:
    """Return a shape without the triangles that a pole makes flat."""
    a, b, c = (shape.points[shape.corners[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return shape._replace(corners=shape.corners[area > 1e-9 * float(area.max(initial=0.0))])
