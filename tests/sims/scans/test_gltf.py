"""What glTF can say of triangles and their look, and what of it is refused or left out."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.errors import MissingDependencyError
from sims.scans.mesh_file import Material, MeshError, MeshFile
from sims.scans.reading import read
from tests.sims.scans import kit

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], "<f4")
PLACES = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], "<f4")
LIST = np.array([0, 1, 2, 0, 2, 3], "<u2")
RGBA = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)


class Square:
    """A glTF of one square; tests change its primitive, material and document."""

    def __init__(self, path: Path) -> None:
        self.path = path / "square.glb"
        self.made = kit.Gltf()
        self.document = self.made.document
        self.material: dict[str, Any] = {}
        self.attributes = {
            "POSITION": self.made.accessor(SQUARE),
            "TEXCOORD_0": self.made.accessor(PLACES),
        }
        self.primitive: dict[str, Any] = {"attributes": self.attributes, "material": 0}
        self.primitive["indices"] = self.made.accessor(LIST)
        self.node: dict[str, Any] = {}

    def read(self) -> MeshFile:
        self.document.setdefault("materials", [self.material])
        if "meshes" not in self.document:
            self.made.mesh(self.primitive, **self.node)
        self.path.write_bytes(self.made.glb())
        return read(self.path)

    def texture(self, image: Any = RGBA, **info: Any) -> None:
        self.material["pbrMetallicRoughness"] = {
            "baseColorTexture": {"index": self.made.image(kit.png(image)), **info}
        }

    def look(self) -> Material:
        return self.read().materials[0]


@pytest.fixture
def square(tmp_path: Path) -> Square:
    return Square(tmp_path)


# Triangles.


@pytest.mark.parametrize(
    ("mode", "indices"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])]
)
def test_lists_strips_and_fans_are_seen_from_the_same_side(
    square: Square, mode: int, indices: list[int]
) -> None:
    square.primitive |= {"mode": mode, "indices": square.made.accessor(np.array(indices, "u1"))}
    (piece,) = square.read().pieces
    a, b, c = (piece.points[piece.corners[:, i]] for i in range(3))
    assert np.allclose(np.cross(b - a, c - a), (0, 0, 1))


def test_a_strip_has_no_triangles_without_an_area(square: Square) -> None:
    joint = square.made.accessor(np.array([0, 1, 3, 3, 1, 1, 2, 3], "u1"))
    square.primitive |= {"mode": 5, "indices": joint}
    assert len(square.read().pieces[0].corners) == 2


def test_nodes_stand_in_each_other(square: Square) -> None:
    square.made.mesh(square.primitive, name="leaf", rotation=[0, 0, 0.5**0.5, 0.5**0.5])
    half = {"matrix": [0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5, 0, 3, 0, 0, 1], "children": [0]}
    square.document["nodes"] += [half, {"translation": [0, 7, 0], "children": [1]}]
    square.document["scenes"] = [{"nodes": [2]}]
    (piece,) = square.read().pieces
    assert piece.object == "leaf"
    assert np.allclose(piece.points, [(3, 7, 0), (3, 7.5, 0), (2.5, 7.5, 0), (2.5, 7, 0)])


def test_a_mesh_in_two_nodes_is_two_objects(square: Square) -> None:
    square.made.mesh(square.primitive, name="leaf")
    square.document["nodes"].append({"mesh": 0, "name": "leaf", "translation": [0, 0, 9]})
    square.document["scenes"][0]["nodes"].append(1)
    first, second = square.read().pieces
    assert (first.object, second.object) == ("leaf", "leaf_2")
    assert np.array_equal(second.points - first.points, np.tile((0, 0, 9), (4, 1)))


def test_sparse_accessors_change_points(square: Square) -> None:
    entry = square.document["accessors"][square.attributes["POSITION"]]
    entry["sparse"] = {
        "count": 1,
        "indices": {"bufferView": square.made.view(b"\2"), "componentType": 5121},
        "values": {"bufferView": square.made.view(np.array([5, 6, 7], "<f4").tobytes())},
    }
    assert square.read().pieces[0].points.tolist() == [[0, 0, 0], [1, 0, 0], [5, 6, 7], [0, 1, 0]]


def test_points_and_lines_are_left_out(square: Square) -> None:
    square.made.mesh(square.primitive, {**square.primitive, "mode": 1})
    assert square.read().left_out[0] == "primitives of points or lines (1): not drawn"


# Colours.


@pytest.mark.parametrize("kind", ["<f4", "<u2", "u1"])
def test_vertex_colours_are_linear_in_the_file(square: Square, kind: str) -> None:
    srgb = np.array([(255, 128, 0), (0, 0, 0), (10, 200, 60), (1, 2, 3)], np.uint8)
    most = 1 if kind == "<f4" else np.iinfo(kind).max
    stored = kit.linear(srgb / 255) * most
    stored = stored.astype(kind) if kind == "<f4" else stored.round().astype(kind)
    square.attributes["COLOR_0"] = square.made.accessor(stored, normalized=kind != "<f4")
    colours = square.read().pieces[0].colours
    assert colours is not None
    assert (colours[:, 3] == 255).all()
    # Eight bits of linear light are steps of up to 13 in the dark.
    assert np.abs(colours[:, :3].astype(int) - srgb).max() <= (13 if kind == "u1" else 1)


@pytest.mark.parametrize(
    ("mode", "alpha", "cutoff", "blend", "channels"),
    [
        ({}, 1.0, 0.0, False, 3),
        ({"alphaMode": "MASK"}, 0.5, 0.5, False, 4),
        ({"alphaMode": "MASK", "alphaCutoff": 0.25}, 0.5, 0.25, False, 4),
        ({"alphaMode": "BLEND"}, 0.5, 0.0, True, 4),
    ],
)
def test_alpha_counts_where_the_material_says_so(
    square: Square, mode: Any, alpha: float, cutoff: float, blend: bool, channels: int
) -> None:
    square.texture()
    square.material |= mode
    square.material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.5]
    look = square.look()
    assert (look.colour[3], look.cutoff, look.blend) == (alpha, cutoff, blend)
    assert look.image is not None
    assert np.array_equal(look.image, RGBA[..., :channels])


def test_an_opaque_materials_vertices_are_opaque(square: Square) -> None:
    square.attributes["COLOR_0"] = square.made.accessor(np.full((4, 4), 0.5, "<f4"))
    (piece,) = square.read().pieces
    assert piece.colours is not None
    assert piece.colours.tolist() == [[188, 188, 188, 255]] * 4
    square.material["alphaMode"] = "BLEND"
    (piece,) = square.read().pieces
    assert piece.colours is not None
    assert piece.colours.tolist() == [[188, 188, 188, 128]] * 4


def test_a_factor_is_linear_in_the_file(square: Square) -> None:
    factor = kit.linear([0.5, 0.25, 0.75]).tolist()
    square.material["pbrMetallicRoughness"] = {"baseColorFactor": [*factor, 1]}
    assert np.allclose(square.look().colour, (0.5, 0.25, 0.75, 1))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_images_of_all_formats(square: Square, suffix: str) -> None:
    image = np.full((8, 8, 3), (200, 100, 50), np.uint8)
    data = cv2.imencode(suffix, image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    texture = square.made.image(data, f"image/{suffix[1:]}")
    if suffix == ".webp":
        square.made.require("EXT_texture_webp")
        entry = square.document["textures"][texture]
        entry["extensions"] = {"EXT_texture_webp": {"source": entry.pop("source")}}
    square.material["pbrMetallicRoughness"] = {"baseColorTexture": {"index": texture}}
    look = square.look()
    assert look.image is not None
    assert np.abs(look.image.astype(int) - image).max() < 4


def test_an_image_lies_beside_the_file(square: Square) -> None:
    square.texture()
    square.document["images"] = [{"uri": "my%20wall.png"}]
    (square.path.parent / "my wall.png").write_bytes(kit.png(RGBA))
    look = square.look()
    assert look.image is not None
    assert np.array_equal(look.image, RGBA[..., :3])


def test_materials_share_an_image(square: Square) -> None:
    square.texture()
    square.document["materials"] = [square.material, {**square.material, "name": "other"}]
    square.made.mesh(square.primitive, {**square.primitive, "material": 1})
    first, second = square.read().materials
    assert first.image is second.image


def test_texture_coordinates_are_of_the_set_that_the_texture_names(square: Square) -> None:
    square.attributes["TEXCOORD_1"] = square.made.accessor(PLACES / 2)
    square.texture(texCoord=1)
    places = square.read().pieces[0].places
    assert places is not None
    assert np.array_equal(places, PLACES / 2)


def test_a_texture_is_turned_as_in_the_extensions_example(square: Square) -> None:
    """Which shows "only the lower left quadrant of the source image, rotated clockwise 90°"."""
    extension = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    square.texture(extensions={"KHR_texture_transform": extension})
    places = square.read().pieces[0].places
    assert places is not None
    # The square's corners: lower left, lower right, upper right, upper left.
    assert np.allclose(places, [(0.5, 1), (0.5, 0.5), (0, 0.5), (0, 1)], atol=1e-6)


def test_unlit_and_double_sided(square: Square) -> None:
    square.material |= {"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
    assert square.look()[-2:] == (True, True)


def test_a_bake_that_is_all_emission_is_unlit(square: Square) -> None:
    square.material |= {
        "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
        "emissiveTexture": {"index": square.made.image(kit.png(RGBA[..., :3]))},
        "emissiveFactor": [1, 1, 1],
    }
    look = square.look()
    assert look.unlit
    assert look.colour == (1, 1, 1, 1)
    assert look.image is not None
    assert np.array_equal(look.image, RGBA[..., :3])


def test_specular_and_glossiness_have_a_diffuse_colour(square: Square) -> None:
    gloss = {"diffuseFactor": [1, 0, 0, 1]}
    square.material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": gloss}
    look = square.look()
    assert look.colour == (1, 0, 0, 1)


# What is left out.


def test_what_is_not_drawn_is_counted(square: Square) -> None:
    square.texture()
    texture = {"index": 0}
    square.material |= {"normalTexture": texture, "occlusionTexture": texture}
    square.material |= {"emissiveTexture": texture, "emissiveFactor": [1, 1, 1]}
    square.material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = texture
    square.material["extensions"] = {"KHR_materials_clearcoat": {}}
    square.document |= {"animations": [{}], "skins": [{}, {}], "cameras": [{}]}
    square.document["extensionsUsed"] = ["EXT_mesh_gpu_instancing", "KHR_materials_clearcoat"]
    square.document["scenes"].append({"nodes": []})
    square.primitive["targets"] = [{}]
    assert square.read().left_out == (
        "animations (1): the scene stands as it is stored",
        "cameras (1): not used",
        "extension EXT_mesh_gpu_instancing (1): not read",
        "further scenes (1): not drawn",
        "materials that glow (1): lit as others are",
        "materials with KHR_materials_clearcoat (1): drawn without it",
        "normal maps (1): not drawn",
        "occlusion maps (1): not drawn",
        "primitives with morph targets (1): their base shape is drawn",
        "roughness maps (1): not drawn",
        "skins (2): meshes stand in the pose in which they were bound",
    )


@pytest.mark.parametrize(("scale", "counts"), [(1.0, False), (2.0, True)])
def test_a_clamped_image_is_told_where_it_matters(
    square: Square, scale: float, counts: bool
) -> None:
    square.attributes["TEXCOORD_0"] = square.made.accessor(PLACES * np.float32(scale))
    square.texture()
    square.document["samplers"] = [{"wrapS": 33071}]
    square.document["textures"][0]["sampler"] = 0
    sentence = "primitives with an image that is clamped or mirrored (1): it is repeated instead"
    assert square.read().left_out == ((sentence,) if counts else ())


@pytest.mark.parametrize("lights", [[], [{"type": "point"}]])
def test_lights_are_told(square: Square, lights: list[Any]) -> None:
    square.document["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    assert square.read().lit == bool(lights)


# Refusals.


def index_out_of_range(square: Square) -> None:
    square.primitive["indices"] = square.made.accessor(np.array([0, 1, 4], "u1"))


def count(square: Square) -> None:
    square.document["accessors"][0]["count"] = 10**9


def offset(square: Square) -> None:
    square.document["accessors"][0]["byteOffset"] = -4


def no_data(square: Square) -> None:
    square.document["accessors"][0] |= {"count": 2**30}
    del square.document["accessors"][0]["bufferView"]


def circle(square: Square) -> None:
    square.node["children"] = [0]


def basisu(square: Square) -> None:
    square.texture()
    square.document["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    square.made.require("KHR_texture_basisu")


def ktx(square: Square) -> None:
    square.texture()
    square.document["images"][0]["bufferView"] = square.made.view(b"\xabKTX 20\xbb\r\n\x1a\n")


def short_places(square: Square) -> None:
    square.attributes["TEXCOORD_0"] = square.made.accessor(PLACES[:3])


def nan(square: Square) -> None:
    square.attributes["POSITION"] = square.made.accessor(SQUARE * np.float32("nan"))


def picture(square: Square) -> None:
    square.texture()
    square.document["images"][0]["bufferView"] = square.made.view(b"GIF89a")


def missing_picture(square: Square) -> None:
    square.texture()
    square.document["images"] = [{"uri": "wall.png"}]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.made.require("EXT_meshopt_compression"), 'gltf-transform copy "square.glb"'),
        (lambda s: s.made.require("VENDOR_magic"), "found that it needs VENDOR_magic"),
        (basisu, 'gltf-transform ktxdecompress "square.glb"'),
        (ktx, "found KTX2: unpack it: gltf-transform ktxdecompress"),
        (index_out_of_range, r"meshes\[0\].primitives\[0\]: expected indices below 4, .* found 4"),
        (count, r"accessors\[0\]: expected \d+ bytes in bufferViews\[0\] .*, found 48"),
        (offset, "byteOffset -4"),
        (no_data, r"accessors\[0\]: expected data, found none for 1073741824 vectors"),
        (circle, r"nodes\[0\]: expected a node to have one parent and no circle"),
        (short_places, "TEXCOORD_0: expected 4 vectors of 2 numbers, found 3 of 2"),
        (nan, "expected finite points"),
        (picture, r"images\[0\]: expected a JPEG, PNG, WebP, BMP or TIFF, found 6 bytes"),
        (missing_picture, "expected a file 'wall.png' in .*, found none"),
        (lambda s: s.document["asset"].update(version="1.0"), "expected glTF 2.0, found version 1"),
        (lambda s: s.document.update(scene=3), "number of one of 1 scenes, found 3"),
        (lambda s: s.node.update(scale=[float("inf")] * 3), r"nodes\[0\]: expected a finite"),
        (lambda s: s.attributes.clear(), "expected triangles, found none; left out: primitives"),
    ],
)
def test_a_refusal_is_a_sentence(
    square: Square, change: Callable[[Square], Any], message: str
) -> None:
    change(square)
    with pytest.raises(MeshError, match=message) as refusal:
        square.read()
    assert str(refusal.value).startswith(str(square.path))


@pytest.mark.parametrize("size", [0, 3, 11, 19, 30, 300])
def test_a_cut_file_is_refused(square: Square, size: int) -> None:
    square.read()
    square.path.write_bytes(square.path.read_bytes()[:size])
    with pytest.raises(MeshError, match="expected"):
        read(square.path)


def test_draco_needs_a_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "room.glb"
    path.write_bytes(kit.gltf(kit.room(), draco=True).glb())
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(MissingDependencyError, match=r"DracoPy: pip install -e '\.\[meshes\]'"):
        read(path)
