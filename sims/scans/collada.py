"""Reader of COLLADA (``.dae``, 1.4 and 1.5).

Transforms, materials and images are read as Gazebo's models and Blender write them. The unit and
the axis that points up are told (`MeshFile.unit`, `MeshFile.up`), and not applied to the points.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
import numpy.typing as npt

from sims.scans.images import Image, Images, opaque
from sims.scans.mesh_file import Colour, Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import (
    LeftOut,
    check_size,
    fan,
    join,
    parse_numbers,
    unique_name,
)
from sims.scans.transforms import compose, moved, rotation, scaling, seen, translation, turned, unit

Integers = npt.NDArray[np.int64]

_UPS = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}
_PRIMITIVES = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_MOST_NODES = 10_000
"""Of a scene: a few nodes that are instances of each other may stand for any number."""


def read_collada(path: Path) -> MeshFile:
    """Read a ``.dae`` with the images that it names, also those above its folder."""
    return _Reader(path, parse_xml(path)).read()


def parse_xml(path: Path) -> ET.Element:
    """Return an XML file's root; names have no prefixes, of which some that are used are not bound.

    Raises:
        MeshError: It is no XML, or it defines entities, which may stand for any size of text.
    """

    def refuse(*_: object) -> None:
        raise MeshError(f"{path}: expected XML without entities of its own")

    builder = ET.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.buffer_size = 2**20
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = lambda tag, attributes: builder.start(
        tag.rpartition(":")[2], {key.rpartition(":")[2]: v for key, v in attributes.items()}
    )
    parser.EndElementHandler = lambda tag: builder.end(tag.rpartition(":")[2])
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:  # LookupError: of an encoding
        if isinstance(error, MeshError):
            raise
        raise MeshError(f"{path}: expected XML, found: {error}") from error


class _Source(NamedTuple):
    """Vectors that corners refer to by a column of their numbers."""

    values: Floats
    offset: int
    set: int


class _Reader:
    def __init__(self, path: Path, root: ET.Element) -> None:
        if root.tag != "COLLADA":
            raise MeshError(f"{path}: expected COLLADA, found <{root.tag}>")
        self._path = path
        self._root = root
        self._ids: dict[str, ET.Element] = {}
        for element in root.iter():
            self._ids.setdefault(element.get("id", ""), element)
        self._left_out = LeftOut()
        self._images = Images([path.parent], self._left_out)
        self._materials: list[Material] = []
        self._numbers: dict[str | None, int] = {}
        self._vectors: dict[str, Floats] = {}
        self._names: set[str] = set()
        self._nodes = 0
        self._triangles = 0
        self._lit = False

    def read(self) -> MeshFile:
        scene = self._target(self._root.find("scene/instance_visual_scene"))
        if scene is None:
            scene = self._root.find("library_visual_scenes/visual_scene")
        if scene is None:
            raise MeshError(f"{self._path}: expected a visual scene, found none")
        pieces: list[Piece] = []
        for node in scene.findall("node"):
            pieces += self._node(node, np.eye(4), 0)
        unit = self._root.find("asset/unit")
        metres = float(unit.get("meter", 1.0)) if unit is not None else 1.0
        if not 0 < metres < math.inf:
            raise MeshError(f"{self._path}: expected a unit above 0 metres, found {metres}")
        self._left_out.note(
            "animations",
            "the scene stands as it is stored",
            len(self._root.findall("library_animations//channel")),
        )
        return MeshFile(
            pieces=tuple(pieces),
            materials=tuple(self._materials),
            up=_UPS.get((self._root.findtext("asset/up_axis") or "Y_UP").strip(), "y"),
            unit=metres,
            lit=self._lit,
            sources=tuple(self._images.paths),
            left_out=self._left_out.sentences(),
        )

    def _target(self, element: ET.Element | None, key: str = "url") -> ET.Element | None:
        """Return the element that another refers to by ``#id``."""
        if element is None:
            return None
        url = element.get(key, "")
        if not url.startswith("#"):
            self._left_out.note("references to other files", "not read", count=bool(url))
            return None
        return self._ids.get(url[1:])

    # The scene.

    def _node(self, node: ET.Element, parent: Floats, depth: int) -> Iterator[Piece]:
        self._nodes += 1
        if depth > 100 or self._nodes > _MOST_NODES:
            raise MeshError(
                f"{self._path}: node {node.get('id')}: expected at most 100 nodes in each other "
                f"and {_MOST_NODES} in all, found more"
            )
        matrix = parent
        for element in node:
            if element.tag in _TRANSFORMS:
                matrix = compose(matrix, self._transform(element))
        name = node.get("name") or node.get("id") or "node"
        for element in node:
            match element.tag:
                case "node":
                    yield from self._node(element, matrix, depth + 1)
                case "instance_node":
                    target = self._target(element)
                    if target is not None:
                        yield from self._node(target, matrix, depth + 1)
                case "instance_geometry":
                    yield from self._geometry(name, element, self._target(element), matrix)
                case "instance_controller":
                    yield from self._skin(name, element, matrix)
                case "instance_light":
                    self._lit = True
                case "instance_camera":
                    self._left_out.note("cameras", "not used")
                case "skew":
                    self._left_out.note("transforms of skew", "not applied")
                case _:
                    pass

    def _transform(self, element: ET.Element) -> Floats:
        values: Floats = self._list(element, np.float64)
        expected = _TRANSFORMS[element.tag]
        if len(values) != expected or not np.isfinite(values).all():
            raise MeshError(
                f"{self._path}: <{element.tag}>: expected {expected} finite numbers, found "
                f"{(element.text or '')[:60]!r}"
            )
        match element.tag:
            case "matrix":
                return values.reshape(4, 4)
            case "translate":
                return translation(values)
            case "scale":
                return scaling(values)
            case "rotate":
                return rotation(values[:3], math.radians(values[3]))
            case _:  # lookat
                eye, interest, up = values.reshape(3, 3)
                back = unit(eye - interest)
                side = unit(np.cross(up, back))
                matrix = translation(eye)
                matrix[:3, :3] = np.stack([side, np.cross(back, side), back], axis=1)
                return matrix

    def _skin(self, name: str, instance: ET.Element, matrix: Floats) -> Iterator[Piece]:
        controller = self._target(instance)
        skin = None if controller is None else controller.find("skin")
        if skin is None:
            self._left_out.note("controllers without a skin")
            return
        self._left_out.note("skins", "meshes stand in the pose in which they were bound")
        bind = skin.find("bind_shape_matrix")
        if bind is not None:
            values = self._list(bind, np.float64)
            matrix = compose(matrix, values[:16].reshape(4, 4))
        yield from self._geometry(name, instance, self._target(skin, "source"), matrix)

    # Meshes.

    def _geometry(
        self, name: str, instance: ET.Element, geometry: ET.Element | None, matrix: Floats
    ) -> Iterator[Piece]:
        mesh = None if geometry is None else geometry.find("mesh")
        if geometry is None or mesh is None:
            self._left_out.note("geometries without a mesh")
            return
        bound = {
            element.get("symbol", ""): element
            for element in instance.iterfind("bind_material/technique_common/instance_material")
        }
        double = _flag(geometry, "double_sided")
        unique = unique_name(name, self._names)
        for primitive in mesh:
            if primitive.tag in ("lines", "linestrips"):
                self._left_out.note("primitives of lines")
            if primitive.tag not in _PRIMITIVES:
                continue
            symbol = primitive.get("material", "")
            binding = bound.get(symbol)
            key = symbol if binding is None else binding.get("target", "").removeprefix("#")
            number, coordinates = self._material(key, double)
            piece = self._piece(unique, primitive, matrix, number, _set(binding, coordinates))
            if piece is not None:
                self._triangles += len(piece.corners)
                check_size(self._path, self._triangles)
                yield piece

    def _piece(
        self, name: str, primitive: ET.Element, matrix: Floats, material: int, coordinates: int
    ) -> Piece | None:
        sources, width = self._sources(primitive)
        position = sources.get("POSITION", [])
        if not position:
            self._left_out.note("primitives without points")
            return None
        numbers, triangles = self._corners(primitive, width)
        if not len(triangles):
            return None
        rows = numbers[triangles.reshape(-1)]
        place = min(
            sources.get("TEXCOORD", []), key=lambda s: (s.set != coordinates, s.set), default=None
        )
        used = {
            "POSITION": position[0],
            "NORMAL": next(iter(sources.get("NORMAL", [])), None),
            "TEXCOORD": place,
            "COLOR": next(iter(sources.get("COLOR", [])), None),
        }
        columns = sorted({source.offset for source in used.values() if source is not None})
        first, vertex = join(*(rows[:, column] for column in columns))

        def values(semantic: str, least: int) -> Floats | None:
            source = used[semantic]
            if source is None:
                return None
            chosen = rows[first, source.offset]
            low, high = int(chosen.min()), int(chosen.max())
            if low < 0 or high >= len(source.values):
                raise MeshError(
                    f"{self._path}: {name}: expected numbers of {semantic} from 0 to "
                    f"{len(source.values) - 1}, found {low} to {high}"
                )
            if source.values.shape[1] < least:
                raise MeshError(
                    f"{self._path}: {name}: expected {least} numbers for a {semantic}, found "
                    f"{source.values.shape[1]}"
                )
            vectors: Floats = source.values[chosen]
            return vectors

        points, normals = values("POSITION", 3), values("NORMAL", 3)
        places, colours = values("TEXCOORD", 2), values("COLOR", 3)
        assert points is not None
        if places is not None:
            if not np.isfinite(places).all():
                raise MeshError(f"{self._path}: {name}: expected finite texture coordinates")
            places = np.stack([places[:, 0], 1 - places[:, 1]], axis=1)
        elif self._materials[material].image is not None:
            self._left_out.note(
                "primitives with an image and no texture coordinates", "drawn in its first texel"
            )
        shades: npt.NDArray[np.uint8] | None = None
        if colours is not None:
            shades = np.full((len(points), 4), 255, np.uint8)
            shades[:, :3] = np.rint(255 * np.clip(np.nan_to_num(colours[:, :3]), 0, 1))
        return Piece(
            object=name,
            material=material,
            points=moved(points[:, :3], matrix),
            corners=seen(vertex.reshape(-1, 3), matrix),
            normals=None if normals is None else turned(normals, matrix),
            places=None if places is None else places.astype(np.float32),
            colours=shades,
        )

    def _corners(self, primitive: ET.Element, width: int) -> tuple[Integers, Integers]:
        """Return the numbers of all corners, shape (n, width), and triangles of corners, (m, 3)."""
        self._left_out.note("holes of polygons", "filled", len(primitive.findall("ph/h")))
        parts = [self._list(element, np.int64) for element in primitive.iter("p")]
        for part in parts:
            if len(part) % width:
                raise MeshError(
                    f"{self._path}: <{primitive.tag}>: expected {width} numbers for each corner, "
                    f"found {len(part)} in all"
                )
        lengths = np.array([len(part) // width for part in parts], np.int64)
        numbers = np.concatenate([np.zeros(0, np.int64), *parts]).reshape(-1, width)
        if primitive.tag == "tristrips":
            begins = np.cumsum(lengths) - lengths
            strips = [
                begin + np.stack([np.arange(n - 2) + i for i in range(3)], axis=1)
                for begin, n in zip(begins, lengths, strict=True)
                if n > 2
            ]
            for strip in strips:
                strip[1::2] = strip[1::2, [1, 0, 2]]
            return numbers, np.concatenate([np.zeros((0, 3), np.int64), *strips])
        if primitive.tag == "triangles":
            counts = np.full(len(numbers) // 3, 3)
        elif primitive.tag == "polylist":
            vcount = primitive.find("vcount")
            counts = np.zeros(0, np.int64) if vcount is None else self._list(vcount, np.int64)
            if len(counts) and (int(counts.min()) < 0 or int(counts.max()) > len(numbers)):
                raise MeshError(f"{self._path}: <vcount>: expected counts of corners")
            if int(counts.sum()) > len(numbers):
                raise MeshError(
                    f"{self._path}: <polylist>: expected {int(counts.sum())} corners as <vcount> "
                    f"says, found {len(numbers)}"
                )
        else:
            counts = lengths
        return numbers, fan(counts)[0].astype(np.int64)

    def _sources(self, primitive: ET.Element) -> tuple[dict[str, list[_Source]], int]:
        """Return a primitive's vectors by their semantic, and how many numbers a corner has."""
        sources: dict[str, list[_Source]] = {}
        width = 1
        for element in primitive.findall("input"):
            offset, number = int(element.get("offset", 0)), int(element.get("set", 0))
            if not 0 <= offset < 100:
                raise MeshError(f"{self._path}: <input>: expected an offset, found {offset}")
            width = max(width, offset + 1)
            target = self._target(element, "source")
            if target is None:
                raise MeshError(
                    f"{self._path}: <input>: expected a source, found {element.get('source')!r}"
                )
            inputs = target.findall("input") if target.tag == "vertices" else [element]
            for item in inputs:
                semantic = item.get("semantic", "")
                if semantic in ("POSITION", "NORMAL", "TEXCOORD", "COLOR"):
                    values = self._values(item)
                    sources.setdefault(semantic, []).append(_Source(values, offset, number))
        return sources, width

    def _values(self, item: ET.Element) -> Floats:
        """Return the vectors of a source, shape (n, stride)."""
        identifier = item.get("source", "")
        if identifier in self._vectors:
            return self._vectors[identifier]
        source = self._target(item, "source")
        accessor = None if source is None else source.find("technique_common/accessor")
        array = self._target(accessor, "source")
        if array is None and source is not None:
            array = source.find("float_array")
        if accessor is None or array is None:
            raise MeshError(
                f"{self._path}: source {identifier}: expected an array and its accessor"
            )
        numbers = self._list(array, np.float64)
        count, stride = int(accessor.get("count", 0)), int(accessor.get("stride", 1))
        start = int(accessor.get("offset", 0))
        if min(count, start) < 0 or stride < 1 or start + count * stride > len(numbers):
            raise MeshError(
                f"{self._path}: source {identifier}: expected {count} vectors of {stride} numbers, "
                f"found {len(numbers)} numbers"
            )
        vectors = numbers[start : start + count * stride].reshape(count, stride)
        self._vectors[identifier] = vectors
        return vectors

    def _list(self, element: ET.Element, dtype: type[Any]) -> npt.NDArray[Any]:
        text = (element.text or "").encode()
        where = f"{self._path}: <{element.tag}>"
        return parse_numbers(text, dtype, len(text.split()), where)

    # Materials.

    def _material(self, identifier: str, double: bool) -> tuple[int, str]:
        """Return a material's number, and the name of its image's texture coordinates."""
        key = f"{identifier} {double}"
        element = self._ids.get(identifier)
        effect = None if element is None else self._target(element.find("instance_effect"))
        coordinates = "" if effect is None else _texture(effect, "diffuse").get("texcoord", "")
        if key not in self._numbers:
            self._numbers[key] = len(self._materials)
            if effect is None or element is None:
                self._left_out.note(
                    "materials that are not in the file", "drawn white", bool(identifier)
                )
                self._materials.append(Material(identifier, double_sided=double))
            else:
                name = element.get("name") or identifier
                self._materials.append(self._effect(name, effect, double))
        return self._numbers[key], coordinates

    def _effect(self, name: str, effect: ET.Element, double: bool) -> Material:
        for tag, what in (("bump", "normal maps"), ("normal", "normal maps")):
            self._left_out.note(what, count=sum(1 for _ in effect.iter(tag)))
        self._left_out.note("specular maps", count=bool(_texture(effect, "specular").attrib))
        glow, glowing = self._look(effect, "emission")
        colour, image = self._look(effect, "diffuse")
        unlit = effect.find(".//technique/constant") is not None
        black = image is None and (colour is None or max(colour[:3]) == 0)
        # A common form of a bake: all is emitted, and what is lit is black.
        if black and glow is not None and (glowing is not None or max(glow[:3]) > 0):
            colour, image, unlit = glow, glowing, True
        elif glowing is not None or (glow is not None and max(glow[:3]) > 0):
            self._left_out.note("materials that glow", "lit as others are")
        red, green, blue, _ = colour or (1.0, 1.0, 1.0, 1.0)
        alpha = self._opacity(effect)
        cutoff = 0.0
        if image is not None:
            red, green, blue = 1.0, 1.0, 1.0
            transparent = _texture(effect, "transparent").get("texture")
            masked = transparent is not None and image.shape[2] == 4
            image, cutoff = (image, 0.5) if masked else (opaque(image), 0.0)
        return Material(
            name=name,
            colour=(red, green, blue, alpha),
            image=image,
            cutoff=cutoff,
            blend=alpha < 1,
            double_sided=double or _flag(effect, "double_sided"),
            unlit=unlit,
        )

    def _look(self, effect: ET.Element, key: str) -> tuple[Colour | None, Image | None]:
        """Return the colour and image of an effect's light of a kind."""
        texture = _texture(effect, key)
        if texture.attrib:
            name = self._image_name(effect, texture.get("texture", ""))
            if not name:
                self._left_out.note(f"images of materials' {key}", "not in the file")
            image = self._images.load(name) if name else None
            return (1.0, 1.0, 1.0, 1.0), image
        element = effect.find(f".//technique/*/{key}/color")
        if element is None:
            return None, None
        values = [*self._list(element, np.float64).tolist(), 1.0]
        if len(values) < 4 or not np.isfinite(values).all():
            raise MeshError(f"{self._path}: <{key}>: expected a colour, found {element.text!r}")
        red, green, blue, alpha = (min(max(float(value), 0.0), 1.0) for value in values[:4])
        return (red, green, blue, alpha), None

    def _image_name(self, effect: ET.Element, sampler: str) -> str:
        """Return the file's name of a sampler; some programs name the image itself."""
        params = {param.get("sid"): param for param in effect.iter("newparam")}
        image: ET.Element | None = self._ids.get(sampler)
        param = params.get(sampler)
        if param is not None:
            surface = params.get((param.findtext("sampler2D/source") or "").strip())
            if surface is not None:
                image = self._ids.get((surface.findtext("surface/init_from") or "").strip())
            else:
                image = self._target(param.find("sampler2D/instance_image"))
        if image is None:
            return ""
        return (image.findtext("init_from/ref") or image.findtext("init_from") or "").strip()

    def _opacity(self, effect: ET.Element) -> float:
        """Return alpha; 1 for what would be invisible, as programs that err here write it."""
        transparent = effect.find(".//technique/*/transparent")
        if transparent is None:
            return 1.0
        colour, _ = self._look(effect, "transparent")
        red, green, blue, alpha = colour or (1.0, 1.0, 1.0, 1.0)
        number = effect.find(".//technique/*/transparency/float")
        factor = 1.0 if number is None else float(self._list(number, np.float64)[:1].sum())
        light = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        mode = transparent.get("opaque", "A_ONE")
        opacity = {
            "A_ONE": alpha * factor,
            "A_ZERO": 1 - alpha * factor,
            "RGB_ZERO": 1 - light * factor,
            "RGB_ONE": light * factor,
        }.get(mode, 1.0)
        return opacity if 0 < opacity < 1 else 1.0


_TRANSFORMS = {"lookat": 9, "matrix": 16, "rotate": 4, "scale": 3, "translate": 3}
"""How many numbers each has."""


def _texture(effect: ET.Element, key: str) -> ET.Element:
    """Return the texture of an effect's light of a kind; one without attributes if it has none."""
    texture = effect.find(f".//technique/*/{key}/texture")
    return ET.Element("texture") if texture is None else texture


def _flag(element: ET.Element, tag: str) -> bool:
    return any((item.text or "").strip() in ("1", "true") for item in element.iter(tag))


def _set(binding: ET.Element | None, coordinates: str) -> int:
    """Return the set of texture coordinates that a material's binding names; else 0."""
    for element in () if binding is None else binding.findall("bind_vertex_input"):
        if element.get("semantic") == coordinates:
            return int(element.get("input_set", 0))
    return 0
