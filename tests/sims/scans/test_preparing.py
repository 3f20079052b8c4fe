"""A mesh file made ready for a world: its place, its parts, what of it is solid and baked."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sims.scans.mesh_file import Material, MeshError, MeshFile, Piece
from sims.scans.preparing import MOST_OBJECTS, MOST_TRIANGLES, prepare
from sims.scans.settings import MeshSpec

QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def quad(name: str = "floor", z: float = 0.0, size: float = 4.0, **fields: object) -> Piece:
    """Return a square that faces up, z up."""
    points = np.array([[0, 0, z], [size, 0, z], [size, size, z], [0, size, z]], np.float64)
    return Piece(name, 0, points, QUAD)._replace(**fields)  # type: ignore[arg-type]


def file_of(*pieces: Piece, **fields: object) -> MeshFile:
    return MeshFile(pieces, (Material(),))._replace(**fields)  # type: ignore[arg-type]


def sheet(cells: int, name: str = "sheet") -> Piece:
    """Return a level square of 2 × cells² triangles, a metre each."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(cells + 1.0)] * 2))
    at = np.arange(len(x)).reshape(cells + 1, cells + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    corners = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return Piece(name, 0, np.stack([x, y, 0.0 * x], 1), corners)


@pytest.mark.parametrize(
    ("up", "north_west_up"),
    [("x", (2.0, 3.0, 1.0)), ("y", (1.0, -3.0, 2.0)), ("z", (1.0, 2.0, 3.0))],
)
def test_the_axis_that_points_up_is_that_of_the_file_or_the_setting(
    up: str, north_west_up: tuple[float, ...]
) -> None:
    piece = quad()
    far = piece._replace(points=np.vstack([piece.points * 0.1, [[1.0, 2.0, 3.0]]]))
    corners = np.array([[0, 1, 4]], np.int32)
    by_file = prepare(file_of(far._replace(corners=corners), up=up), MeshSpec(solid="none"))
    by_setting = prepare(file_of(far._replace(corners=corners)), MeshSpec(up=up, solid="none"))  # type: ignore[arg-type]
    for prepared in (by_file, by_setting):
        assert north_west_up in [tuple(p) for p in prepared.parts[0].points.round(5).tolist()]


def test_unit_position_and_heading_place_the_origin() -> None:
    spec = MeshSpec(unit="cm", position=(10.0, 5.0, -2.0), heading=90.0, solid="none")
    prepared = prepare(file_of(quad(size=100.0)), spec)
    # x, which was north, now points east, and y, which was west, north; NWU.
    np.testing.assert_allclose(prepared.extent, [[10, -6, 2], [11, -5, 2]], atol=1e-9)
    same = prepare(file_of(quad(size=100.0), unit=0.01), MeshSpec(solid="none"))
    np.testing.assert_allclose(same.extent, [[0, 0, 0], [1, 1, 0]], atol=1e-9)


@pytest.mark.parametrize("cells", [1, 44, 45, 90])
def test_parts_are_small_and_hold_each_triangle_once(cells: int) -> None:
    piece = sheet(cells)
    parts = prepare(file_of(piece), MeshSpec(solid="none")).parts
    assert all(0 < len(part.corners) <= MOST_TRIANGLES for part in parts)
    assert [part.name for part in parts] == [f"sheet.chunk{k}" for k in range(len(parts))]

    def sums(points: Any, corners: Any) -> list[Any]:
        return sorted(points[corners].sum(axis=1).tolist())

    assert sorted(s for p in parts for s in sums(p.points, p.corners)) == sums(*piece[2:4])


def test_triangles_without_area_are_left_out_and_an_object_of_them_has_no_part() -> None:
    flat = quad("flat")._replace(corners=np.array([[0, 0, 1], [1, 1, 1]], np.int32))
    parts = prepare(file_of(quad(), flat), MeshSpec(solid="none")).parts
    assert [part.name for part in parts] == ["floor.chunk0"]


def test_names_of_objects_are_told_apart_and_can_be_names_of_geoms() -> None:
    names = ["a b/c", "a_b_c", "", "ü"]
    parts = prepare(file_of(*(quad(n) for n in names)), MeshSpec(solid="none")).parts
    assert [p.name for p in parts] == [
        "a_b_c.chunk0", "a_b_c_2.chunk0", "object.chunk0", "ü.chunk0",
    ]  # fmt: skip


def test_of_too_many_objects_the_smallest_become_one() -> None:
    pieces = [quad(f"o{k}", z=0.01 * k) for k in range(MOST_OBJECTS + 3)]
    prepared = prepare(file_of(sheet(2, "large"), *pieces), MeshSpec(solid="none"))
    names = {part.name.partition(".chunk")[0] for part in prepared.parts}
    assert len(names) == MOST_OBJECTS
    assert {"large", "rest"} <= names
    assert any("smallest" in note for note in prepared.notes)


def test_normals_of_a_file_without_any_are_those_of_its_surface() -> None:
    parts = prepare(file_of(sheet(3)), MeshSpec(solid="none")).parts
    np.testing.assert_allclose(parts[0].normals, np.tile([0, 0, 1], (16, 1)), atol=1e-6)


NORMALS = np.tile(np.array([0, 0, 1], np.float32), (4, 1))


@pytest.mark.parametrize(
    ("piece", "fields", "light", "baked"),
    [
        (quad(), {}, "auto", False),
        (quad(colours=np.full((4, 4), 9, np.uint8)), {}, "auto", True),
        (quad(normals=NORMALS), {}, "auto", False),
        (quad(), {"lit": True}, "auto", False),
        (quad(normals=NORMALS), {"materials": (Material(unlit=True),)}, "auto", True),
        (quad(), {}, "lit", False),
        (quad(normals=NORMALS), {}, "baked", True),
    ],
)
def test_light_is_baked_if_the_file_or_the_setting_says_so(
    piece: Piece, fields: dict[str, object], light: str, baked: bool
) -> None:
    spec = MeshSpec(light=light, solid="none")  # type: ignore[arg-type]
    assert prepare(file_of(piece, **fields), spec).baked is baked


def test_a_plane_stands_for_level_ground_and_no_box_above_it() -> None:
    table = quad("table", z=0.8, size=1.0)
    prepared = prepare(file_of(quad(z=0.25), table), MeshSpec())
    assert prepared.floor == pytest.approx(0.25)
    assert len(prepared.boxes) == 1
    assert prepared.boxes[0, 2] > 0.6
    without = prepare(file_of(quad(z=0.25)), MeshSpec(floor="none"))
    assert without.floor is None
    assert len(without.boxes) == 1
    assert prepare(file_of(quad()), MeshSpec(floor=-1.0)).floor == -1.0


def test_a_table_in_a_room_is_no_ground() -> None:
    wall = quad("wall")._replace(points=np.array([[0, 0, 0], [9, 9, 0], [9, 9, 3], [0, 0, 3.0]]))
    prepared = prepare(file_of(wall, quad("table", z=0.8, size=1.0)), MeshSpec())
    assert prepared.floor is None


def test_a_wrong_unit_is_told_with_the_voxels_that_it_would_take() -> None:
    wall = quad("wall")._replace(points=np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1.0]]))
    with pytest.raises(MeshError, match=r"is the unit wrong\? The mesh is 5000 m long"):
        prepare(file_of(wall), MeshSpec(unit=5000.0))


