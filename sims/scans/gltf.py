"""Reader of glTF 2.0: ``.glb``, and ``.gltf`` with buffers beside it or inside it.

What a world shows is read: triangles in all their encodings, base colours, alpha, and vertex
colours. What it does not show is counted in `MeshFile.left_out`. What would make the scene wrong
is refused: a required extension that is not known here, meshopt, KTX2.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from runtime.errors import MissingDependencyError
from runtime.extras import install_command
from sims.scans.images import Image, decode, opaque, to_srgb
from sims.scans.mesh_file import Floats, Material, MeshError, MeshFile, Piece
from sims.scans.parsing import LeftOut, check_size, unique_name
from sims.scans.transforms import compose, moved, quaternion, scaling, seen, translation, turned

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_REPEAT = 10497

_DRACO = "KHR_draco_mesh_compression"
_BASISU = "KHR_texture_basisu"
_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
_READ = {
    _DRACO,
    _GLOSSINESS,
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
_MESHOPT = {"EXT_meshopt_compression", "KHR_meshopt_compression", "MESHOPT_compression"}
_UNPACKS = {
    **dict.fromkeys(_MESHOPT, "gltf-transform copy"),
    _BASISU: "gltf-transform ktxdecompress",
}
"""Commands of https://gltf-transform.dev/cli, which write a file without the extension."""


def read_gltf(path: Path) -> MeshFile:
    """Read a ``.glb`` or ``.gltf``; its materials share the array of an image they share.

    Raises:
        MeshError: The file is damaged or needs what is not read; the message says what to do.
        MissingDependencyError: It is packed by Draco, and DracoPy is not installed.
    """
    document, binary = _split(path)
    return _Reader(path, document, binary).read()


