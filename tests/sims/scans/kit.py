"""A small room of known triangles and colours, and writers of it in every format.

Its frame is z up, in metres. Writers of glTF and COLLADA turn it to y up, and that of COLLADA
writes centimetres.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sims.scans.mesh_file import Floats, MeshFile, Piece

Array = npt.NDArray[Any]

SIZE = (4.0, 3.0, 2.5)
"""Of the room, whose middle is at x = y = 0, and whose floor at z = 0."""


class Part(NamedTuple):
    name: str
    material: str
    points: Floats
    corners: npt.NDArray[np.int32]
    normals: Floats
    places: Floats  # v from the image's top
    colours: npt.NDArray[np.uint8] | None = None  # sRGB and alpha


class Look(NamedTuple):
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)  # sRGB
    image: npt.NDArray[np.uint8] | None = None


class Scene(NamedTuple):
    parts: list[Part]
    looks: dict[str, Look]


def room() -> Scene:
    """Return four walls of one image, a floor of another, and a red box on it."""
    x, y, z = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    a, b, c, d = (-x, -y), (x, -y), (x, y), (-x, y)
    walls = [
        quad([(*p, 0), (*q, 0), (*q, z), (*p, z)]) for p, q in ((b, a), (c, b), (d, c), (a, d))
    ]
    floor = [quad([(*a, 0), (*b, 0), (*c, 0), (*d, 0)])]
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
            n = np.eye(3)[axis] * sign
            square = [n - u - v, n + u - v, n + u + v, n - u + v]
            sides.append(quad([(0.25 * p + (1, 0.5, 0.25)).tolist() for p in square]))
    random = np.random.default_rng(5)
    images = [random.integers(0, 256, (4, 8, 3), np.uint8) for _ in range(2)]
    return Scene(
        [
            joined("walls", "wall", walls),
            joined("floor", "tiles", floor),
            joined("box", "red", sides),
        ],
        {
            "wall": Look(image=images[0]),
            "tiles": Look(image=images[1]),
            "red": Look((0.8, 0.2, 0.1)),
        },
    )


def quad(points: Any) -> Part:
    """Return two triangles of four points, counter-clockwise from where they are seen."""
    p = np.array(points, float)
    normal = np.cross(p[1] - p[0], p[2] - p[0])
    normals = np.tile(normal / np.linalg.norm(normal), (4, 1))
    places = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)])
    return Part("", "", p, np.array([(0, 1, 2), (0, 2, 3)], np.int32), normals, places)


def joined(name: str, material: str, parts: list[Part]) -> Part:
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    corners = [part.corners + start for part, start in zip(parts, starts, strict=False)]
    return Part(
        name,
        material,
        np.concatenate([part.points for part in parts]),
        np.concatenate(corners).astype(np.int32),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.places for part in parts]),
    )


def png(image: Array) -> bytes:
    channels = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    turned = image if image.ndim == 2 else cv2.cvtColor(image, channels[image.shape[2]])
    return bytes(cv2.imencode(".png", turned)[1].tobytes())


def y_up(vectors: Floats) -> Floats:
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1)


def linear(srgb: Any) -> Floats:
    value = np.asarray(srgb, float)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


# What a reader made of it.


def upright(points: Floats, mesh: MeshFile) -> Floats:
    """Return points of a file in metres with z up."""
    scaled = points * (mesh.unit or 1.0)
    if mesh.up == "y":
        return np.stack([scaled[:, 0], -scaled[:, 2], scaled[:, 1]], axis=1)
    return scaled


def soup(mesh: MeshFile) -> tuple[Floats, Floats]:
    """Return the triangles in metres, z up, shape (m, 3, 3), and their colours in their middles.

    They are in an order of their own, and begin with their least corner.
    """
    triangles, colours = [], []
    for piece in mesh.pieces:
        triangles.append(upright(piece.points, mesh)[piece.corners])
        colours.append(shades(mesh, piece))
    return ordered(np.concatenate(triangles), np.concatenate(colours))


def ordered(triangles: Floats, colours: Floats) -> tuple[Floats, Floats]:
    rounded = triangles.round(3) + 0.0
    for row, triangle in enumerate(rounded):
        first = min(range(3), key=lambda i: tuple(triangle[i]))
        rounded[row] = np.roll(triangle, -first, axis=0)
        triangles[row] = np.roll(triangles[row], -first, axis=0)
    order = np.lexsort(rounded.reshape(len(rounded), 9).T[::-1])
    return triangles[order], colours[order]


def shades(mesh: MeshFile, piece: Piece) -> Floats:
    """Return the colour in the middle of each triangle, sRGB from 0 to 1."""
    material = mesh.materials[piece.material]
    colour = np.tile(material.colour[:3], (len(piece.corners), 1))
    if piece.colours is not None:
        colour *= piece.colours[piece.corners, :3].mean(axis=1) / 255
    if material.image is not None and piece.places is not None:
        colour *= texels(material.image, piece.places[piece.corners].mean(axis=1)) / 255
    return colour


def texels(image: Array, places: Array) -> Array:
    height, width = image.shape[:2]
    column, row = (places * (width, height) % (width, height)).astype(int).T
    texel: Array = image[row, column][:, :3]
    return texel


def expected(scene: Scene) -> tuple[Floats, Floats]:
    """Return what `soup` returns of a file of a scene."""
    triangles, colours = [], []
    for part in scene.parts:
        look = scene.looks[part.material]
        shade = np.tile(look.colour, (len(part.corners), 1))
        if look.image is not None:
            shade *= texels(look.image, part.places[part.corners].mean(axis=1)) / 255
        triangles.append(part.points[part.corners])
        colours.append(shade)
    return ordered(np.concatenate(triangles), np.concatenate(colours))


# glTF.


class Gltf:
    """A glTF in the making; what has no method is put into `document` by a test."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scenes": [{"nodes": []}]}

    def add(self, kind: str, **entry: Any) -> int:
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def view(self, data: bytes, **entry: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.data += data
        offset = len(self.data) - len(data)
        return self.add("bufferViews", buffer=0, byteOffset=offset, byteLength=len(data), **entry)

    def accessor(self, values: Array, **entry: Any) -> int:
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        code = component[values.dtype.str[1:]]
        view = self.view(values.tobytes())
        return self.add(
            "accessors", bufferView=view, componentType=code, count=len(values), type=kind, **entry
        )

    def image(self, data: bytes, mime: str = "image/png") -> int:
        """Return the number of a texture."""
        source = self.add("images", bufferView=self.view(data), mimeType=mime)
        return self.add("textures", source=source)

    def mesh(self, *primitives: dict[str, Any], **node: Any) -> None:
        mesh = self.add("meshes", primitives=list(primitives))
        self.document["scenes"][0]["nodes"].append(self.add("nodes", mesh=mesh, **node))

    def require(self, *extensions: str) -> None:
        self.document["extensionsUsed"] = self.document["extensionsRequired"] = list(extensions)

    def glb(self) -> bytes:
        self.document["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        return head + chunks + struct.pack("<I4s", len(binary), b"BIN\0") + binary

    def gltf(self, buffer: Path | None = None) -> bytes:
        """Return the JSON, with the data in a file or, without one, inside."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        if buffer is not None:
            buffer.write_bytes(self.data)
            uri = buffer.name
        self.document["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.document).encode()


def gltf(
    scene: Scene,
    index: str = "u2",
    draco: bool = False,
    quantized: bool = False,
    mirrored: bool = False,
) -> Gltf:
    """Return a scene as glTF, each part a node.

    Args:
        index: Type of the indices; empty for none.
        quantized: Whether points are 16-bit integers, and places normalized ones.
        mirrored: Whether each node turns what is left to the right, and its points are turned so.
    """
    made = Gltf()
    numbers = {
        name: made.add("materials", **material(made, name, look))
        for name, look in scene.looks.items()
    }
    for part in scene.parts:
        points, normals = y_up(part.points), y_up(part.normals)
        places, corners, node = part.places, part.corners, {}
        if mirrored:
            points, normals, corners = points * (-1, 1, 1), normals * (-1, 1, 1), corners[:, ::-1]
            node = {"scale": [-1, 1, 1]}
        if not index:
            order = corners.reshape(-1)
            points, normals, places = points[order], normals[order], places[order]
        primitive: dict[str, Any] = {"material": numbers[part.material]}
        if draco:
            primitive |= packed(made, points, normals, places, corners)
        elif quantized:
            scale = np.abs(points).max() / 32767
            node = {"scale": [scale] * 3}
            primitive["attributes"] = {
                "POSITION": made.accessor((points / scale).round().astype("<i2")),
                "NORMAL": made.accessor((normals * 127).round().astype("i1"), normalized=True),
                "TEXCOORD_0": made.accessor((places * 65535).astype("<u2"), normalized=True),
            }
            primitive["attributes"] = aligned(made, primitive["attributes"])
        else:
            primitive["attributes"] = {
                "POSITION": made.accessor(points.astype("<f4")),
                "NORMAL": made.accessor(normals.astype("<f4")),
                "TEXCOORD_0": made.accessor(places.astype("<f4")),
            }
        if index and not draco:
            dtype = np.dtype(index).newbyteorder("<")
            primitive["indices"] = made.accessor(corners.reshape(-1).astype(dtype))
        made.mesh(primitive, name=part.name, **node)
    if quantized:
        made.require("KHR_mesh_quantization")
    if draco:
        made.require("KHR_draco_mesh_compression")
    return made


def aligned(made: Gltf, attributes: dict[str, int]) -> dict[str, int]:
    """Write attributes again with a stride of a multiple of 4, as vectors of 16 bits need."""
    for number in attributes.values():
        accessor = made.document["accessors"][number]
        view = made.document["bufferViews"][accessor["bufferView"]]
        size = view["byteLength"] // accessor["count"]
        stride = -(-size // 4) * 4
        start = view["byteOffset"]
        rows = np.frombuffer(bytes(made.data[start : start + view["byteLength"]]), np.uint8)
        padded = np.zeros((accessor["count"], stride), np.uint8)
        padded[:, :size] = rows.reshape(-1, size)
        accessor["bufferView"] = made.view(padded.tobytes(), byteStride=stride)
    return attributes


def packed(made: Gltf, points: Floats, normals: Floats, places: Floats, corners: Array) -> Any:
    import DracoPy

    data = DracoPy.encode(
        points.astype("f4"),
        corners.astype("u4"),
        quantization_bits=20,
        preserve_order=True,
        generic_attributes={0: normals.astype("f4"), 1: places.astype("f4")},
    )
    decoded = DracoPy.decode(data)
    position = next(a["unique_id"] for a in decoded.attributes if a["attribute_type"] == 0)
    count = len(points)
    return {
        "attributes": {
            name: made.add("accessors", componentType=5126, count=count, type=kind)
            for name, kind in (("POSITION", "VEC3"), ("NORMAL", "VEC3"), ("TEXCOORD_0", "VEC2"))
        },
        "indices": made.add("accessors", componentType=5125, count=corners.size, type="SCALAR"),
        "extensions": {
            "KHR_draco_mesh_compression": {
                "bufferView": made.view(data),
                "attributes": {"POSITION": position, "NORMAL": 0, "TEXCOORD_0": 1},
            }
        },
    }


def material(made: Gltf, name: str, look: Look) -> dict[str, Any]:
    rough: dict[str, Any] = {"baseColorFactor": [*linear(look.colour).tolist(), 1.0]}
    if look.image is not None:
        rough["baseColorTexture"] = {"index": made.image(png(look.image))}
    return {"name": name, "pbrMetallicRoughness": rough}


# The others.


def write_obj(scene: Scene, path: Path, textures: str = "textures") -> None:
    """Write an OBJ, its MTL, and its images in a folder beside them."""
    (path.parent / textures).mkdir(exist_ok=True)
    lines, mtl, start = [f"mtllib {path.stem}.mtl"], [], 1
    for name, look in scene.looks.items():
        mtl += [f"newmtl {name}", "Kd {} {} {}".format(*look.colour)]
        if look.image is not None:
            (path.parent / textures / f"{name}.png").write_bytes(png(look.image))
            mtl.append(f"map_Kd {textures}/{name}.png")
    for part in scene.parts:
        lines.append(f"o {part.name}")
        lines += ["v {:.6f} {:.6f} {:.6f}".format(*p) for p in part.points]
        lines += [f"vt {u:.6f} {1 - v:.6f}" for u, v in part.places]
        lines += ["vn {:.6f} {:.6f} {:.6f}".format(*n) for n in part.normals]
        lines.append(f"usemtl {part.material}")
        lines += ["f " + " ".join(f"{i}/{i}/{i}" for i in row + start) for row in part.corners]
        start += len(part.points)
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text("\n".join(mtl) + "\n")


def ply(scene: Scene, order: str = "<") -> bytes:
    """Return a PLY with the colours of the triangles' middles at their vertices.

    Args:
        order: Byte order; "=" for text.
    """
    triangles, colours = expected(scene)
    points = triangles.reshape(-1, 3)
    shade = np.repeat((255 * colours).round().astype(np.uint8), 3, axis=0)
    corners = np.arange(len(points)).reshape(-1, 3)
    names = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}
    head = [
        f"ply\nformat {names[order]} 1.0\nelement vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(corners)}\nproperty list uchar int vertex_indices\nend_header\n",
    ]
    if order == "=":
        rows = [" ".join(map(str, [*p, *c])) for p, c in zip(points, shade, strict=True)]
        rows += [f"3 {a} {b} {c}" for a, b, c in corners]
        return ("\n".join(head) + "\n".join(rows)).encode()
    vertices = np.zeros(len(points), [("p", f"{order}f4", 3), ("c", "u1", 3)])
    vertices["p"], vertices["c"] = points, shade
    faces = np.zeros(len(corners), [("n", "u1"), ("i", f"{order}i4", 3)])
    faces["n"], faces["i"] = 3, corners
    return "\n".join(head).encode() + vertices.tobytes() + faces.tobytes()


def stl(scene: Scene, text: bool = False) -> bytes:
    triangles, _ = expected(scene)
    if text:
        vertices = [
            "facet normal 0 0 0\nouter loop\n"
            + "".join("vertex {:.6e} {:.6e} {:.6e}\n".format(*p) for p in triangle)
            + "endloop\nendfacet\n"
            for triangle in triangles
        ]
        return f"solid room\n{''.join(vertices)}endsolid room\n".encode()
    rows = np.zeros(len(triangles), [("n", "<f4", 3), ("p", "<f4", (3, 3)), ("a", "<u2")])
    rows["p"] = triangles
    return bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes()


def write_collada(scene: Scene, path: Path, textures: str = "../materials/textures") -> None:
    """Write a COLLADA in centimetres with y up, and its images where Gazebo's models have them."""
    (path.parent / textures).mkdir(parents=True, exist_ok=True)
    images, effects, materials, geometries, nodes = [], [], [], [], []
    for name, look in scene.looks.items():
        diffuse = "<color>{} {} {} 1</color>".format(*look.colour)
        params = ""
        if look.image is not None:
            (path.parent / textures / f"{name}.png").write_bytes(png(look.image))
            source = f"<init_from>{textures}/{name}.png</init_from>"
            images.append(f'<image id="{name}-image">{source}</image>')
            params = (
                f'<newparam sid="{name}-s"><surface type="2D"><init_from>{name}-image</init_from>'
                f'</surface></newparam><newparam sid="{name}-t"><sampler2D><source>{name}-s'
                "</source></sampler2D></newparam>"
            )
            diffuse = f'<texture texture="{name}-t" texcoord="UV"/>'
        effects.append(
            f'<effect id="{name}-e"><profile_COMMON>{params}<technique sid="c"><lambert><diffuse>'
            f"{diffuse}</diffuse></lambert></technique></profile_COMMON></effect>"
        )
        materials.append(
            f'<material id="{name}-m" name="{name}"><instance_effect url="#{name}-e"/></material>'
        )
    for part in scene.parts:
        sources = "".join(
            f'<source id="{part.name}-{key}"><float_array id="{part.name}-{key}-a">'
            f"{' '.join(map(str, values.reshape(-1)))}</float_array><technique_common>"
            f'<accessor source="#{part.name}-{key}-a" count="{len(values)}" '
            f'stride="{values.shape[1]}"/></technique_common></source>'
            for key, values in (
                ("p", y_up(part.points) * 100),
                ("n", y_up(part.normals)),
                ("t", np.stack([part.places[:, 0], 1 - part.places[:, 1]], axis=1)),
            )
        )
        numbers = " ".join(map(str, np.repeat(part.corners.reshape(-1), 2)))
        geometries.append(
            f'<geometry id="{part.name}-g"><mesh>{sources}<vertices id="{part.name}-v">'
            f'<input semantic="POSITION" source="#{part.name}-p"/></vertices>'
            f'<triangles material="m" count="{len(part.corners)}">'
            f'<input semantic="VERTEX" source="#{part.name}-v" offset="0"/>'
            f'<input semantic="NORMAL" source="#{part.name}-n" offset="0"/>'
            f'<input semantic="TEXCOORD" source="#{part.name}-t" offset="1" set="0"/>'
            f"<p>{numbers}</p></triangles></mesh></geometry>"
        )
        nodes.append(
            f'<node id="{part.name}" name="{part.name}"><instance_geometry url="#{part.name}-g">'
            '<bind_material><technique_common><instance_material symbol="m" '
            f'target="#{part.material}-m"/></technique_common></bind_material>'
            "</instance_geometry></node>"
        )
    path.write_text(
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" '
        'version="1.4.1"><asset><unit meter="0.01"/><up_axis>Y_UP</up_axis></asset>'
        f"<library_images>{''.join(images)}</library_images>"
        f"<library_effects>{''.join(effects)}</library_effects>"
        f"<library_materials>{''.join(materials)}</library_materials>"
        f"<library_geometries>{''.join(geometries)}</library_geometries>"
        f'<library_visual_scenes><visual_scene id="s">{"".join(nodes)}</visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def write_world(scene: Scene, folder: Path) -> Path:
    """Write a world of Gazebo with the scene as a model, turned and moved there and back."""
    meshes = folder / "models" / "room" / "meshes"
    meshes.mkdir(parents=True)
    write_collada(scene, meshes / "room.dae")
    (meshes.parent / "model.config").write_text(
        '<model><sdf version="1.4">old.sdf</sdf><sdf version="1.6">model.sdf</sdf></model>'
    )
    (meshes.parent / "model.sdf").write_text(
        '<sdf version="1.6"><model name="room"><static>1</static><pose>9 9 9 0 0 0</pose>'
        '<link name="link"><pose>0 0 1 0 0 0</pose><visual name="v">'
        "<pose>0 0 -1 1.5707963267948966 0 0</pose>"
        "<geometry><mesh><uri>model://room/meshes/room.dae</uri></mesh></geometry></visual>"
        '<collision name="c"><pose>0 0 -1 0 0 0</pose><geometry><box><size>4 3 0.1</size></box>'
        "</geometry></collision></link></model></sdf>"
    )
    path = folder / "room.world"
    path.write_text(
        '<sdf version="1.6"><world name="w"><include><uri>model://sun</uri></include>'
        '<model name="hall"><static>1</static><pose>1 2 0 0 0 0.5</pose><include>'
        "<uri>model://room</uri>"
        f"<pose>{-np.cos(0.5) - 2 * np.sin(0.5)} {np.sin(0.5) - 2 * np.cos(0.5)} 0 0 0 -0.5</pose>"
        "</include></model></world></sdf>"
    )
    return path
