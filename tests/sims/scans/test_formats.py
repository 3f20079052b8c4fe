"""The same room in every format is the same triangles, in the same colours."""

from pathlib import Path

import numpy as np
import pytest

from sims.scans.mesh_file import MeshFile
from sims.scans.reading import SUFFIXES, read
from tests.sims.scans import kit

SCENE = kit.room()
GLTF = {
    "u1.glb": {"index": "u1"},
    "u2.glb": {"index": "u2"},
    "u4.glb": {"index": "u4"},
    "none.glb": {"index": ""},
    "draco.glb": {"draco": True},
    "quantized.glb": {"quantized": True},
    "mirrored.glb": {"mirrored": True},
    "inside.gltf": {},
    "beside.gltf": {},
}
OTHERS = ["room.obj", "little.ply", "big.ply", "text.ply", "room.stl", "text.stl", "room.dae"]


def write(folder: Path, name: str) -> Path:
    path = folder / name
    if name in GLTF:
        made = kit.gltf(SCENE, **GLTF[name])  # type: ignore[arg-type]
        buffer = folder / "beside.bin" if name == "beside.gltf" else None
        path.write_bytes(made.glb() if path.suffix == ".glb" else made.gltf(buffer))
    elif path.suffix == ".obj":
        kit.write_obj(SCENE, path)
    elif path.suffix == ".ply":
        path.write_bytes(kit.ply(SCENE, {"little": "<", "big": ">", "text": "="}[path.stem]))
    elif path.suffix == ".stl":
        path.write_bytes(kit.stl(SCENE, text=path.stem == "text"))
    elif path.suffix == ".dae":
        (folder / "meshes").mkdir()
        path = folder / "meshes" / name
        kit.write_collada(SCENE, path)
    else:
        path = kit.write_world(SCENE, folder)
    return path


@pytest.mark.parametrize("name", [*GLTF, *OTHERS, "room.world"])
def test_a_room_has_the_same_triangles_and_colours(tmp_path: Path, name: str) -> None:
    mesh = read(write(tmp_path, name))
    triangles, colours = kit.soup(mesh)
    wanted, shades = kit.expected(SCENE)
    assert triangles.shape == wanted.shape
    assert np.abs(triangles - wanted).max() < 2e-4
    if not name.endswith(".stl"):
        assert np.abs(colours - shades).max() <= 1 / 255
    assert mesh.left_out in (
        (),
        ("primitives with texture coordinates and no image (1): drawn in their colour",),
    )
    assert names(mesh) == {
        "obj": {"walls", "floor", "box"},
        "glb": {"walls", "floor", "box"},
        "gltf": {"walls", "floor", "box"},
        "dae": {"walls", "floor", "box"},
        "world": {"hall"},
    }.get(name.rpartition(".")[2], {name.rpartition(".")[0]})


def names(mesh: MeshFile) -> set[str]:
    return {piece.object for piece in mesh.pieces}


@pytest.mark.parametrize("name", [*GLTF, "room.obj", "room.dae", "room.world"])
def test_normals_are_those_of_the_triangles(tmp_path: Path, name: str) -> None:
    mesh = read(write(tmp_path, name))
    for piece in mesh.pieces:
        assert piece.normals is not None
        a, b, c = (piece.points[piece.corners[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        for i in range(3):
            assert (normal * piece.normals[piece.corners[:, i]]).sum(axis=1).min() > 0.99


@pytest.mark.parametrize(
    ("name", "up", "unit"), [("u2.glb", "y", 1.0), ("room.dae", "y", 0.01), ("room.obj", "", 0.0)]
)
def test_the_axes_and_the_unit_are_told(tmp_path: Path, name: str, up: str, unit: float) -> None:
    mesh = read(write(tmp_path, name))
    assert (mesh.up, mesh.unit) == (up, unit)


def test_a_world_has_its_collisions_as_solids(tmp_path: Path) -> None:
    mesh = read(write(tmp_path, "room.world"))
    assert mesh.lit
    (solid,) = mesh.solids
    assert solid.object == "hall"
    assert np.allclose(solid.points.min(axis=0), (-2, -1.5, -0.05))
    assert np.allclose(solid.points.max(axis=0), (2, 1.5, 0.05))


@pytest.mark.parametrize("name", ["u2.glb", "room.obj", "little.ply", "room.stl", "room.dae"])
def test_the_same_file_gives_the_same_bytes(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name)
    for one, other in zip(read(path).pieces, read(path).pieces, strict=True):
        assert one.points.tobytes() == other.points.tobytes()
        assert one.corners.tobytes() == other.corners.tobytes()


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("u2.glb", {"u2.glb"}),
        ("beside.gltf", {"beside.gltf", "beside.bin"}),
        ("room.obj", {"room.obj", "room.mtl", "wall.png", "tiles.png"}),
        ("room.dae", {"room.dae", "wall.png", "tiles.png"}),
        ("room.world", {"room.world", "model.config", "model.sdf", "room.dae", "wall.png",
                        "tiles.png"}),
    ],
)  # fmt: skip
def test_all_files_that_a_mesh_is_of_are_named(tmp_path: Path, name: str, files: set[str]) -> None:
    path = write(tmp_path, name)
    sources = read(path).sources
    assert sources[0] == path
    assert {source.name for source in sources} == files
    assert all(source.is_file() for source in sources)


def test_a_suffix_may_be_in_capitals(tmp_path: Path) -> None:
    path = tmp_path / "ROOM.STL"
    path.write_bytes(kit.stl(SCENE))
    assert len(read(path).pieces[0].corners) == 22
    assert all(suffix == suffix.lower() for suffix in SUFFIXES)