def _split(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Return a file's JSON, and the binary part of a ``.glb``."""
    data = path.read_bytes()
    binary: bytes | None = None
    text = data
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise MeshError(f"{path}: expected a header of 20 bytes, found {len(data)}")
        version, length = struct.unpack("<II", data[4:12])
        if version != 2:
            raise MeshError(f"{path}: expected glTF 2.0, found version {version}")
        if length > len(data):
            raise MeshError(f"{path}: expected {length} bytes, found {len(data)}: the file is cut")
        chunks = list(_chunks(path, data[:length]))
        if not chunks or chunks[0][0] != b"JSON":
            raise MeshError(f"{path}: expected JSON to be the first chunk of the file")
        text = chunks[0][1]
        binary = next((chunk for kind, chunk in chunks[1:] if kind == b"BIN\0"), None)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MeshError(f"{path}: expected glTF's JSON, found: {error}") from error
    version = document["asset"]["version"] if "asset" in document else "none"
    if not str(version).startswith("2."):
        raise MeshError(f"{path}: expected glTF 2.0, found version {version}")
    return document, binary


def _chunks(path: Path, data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while at + 8 <= len(data):
        (length,) = struct.unpack("<I", data[at : at + 4])
        if at + 8 + length > len(data):
            raise MeshError(
                f"{path}: expected a chunk of {length} bytes at byte {at}, found "
                f"{len(data) - at - 8}: the file is cut"
            )
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += 8 + length


class _Look(NamedTuple):
    """Material, with where its image's texture coordinates come from."""

    number: int
    coordinates: int = 0  # n of TEXCOORD_n
    transform: Floats | None = None  # shape (2, 3), applied to (u, v, 1)
    repeats: bool = True
    mode: str = "OPAQUE"


class _Reader:
    def __init__(self, path: Path, document: dict[str, Any], binary: bytes | None) -> None:
        self._path = path
        self._document = document
        self._binary = binary
        self._buffers: dict[int, bytes] = {}
        self._images: dict[tuple[int, bool], Image] = {}
        self._looks: dict[int | None, _Look] = {}
        self._materials: list[Material] = []
        self._left_out = LeftOut()
        self._sources: list[Path] = []
        self._most = 16 * path.stat().st_size + 2**20  # of zeros that an accessor stands for

    def read(self) -> MeshFile:
        self._check_extensions()
        pieces: list[Piece] = []
        taken: set[str] = set()
        triangles = 0
        for name, mesh, matrix in self._placed_meshes():
            unique = unique_name(name, taken)
            for number in range(len(self._get("meshes", mesh)["primitives"])):
                piece = self._piece(unique, mesh, number, matrix)
                if piece is None:
                    continue
                triangles += len(piece.corners)
                check_size(self._path, triangles)
                pieces.append(piece)
        document = self._document
        for kind, then in {
            "animations": "the scene stands as it is stored",
            "skins": "meshes stand in the pose in which they were bound",
            "cameras": "not used",
        }.items():
            self._left_out.note(kind, then, len(document.get(kind, ())))
        lights = document.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
        return MeshFile(
            pieces=tuple(pieces),
            materials=tuple(self._materials),
            up="y",
            unit=1.0,
            lit=bool(lights),
            sources=tuple(self._sources),
            left_out=self._left_out.sentences(),
        )

    def _check_extensions(self) -> None:
        document = self._document
        for name in document.get("extensionsRequired", []):
            if name in _UNPACKS and name != _BASISU:  # of which some textures are never drawn
                raise MeshError(
                    f"{self._path}: expected a file without {name}, found that it needs it: "
                    f"{_unpack(name, self._path)}"
                )
            if name not in _READ | {_BASISU} and not name.startswith("KHR_materials_"):
                raise MeshError(
                    f"{self._path}: expected a file that needs no more than "
                    f"{', '.join(sorted(_READ))}, found that it needs {name}: export it without"
                )
        for name in set(document.get("extensionsUsed", [])) - _READ - set(_UNPACKS):
            if not name.startswith("KHR_materials_"):  # counted by material
                self._left_out.note(f"extension {name}", "not read")

    def _get(self, kind: str, number: Any) -> Any:
        """Return the object of a number in one of the document's arrays."""
        objects = self._document.get(kind, [])
        if not isinstance(number, int) or not 0 <= number < len(objects):
            raise MeshError(
                f"{self._path}: expected the number of one of {len(objects)} {kind}, found {number}"
            )
        return objects[number]

    # Nodes.

    def _placed_meshes(self) -> Iterator[tuple[str, int, Floats]]:
        """Yield each placed mesh with its name and its transform to the scene, shape (4, 4)."""
        document = self._document
        nodes = document.get("nodes", [])
        if document.get("scenes"):
            roots = self._get("scenes", document.get("scene", 0)).get("nodes", [])
            self._left_out.note("further scenes", "not drawn", len(document["scenes"]) - 1)
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [number for number in range(len(nodes)) if number not in children]
        waiting: list[tuple[int, Floats]] = [(root, np.eye(4)) for root in reversed(roots)]
        seen: set[int] = set()
        while waiting:
            number, parent = waiting.pop()
            node = self._get("nodes", number)
            if number in seen:
                raise MeshError(
                    f"{self._path}: nodes[{number}]: expected a node to have one parent and no "
                    "circle, found it twice in the scene"
                )
            seen.add(number)
            matrix = compose(parent, self._matrix(number, node))
            if "mesh" in node:
                mesh = self._get("meshes", node["mesh"])
                name = node.get("name") or mesh.get("name") or f"node{number}"
                yield str(name), node["mesh"], matrix
            waiting += [(child, matrix) for child in reversed(node.get("children", []))]

    def _matrix(self, number: int, node: dict[str, Any]) -> Floats:
        if "matrix" in node:
            matrix = np.array(node["matrix"], float).reshape(4, 4).T
        else:
            x, y, z, w = map(float, node.get("rotation", (0, 0, 0, 1)))
            matrix = compose(
                translation(node.get("translation", (0, 0, 0))),
                compose(quaternion(x, y, z, w), scaling(node.get("scale", (1, 1, 1)))),
            )
        if not np.isfinite(matrix).all():
            raise MeshError(f"{self._path}: nodes[{number}]: expected a finite transform")
        return matrix

    # Primitives.

    def _piece(self, name: str, mesh: int, number: int, matrix: Floats) -> Piece | None:
        primitive = self._get("meshes", mesh)["primitives"][number]
        where = f"{self._path}: meshes[{mesh}].primitives[{number}]"
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            self._left_out.note("primitives of points or lines")
            return None
        if primitive.get("targets"):
            self._left_out.note("primitives with morph targets", "their base shape is drawn")
        draco = primitive.get("extensions", {}).get(_DRACO)
        attributes: dict[str, int] = primitive["attributes"]
        if "POSITION" not in attributes:
            self._left_out.note("primitives without points")
            return None
        packed: dict[str, npt.NDArray[Any]] = {}
        if draco and "bufferView" not in self._get("accessors", attributes["POSITION"]):
            indices, packed = self._unpack_draco(where, draco, attributes)
        elif "indices" in primitive:
            indices = self._accessor(primitive["indices"])[:, 0]
            if indices.dtype.kind == "f":
                raise MeshError(f"{where}: expected indices to be integers, found floats")
        else:
            indices = np.arange(self._count(attributes["POSITION"]))

        def values(name: str, widths: Sequence[int]) -> npt.NDArray[Any] | None:
            if name not in attributes or (packed and name not in packed):
                return None
            accessor = self._get("accessors", attributes[name])
            raw = packed[name] if packed else self._accessor(attributes[name])
            if raw.shape[1] not in widths or (len(raw) != vertices and vertices):
                raise MeshError(
                    f"{where}: {name}: expected {vertices or 'n'} vectors of "
                    f"{' or '.join(map(str, widths))} numbers, found {raw.shape[0]} of "
                    f"{raw.shape[1]}"
                )
            # Colours are normalized whatever is said: else all but 0 would be white.
            return _floats(raw, accessor.get("normalized", False) or name == "COLOR_0")

        vertices = 0
        points = values("POSITION", (3,))
        if points is None:
            raise MeshError(f"{where}: expected points in its packed data, found none")
        vertices = len(points)
        if len(indices) and int(indices.max()) >= vertices:
            raise MeshError(
                f"{where}: expected indices below {vertices}, the number of points, found "
                f"{int(indices.max())}"
            )
        if not np.isfinite(points).all():
            raise MeshError(f"{where}: expected finite points, found others")
        corners = _corners(indices.astype(np.int32), mode)
        if not len(corners):
            return None
        look = self._look(primitive.get("material"))
        places = self._places(look, values, where)
        normals = values("NORMAL", (3,))
        return Piece(
            object=name,
            material=look.number,
            points=moved(points, matrix),
            corners=seen(np.ascontiguousarray(corners), matrix),
            normals=None if normals is None else turned(normals, matrix),
            places=places,
            colours=_colours(values("COLOR_0", (3, 4)), look.mode),
        )

    def _places(self, look: _Look, values: Any, where: str) -> npt.NDArray[np.float32] | None:
        places: npt.NDArray[Any] | None = values(f"TEXCOORD_{look.coordinates}", (2,))
        material = self._materials[look.number]
        if places is None:
            if material.image is not None:
                self._left_out.note(
                    "primitives with an image and no texture coordinates",
                    "drawn in its first texel",
                )
            return None
        if material.image is None:
            self._left_out.note(
                "primitives with texture coordinates and no image", "drawn in their colour"
            )
        if look.transform is not None:
            u, v = places.astype(np.float64).T
            places = np.stack([a * u + b * v + c for a, b, c in look.transform.tolist()], axis=1)
        if not np.isfinite(places).all():
            raise MeshError(f"{where}: expected finite texture coordinates")
        if not look.repeats and ((places < -1e-3) | (places > 1.001)).any():
            self._left_out.note(
                "primitives with an image that is clamped or mirrored", "it is repeated instead"
            )
        return places.astype(np.float32)

    def _unpack_draco(
        self, where: str, draco: dict[str, Any], attributes: dict[str, int]
    ) -> tuple[npt.NDArray[Any], dict[str, npt.NDArray[Any]]]:
        try:
            import DracoPy  # optional
        except ImportError:
            raise MissingDependencyError(
                f"{self._path} is packed by Draco, which needs DracoPy: {install_command('meshes')}"
            ) from None
        encoded = bytes(self._view(draco["bufferView"]))
        try:
            mesh = DracoPy.decode(encoded)
            faces = np.asarray(mesh.faces)
        except Exception as error:  # DracoPy raises several kinds, of its own and others
            raise MeshError(f"{where}: expected data of Draco, found: {error}") from error
        unpacked: dict[str, npt.NDArray[Any]] = {}
        for name, number in draco["attributes"].items():
            attribute = mesh.get_attribute_by_unique_id(number)
            if attribute is None:
                raise MeshError(f"{where}: expected {name} as Draco's attribute {number}, found no")
            accessor = self._get("accessors", attributes[name]) if name in attributes else {}
            data = np.asarray(attribute["data"])
            dtype = _COMPONENTS.get(accessor.get("componentType", 0), data.dtype)
            unpacked[name] = data.reshape(len(data), -1).astype(dtype)
        return faces.reshape(-1), unpacked

    # Materials.

    def _look(self, number: int | None) -> _Look:
        if number not in self._looks:
            self._looks[number] = self._new_look(number)
        return self._looks[number]

    def _new_look(self, number: int | None) -> _Look:
        place = len(self._materials)
        if number is None:
            self._materials.append(Material())
            return _Look(place)
        material = self._get("materials", number)
        extensions = material.get("extensions", {})
        gloss = extensions.get(_GLOSSINESS)
        rough = material.get("pbrMetallicRoughness", {})
        if gloss is not None:
            factor, texture = gloss.get("diffuseFactor"), gloss.get("diffuseTexture")
        else:
            factor, texture = rough.get("baseColorFactor"), rough.get("baseColorTexture")
        red, green, blue, alpha = map(float, factor or (1, 1, 1, 1))
        unlit = "KHR_materials_unlit" in extensions
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1)
        glow = [
            float(light) * float(strength) for light in material.get("emissiveFactor", (0,) * 3)
        ]
        glowing = material.get("emissiveTexture")
        if max(glow) > 0 and not unlit:
            # A common form of a bake: all is emitted, and what is lit is black.
            if texture is None and max(red, green, blue) == 0:
                (red, green, blue), texture, unlit = glow, glowing, True
            else:
                self._left_out.note("materials that glow", "lit as others are")
        self._left_out.note("normal maps", count="normalTexture" in material)
        self._left_out.note("occlusion maps", count="occlusionTexture" in material)
        self._left_out.note("roughness maps", count="metallicRoughnessTexture" in rough)
        for name in extensions.keys() - _READ:
            self._left_out.note(f"materials with {name}", "drawn without it")
        mode = material.get("alphaMode", "OPAQUE")
        transform, coordinates, repeats, image = None, 0, True, None
        if texture is not None:
            image, repeats = self._texture(texture["index"], alpha=mode != "OPAQUE")
            transform, coordinates = _transform(texture)
        colour = to_srgb([red, green, blue])
        self._materials.append(
            Material(
                name=str(material.get("name") or f"material{number}"),
                colour=(
                    float(colour[0]),
                    float(colour[1]),
                    float(colour[2]),
                    1.0 if mode == "OPAQUE" else min(max(alpha, 0.0), 1.0),
                ),
                image=image,
                cutoff=float(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.0,
                blend=mode == "BLEND",
                double_sided=bool(material.get("doubleSided", False)),
                unlit=unlit,
            )
        )
        return _Look(place, coordinates, transform, repeats, mode)

    def _texture(self, number: int, alpha: bool) -> tuple[Image, bool]:
        """Return a texture's image, and whether it repeats in both directions."""
        texture = self._get("textures", number)
        extensions = texture.get("extensions", {})
        source = extensions.get("EXT_texture_webp", {}).get("source", texture.get("source"))
        if source is None:
            names = ", ".join(extensions) or "no source"
            raise MeshError(
                f"{self._path}: textures[{number}]: expected a JPEG, PNG or WebP, found {names}: "
                f"{_unpack(next(iter(extensions), ''), self._path)}"
            )
        sampler = self._get("samplers", texture["sampler"]) if "sampler" in texture else {}
        repeats = all(sampler.get(key, _REPEAT) == _REPEAT for key in ("wrapS", "wrapT"))
        if (source, alpha) not in self._images:
            image = self._image(source)
            self._images[source, True] = image
            self._images[source, False] = opaque(image)
        return self._images[source, alpha], repeats

    def _image(self, number: int) -> Image:
        image = self._get("images", number)
        where = f"{self._path}: images[{number}]"
        if "bufferView" in image:
            encoded = bytes(self._view(image["bufferView"]))
        else:
            encoded = self._resource(where, image.get("uri"))
        if encoded[1:8] == b"KTX 20\xbb" or image.get("mimeType") == "image/ktx2":
            raise MeshError(
                f"{where}: expected a JPEG, PNG or WebP, found KTX2: {_unpack(_BASISU, self._path)}"
            )
        return decode(encoded, where)

    # Data.

    def _accessor(self, number: int) -> npt.NDArray[Any]:
        """Return the numbers of an accessor as they are stored, shape (n, width)."""
        accessor = self._get("accessors", number)
        where = f"{self._path}: accessors[{number}]"
        count = self._count(number)
        dtype, width = self._kind(where, accessor)
        if "bufferView" in accessor:
            view = self._get("bufferViews", accessor["bufferView"])
            values = self._numbers(
                where,
                accessor["bufferView"],
                accessor.get("byteOffset", 0),
                (count, width),
                dtype,
                view.get("byteStride") or dtype.itemsize * width,
            )
        else:
            if count * width * dtype.itemsize > self._most:
                raise MeshError(f"{where}: expected data, found none for {count} vectors")
            values = np.zeros((count, width), dtype)
        sparse = accessor.get("sparse")
        if not sparse:
            return values
        changed = int(sparse["count"])
        kind = np.dtype(_COMPONENTS.get(sparse["indices"]["componentType"], "V0"))
        places = self._numbers(
            where,
            sparse["indices"]["bufferView"],
            sparse["indices"].get("byteOffset", 0),
            (changed, 1),
            kind,
            kind.itemsize,
        )[:, 0]
        if changed and (kind.kind != "u" or int(places.max()) >= count):
            raise MeshError(f"{where}: expected sparse indices below {count}")
        values = values.copy()
        values[places] = self._numbers(
            where,
            sparse["values"]["bufferView"],
            sparse["values"].get("byteOffset", 0),
            (changed, width),
            dtype,
            dtype.itemsize * width,
        )
        return values

    def _count(self, number: int) -> int:
        count = self._get("accessors", number)["count"]
        if not isinstance(count, int) or not 0 <= count < 2**31:
            raise MeshError(
                f"{self._path}: accessors[{number}]: expected a count from 0 to 2147483647, found "
                f"{count}"
            )
        return count

    def _kind(self, where: str, accessor: dict[str, Any]) -> tuple[np.dtype[Any], int]:
        component, shape = accessor.get("componentType"), accessor.get("type")
        if component not in _COMPONENTS or shape not in _WIDTHS:
            raise MeshError(
                f"{where}: expected numbers of a componentType from 5120 to 5126 and of type "
                f"SCALAR or VEC2 to VEC4, found {component} and {shape}"
            )
        return np.dtype(_COMPONENTS[component]), _WIDTHS[shape]

    def _numbers(
        self,
        where: str,
        view: int,
        offset: int,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        stride: int,
    ) -> npt.NDArray[Any]:
        """Return numbers of a buffer view without a copy; the ends are checked."""
        data = self._view(view)
        count, width = shape
        needed = offset + (count - 1) * stride + width * dtype.itemsize if count else 0
        if offset < 0 or stride < 0 or count < 0 or needed > len(data) or not dtype.itemsize:
            raise MeshError(
                f"{where}: expected {needed} bytes in bufferViews[{view}] (byteOffset {offset}, "
                f"{count} of {width * dtype.itemsize} bytes, byteStride {stride}), found "
                f"{len(data)}"
            )
        return np.ndarray(shape, dtype, data, offset, (stride, dtype.itemsize))

    def _view(self, number: int) -> memoryview:
        view = self._get("bufferViews", number)
        buffer = self._buffer(view["buffer"])
        offset, length = view.get("byteOffset", 0), view["byteLength"]
        if not 0 <= offset <= offset + length <= len(buffer):
            raise MeshError(
                f"{self._path}: bufferViews[{number}]: expected bytes {offset} to "
                f"{offset + length} of buffers[{view['buffer']}], found {len(buffer)} bytes"
            )
        return memoryview(buffer)[offset : offset + length]

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            buffer = self._get("buffers", number)
            where = f"{self._path}: buffers[{number}]"
            if "uri" in buffer:
                self._buffers[number] = self._resource(where, buffer["uri"])
            elif number == 0 and self._binary is not None:
                self._buffers[number] = self._binary
            else:
                raise MeshError(f"{where}: expected data in this file or the name of one, found no")
        return self._buffers[number]

    def _resource(self, where: str, uri: Any) -> bytes:
        """Return the bytes of a data URI or of a file beside this one."""
        if not isinstance(uri, str):
            raise MeshError(f"{where}: expected the name of a file, found {uri}")
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            if not head.endswith(";base64"):
                raise MeshError(f"{where}: expected a data URI in base64, found {head[:60]}")
            try:
                return base64.b64decode(text)
            except binascii.Error as error:
                raise MeshError(f"{where}: expected base64, found: {error}") from error
        for name in (unquote(uri), uri):
            path = self._path.parent / name
            try:
                data = path.read_bytes()
            except (OSError, ValueError):  # no such file, or no name of a file
                continue
            self._sources.append(path)
            return data
        raise MeshError(
            f"{where}: expected a file {uri[:200]!r} in {self._path.parent}, found none"
        )


def _unpack(extension: str, path: Path) -> str:
    command = _UNPACKS.get(extension)
    if command is None:
        return "export it with JPEG or PNG"
    return f'unpack it: {command} "{path.name}" "{path.stem}_plain.glb"'


def _floats(raw: npt.NDArray[Any], normalized: bool) -> npt.NDArray[Any]:
    if raw.dtype.kind == "f":
        return raw
    values: Floats = raw.astype(np.float64)
    return np.maximum(values / np.iinfo(raw.dtype).max, -1.0) if normalized else values


def _corners(indices: npt.NDArray[np.int32], mode: int) -> npt.NDArray[np.int32]:
    """Return triangles of a list, a strip or a fan, without a strip's degenerate ones."""
    corners: npt.NDArray[np.int32]
    if mode == _TRIANGLES:
        corners = indices[: len(indices) // 3 * 3].reshape(-1, 3)
        return corners
    count = max(len(indices) - 2, 0)
    first = np.zeros(count, np.intp) if mode == _FAN else np.arange(count)
    corners = np.stack([indices[first], indices[1 : count + 1], indices[2 : count + 2]], axis=1)
    if mode == _STRIP:
        corners[1::2] = corners[1::2, [1, 0, 2]]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    return corners


def _colours(colours: npt.NDArray[Any] | None, mode: str) -> npt.NDArray[np.uint8] | None:
    """Convert linear vertex colours to sRGB; alpha counts where the material is not opaque."""
    if colours is None:
        return None
    values = np.full((len(colours), 4), 255, np.uint8)
    values[:, :3] = np.rint(255 * to_srgb(colours[:, :3]))
    if colours.shape[1] == 4 and mode != "OPAQUE":
        values[:, 3] = np.rint(255 * np.clip(np.nan_to_num(colours[:, 3]), 0, 1))
    return values


def _transform(texture: dict[str, Any]) -> tuple[Floats | None, int]:
    """Return the matrix of KHR_texture_transform and the number of the coordinates it is for."""
    coordinates = texture.get("texCoord", 0)
    extension = texture.get("extensions", {}).get("KHR_texture_transform")
    if extension is None:
        return None, int(coordinates)
    (across, down) = map(float, extension.get("scale", (1, 1)))
    angle = float(extension.get("rotation", 0))
    cos, sin = round(math.cos(angle), 12), round(math.sin(angle), 12)
    offset = extension.get("offset", (0, 0))
    matrix = np.array(  # counter-clockwise where v points down
        [[cos * across, sin * down, offset[0]], [-sin * across, cos * down, offset[1]]], float
    )
    return matrix, int(extension.get("texCoord", coordinates))