def test_no_level_ground_is_said() -> None:
    wall = quad()._replace(points=np.array([[0, 0, 0], [4, 0, 0], [4, 0, 3], [0, 0, 3.0]]))
    prepared = prepare(file_of(wall), MeshSpec())
    assert prepared.floor is None
    assert any(note.startswith("floor: there is no plane") for note in prepared.notes)


def test_collision_shapes_of_the_file_are_solid_instead_of_what_is_drawn() -> None:
    shape = quad("shape", z=1.0, size=1.0)
    file = file_of(quad(), solids=(shape,))
    assert len(prepare(file, MeshSpec()).boxes) == 1
    hulls = prepare(file, MeshSpec(solid="hulls")).hulls
    assert [part.name for part in hulls] == ["shape.chunk0"]
    second = file_of(quad("own"))
    assert [p.name for p in prepare(file, MeshSpec(solid="x.obj"), second).hulls] == ["own.chunk0"]


def test_a_mesh_far_from_the_origin_is_refused_with_the_position_that_brings_it_near() -> None:
    piece = quad()
    utm = piece._replace(points=piece.points + np.array((500_000.0, 5_400_000.0, 300.0)))
    with pytest.raises(
        MeshError, match=r"within 20 km.*position = \[-500002.0, 5400002.0, 300.0\]"
    ):
        prepare(file_of(utm), MeshSpec())
    near = prepare(file_of(utm), MeshSpec(position=(-500_002.0, 5_400_002.0, 300.0)))
    np.testing.assert_allclose(near.extent, [[-2, -2, 0], [2, 2, 0]], atol=1e-9)


@pytest.mark.parametrize("size", [0.3, 4000.0])
def test_an_odd_size_is_told_with_the_units(size: float) -> None:
    prepared = prepare(file_of(quad(size=size)), MeshSpec(solid="none", floor="none"))
    assert any(note.startswith("unit: the mesh is") for note in prepared.notes)


PLACES = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


def test_images_are_fitted_and_see_through_ones_are_cut() -> None:
    image = np.zeros((64, 32, 4), np.uint8)
    image[:32] = 255
    material = Material(image=image, blend=True)
    file = file_of(quad(places=PLACES), materials=(material,))
    prepared = prepare(file, MeshSpec(solid="none", texture_size=16))
    (drawn,) = prepared.materials
    assert drawn.image is not None
    assert drawn.image.shape == (16, 8, 4)
    assert drawn.cutoff == 0.5
    assert sorted(note.split()[1] for note in prepared.notes) == ["images", "images"]
    opaque = file_of(quad(places=PLACES), materials=(Material(image=image),))
    (plain,) = prepare(opaque, MeshSpec(solid="none")).materials
    assert plain.image is not None
    assert plain.image.shape == (64, 32, 3)


def test_an_image_without_places_is_not_drawn() -> None:
    material = Material(image=np.zeros((4, 4, 3), np.uint8))
    (drawn,) = prepare(file_of(quad(), materials=(material,)), MeshSpec(solid="none")).materials
    assert drawn.image is None


def test_vertices_that_a_part_lacks_take_no_room() -> None:
    piece = sheet(60)
    parts = prepare(file_of(piece), MeshSpec(solid="none")).parts
    assert len(parts) == 2
    assert sum(len(part.points) for part in parts) < len(piece.points) * 1.1
    assert math.isclose(float(max(p.points.max() for p in parts)), 60.0)


def test_an_image_of_two_materials_is_prepared_once() -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    pieces = quad(places=PLACES), quad("other", z=1.0, places=PLACES, material=1)
    materials = (Material("a", image=image), Material("b", image=image))
    first, second = prepare(file_of(*pieces, materials=materials), MeshSpec(solid="none")).materials
    assert first.image is second.image is not None


def test_a_ground_of_kilometres_is_a_plane_and_no_voxels() -> None:
    prepared = prepare(file_of(quad(size=2000.0), quad("table", z=0.8, size=1.0)), MeshSpec())
    assert prepared.floor == 0.0
    assert len(prepared.boxes) == 1
