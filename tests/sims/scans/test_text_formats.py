"""OBJ with MTL, PLY and STL: their variants, and what of them is refused or left out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sims.scans.mesh_file import MeshError, MeshFile
from sims.scans.reading import read
from tests.sims.scans import kit

POINTS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
PLACES = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
IMAGE = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)
Reads = Callable[..., MeshFile]


@pytest.fixture
def reads(tmp_path: Path) -> Reads:
    """Return a function that writes a text or bytes as a file of a suffix, and reads it."""

    def write(text: str | bytes, suffix: str = ".obj", mtl: str = "") -> MeshFile:
        path = tmp_path / f"mesh{suffix}"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        path.with_suffix(".mtl").write_text(mtl)
        return read(path)

    return write


# OBJ.


@pytest.mark.parametrize(
    "text",
    [
        f"{POINTS}f 1 2 3 4\n",
        f"{POINTS}f -4 -3 -2 -1\n",
        f"{POINTS}f 1 2 3\nf 1 3 4",
        f"{POINTS}f 1// 2// 3//\nf 1/ 3/ 4/\n",
        f"{POINTS}vn 0 0 1\nf 1//1 2//1 3//1 4//-1\n",
        f"{POINTS}{PLACES}f 1/1 2/2 3/3 4/4\n",
        f"{POINTS}{PLACES}vn 0 0 1\nf 1 2 3\nf 1/1/1 3/3/1 4/4/1\n",
        f"# a comment\n\n  {POINTS}\tf 1 2 3 4 # and one here\n",
        f"{POINTS}f 1 2 \\\n3 4\n".replace("\n", "\r\n"),
        f"{POINTS}f 1 2 3 4\n".replace("\n", "\r"),
        f"{POINTS}s off\ng\nf 1 2 3 4\n",
    ],
)
def test_faces_in_all_forms_are_the_same_square(reads: Reads, text: str) -> None:
    (piece,) = reads(text).pieces
    triangles = piece.points[piece.corners].tolist()
    assert triangles == [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]


def test_a_vertex_is_as_many_as_it_has_places(reads: Reads) -> None:
    (piece,) = reads(f"{POINTS}{PLACES}f 1/1 2/2 3/3\nf 1/4 3/3 4/4\n").pieces
    assert piece.places is not None
    corners = np.concatenate([piece.points, piece.places], axis=1)[piece.corners.reshape(-1)]
    assert len(piece.points) == 5
    assert corners[[0, 3], 3:].tolist() == [[0, 1], [0, 0]]  # v from the top


@pytest.mark.parametrize(("most", "digits"), [(1.0, 6), (255.0, 0)])
def test_points_may_have_colours(reads: Reads, most: float, digits: int) -> None:
    colours = [(0.2, 0.4, 0.6), (1.0, 0.0, 0.0), (0.0, 1.0, 0.2), (0.4, 0.4, 0.4)]
    lines = [
        f"{line} " + " ".join(f"{most * value:.{digits}f}" for value in colour)
        for line, colour in zip(POINTS.splitlines(), colours, strict=True)
    ]
    (piece,) = reads("\n".join([*lines, "f 1 2 3 4"])).pieces
    assert piece.colours is not None
    wanted = [[*(round(255 * value) for value in colour), 255] for colour in colours]
    assert piece.colours.tolist() == wanted


def test_objects_and_materials_are_pieces(reads: Reads) -> None:
    mesh = reads(
        f"mtllib mesh.mtl\n{POINTS}o a\nusemtl red\nf 1 2 3\nusemtl glass\nf 1 3 4\n"
        "o b\nf 1 2 4\no a\nusemtl red\nf 2 3 4\n",
        mtl="newmtl red\nKd 1 0 0\nnewmtl glass\nd 0.25\nnewmtl other\nmap_Kd gone.png\n",
    )
    names = [
        (piece.object, mesh.materials[piece.material].name, len(piece.corners))
        for piece in mesh.pieces
    ]
    assert names == [("a", "red", 2), ("a", "glass", 1), ("b", "glass", 1)]
    assert [m.colour for m in mesh.materials[1:]] == [(1, 0, 0, 1), (1, 1, 1, 0.25)]
    assert [m.blend for m in mesh.materials[1:]] == [False, True]
    assert mesh.left_out == ()  # what no face uses is not missed


@pytest.mark.parametrize(
    ("place", "named"),
    [
        ("tex", "tex/wall.png"),
        ("tex", r"tex\wall.png"),
        (".", r"C:\Users\me\scan\WALL.png"),
        ("textures", "wall.png"),
        ("../materials/textures", "/home/me/wall.png"),
        (".", "-s 1 1 1 -bm 0.5 wall.png"),
    ],
)
def test_images_are_found_where_they_are(tmp_path: Path, place: str, named: str) -> None:
    folder = tmp_path / "mesh"
    (folder / place).mkdir(parents=True, exist_ok=True)
    (folder / place / "wall.png").write_bytes(kit.png(IMAGE))
    (folder / "m.obj").write_text(f"mtllib m.mtl\n{POINTS}{PLACES}usemtl w\nf 1/1 2/2 3/3\n")
    (folder / "m.mtl").write_text(f"newmtl w\nKd 0 0 0\nmap_Kd {named}\n")
    mesh = read(folder / "m.obj")
    look = mesh.materials[mesh.pieces[0].material]
    assert look.colour == (1, 1, 1, 1)
    assert look.image is not None
    assert np.array_equal(look.image, IMAGE[..., :3])
    options = ("images with options in the MTL (1): drawn without them",)
    assert mesh.left_out == (options if named.startswith("-") else ())


def test_an_alpha_map_cuts_its_image(reads: Reads, tmp_path: Path) -> None:
    (tmp_path / "leaf.png").write_bytes(kit.png(IMAGE))
    text = f"mtllib mesh.mtl\n{POINTS}{PLACES}usemtl leaf\nf 1/1 2/2 3/3\n"
    mesh = reads(text, mtl="newmtl leaf\nmap_Kd leaf.png\nmap_d leaf.png\n")
    look = mesh.materials[mesh.pieces[0].material]
    assert look.cutoff == 0.5
    assert look.image is not None
    assert np.array_equal(look.image, IMAGE)


@pytest.mark.parametrize(
    ("line", "alpha"), [("d 0.5", 0.5), ("Tr 0.25", 0.75), ("d 1", 1.0), ("Tr 1", 1.0)]
)
def test_nothing_is_invisible(reads: Reads, line: str, alpha: float) -> None:
    mesh = reads(f"mtllib mesh.mtl\n{POINTS}usemtl a\nf 1 2 3\n", mtl=f"newmtl a\n{line}\n")
    look = mesh.materials[mesh.pieces[0].material]
    assert (look.colour[3], look.blend) == (alpha, alpha < 1)


def test_what_an_obj_loses_is_told(reads: Reads) -> None:
    mesh = reads(
        f"mtllib gone.mtl mesh.mtl\n{POINTS}usemtl a\nf 1/7 2/7 3/7\nf 1 2\nl 1 2\n"
        "usemtl b\nf 1 2 4\n",
        mtl="newmtl a\nKd 0 1 0\nmap_Kd gone.jpg\nmap_Bump bump.png\n",
    )
    assert mesh.left_out == (
        "corners with a vt that is not in the file (3): drawn without it",
        "faces of fewer than 3 corners (1): not drawn",
        "image 'gone.jpg' (1): not found; drawn in the material's colour",
        "lines (1): not drawn",
        "material file 'gone.mtl' (1): not found; its materials are drawn white",
        "materials that no file describes (1): drawn white",
        "normal maps (1): not drawn",
    )
    assert mesh.materials[mesh.pieces[0].material].colour == (0, 1, 0, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected triangles, found none"),
        (POINTS, "found a cloud of 4 points without any: make a mesh of it"),
        (f"{POINTS}f 1 2 5\n", "line 5: expected the number of one of 4 v, found 5"),
        (f"{POINTS}f 1 2 0\n", "line 5: expected the number of one of 4 v, found 0"),
        (f"{POINTS}f 1 2 -5\n", "line 5: expected the number of one of 4 v, found -5"),
        (f"{POINTS}f 1/1 2 3/1\n", r"line 5: expected corners that are all alike .* b'f 1/1 2 3/1"),
        ("v 0 0\nf 1 1 1\n", "line 1: expected at least 3 numbers behind v, found 2"),
        ("v 0 0 x\nf 1 1 1\n", "behind v: expected numbers, found b'x'"),
        ("v 0 0 nan\nf 1 1 1\n", r"expected finite points, found 1 others, the first at 0: \[0.0"),
        (f"{POINTS}vt nan 0\nf 1/1 2/1 3/1\n", "expected finite texture coordinates"),
    ],
)
def test_what_an_obj_cannot_be(reads: Reads, text: str, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        reads(text)


def test_a_colour_that_is_no_number_is_refused(reads: Reads) -> None:
    text = f"mtllib mesh.mtl\n{POINTS}usemtl a\nf 1 2 3\n"
    with pytest.raises(MeshError, match=r"mesh.mtl: a: expected a number behind Kd, found 'red'"):
        reads(text, mtl="newmtl a\nKd red 0 0\n")


# PLY.

HEAD = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {a}\n" for a in "xyz")
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
ROWS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


def binary(order: str, faces: list[list[int]]) -> bytes:
    name = {"<": "little", ">": "big"}[order]
    head = HEAD.replace("ascii", f"binary_{name}_endian") + FACES.replace(" 2", f" {len(faces)}")
    body = np.array(ROWS.split(), f"{order}f4").tobytes()
    for face in faces:
        body += bytes([len(face)]) + np.array(face, f"{order}i4").tobytes()
    return f"{head}end_header\n".encode() + body


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("faces", [[[0, 1, 2, 3]], [[0, 1, 2], [0, 2, 3]], [[0], [0, 1, 2, 3]]])
def test_polygons_of_any_size(reads: Reads, order: str, faces: list[list[int]]) -> None:
    mesh = reads(binary(order, faces), ".ply")
    assert mesh.pieces[0].corners.tolist() == [[0, 1, 2], [0, 2, 3]]
    few = [face for face in faces if len(face) < 3]
    assert mesh.left_out == ("faces of fewer than 3 corners (1): not drawn",) * len(few)


def test_polygons_of_any_size_as_text(reads: Reads) -> None:
    mesh = reads(f"{HEAD}{FACES}end_header\n{ROWS}3 0 1 2\n4 0 1 2 3\n", ".ply")
    assert mesh.pieces[0].corners.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(("kind", "most"), [("uchar", 255), ("ushort", 65535), ("float", 1)])
def test_vertex_colours_of_any_type(reads: Reads, kind: str, most: int) -> None:
    head = HEAD + "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{row} {most} {most / 5:g} 0\n" for row in ROWS.splitlines())
    rows = rows.replace(".0 ", " ")
    mesh = reads(f"{head}{FACES}end_header\n{rows}3 0 1 2\n3 0 2 3\n", ".ply")
    assert mesh.pieces[0].colours is not None
    assert mesh.pieces[0].colours.tolist() == [[255, 51, 0, 255]] * 4


@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_texture_coordinates_of_vertices(reads: Reads, tmp_path: Path, names: str) -> None:
    (tmp_path / "wall.png").write_bytes(kit.png(IMAGE))
    head = HEAD.replace("1.0\n", "1.0\ncomment TextureFile wall.png\n")
    head += "".join(f"property float {name}\n" for name in names.split())
    rows = "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n"
    mesh = reads(f"{head}{FACES}end_header\n{rows}3 0 1 2\n3 0 2 3\n", ".ply")
    (piece,) = mesh.pieces
    assert piece.places is not None
    assert piece.places.tolist() == [[0, 1], [1, 1], [1, 0], [0, 0]]
    assert mesh.materials[0].image is not None


def test_texture_coordinates_and_images_of_faces(reads: Reads, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").write_bytes(kit.png(IMAGE))
    head = HEAD.replace("1.0\n", "1.0\ncomment TextureFile a.png\ncomment TextureFile b.png\n")
    faces = f"{FACES}property list uchar float texcoord\nproperty int texnumber\nend_header\n"
    rows = "3 0 1 2 6 0 0 1 0 1 1 1\n3 0 2 3 6 .5 .5 1 1 0 1 0\n"
    mesh = reads(f"{head}{faces}{ROWS}{rows}", ".ply")
    assert [mesh.materials[piece.material].name for piece in mesh.pieces] == ["a.png", "b.png"]
    places = [
        piece.places[piece.corners].tolist() for piece in mesh.pieces if piece.places is not None
    ]
    assert places == [[[[0.5, 0.5], [1, 0], [0, 0]]], [[[0, 1], [1, 1], [1, 0]]]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plx", "expected a header of PLY, found b'plx'"),
        (f"{HEAD}end_header\n{ROWS}", "a cloud of 4 points without any: make a mesh of it first"),
        (f"{HEAD}property float f_dc_0\nend_header\n" + "1 2 3 4 " * 4, "found Gaussian splats"),
        (f"{HEAD}{FACES}end_header\n{ROWS}3 0 1 4\n3 0 1 2", "from 0 to 3, found 0 to 4"),
        (f"{HEAD}{FACES}end_header\n{ROWS}3 0 1 2\n", "expected 2 elements 'face', found the file"),
        (f"{HEAD}{FACES}end_header\n{ROWS}3 0 1 2\n9 0", "expected 2 elements 'face', found the f"),
        (f"{HEAD}{FACES}end_header\n0 0 0 hello", "below its header: expected numbers, found b'he"),
        (
            HEAD.replace("4", "4000000000") + "end_header\n1",
            "expected 4000000000 elements 'vertex'",
        ),
        (HEAD.replace("ascii", "utf8") + "end_header\n", "expected a format"),
        (HEAD.replace("float z", "vec z") + "end_header\n", "found 'property vec z'"),
        (HEAD.replace("float z", "float w") + "end_header\n" + ROWS, "vertices with x, y and z"),
        (binary("<", [[0, 1, 2]])[:-1], "expected 1 elements 'face', found .* the file is cut"),
        (binary("<", [[0, 1, 2]])[:-40], "expected 4 elements 'vertex', found .* the file is cut"),
    ],
)
def test_what_a_ply_cannot_be(reads: Reads, text: str | bytes, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        reads(text, ".ply")


# STL.


def test_a_binary_file_that_begins_with_solid(reads: Reads) -> None:
    data = b"solid" + kit.stl(kit.room())[5:]
    assert len(reads(data, ".stl").pieces[0].corners) == 22


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected STL: 84 bytes and 50 for each triangle.*found b''"),
        (kit.stl(kit.room())[:-1], "found a binary file of 1183 bytes"),
        (bytes(80) + b"\xff" * 4, "found a binary file of 84 bytes"),
        (b"solid\nvertex 1 2 3\n", "expected triangles, found 1 vertices"),
        (b"solid\nvertex 1 2 x\n", "behind vertex: expected numbers, found b'x'"),
        (b"solid\nendsolid\n", "expected triangles, found none"),
    ],
)
def test_what_an_stl_cannot_be(reads: Reads, data: bytes, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        reads(data, ".stl")
