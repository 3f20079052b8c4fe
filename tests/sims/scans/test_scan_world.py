"""The world of a mesh: what is drawn, what is solid, and who flies in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from runtime.config.model import Config, RunConfig
from runtime.errors import NodeError
from runtime.testing import run_nodes, spec
from runtime.tools.preflight import of_nodes
from sims.cameras import CameraSpec, add_free_camera, pose_to_qpos
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import View, object_numbers
from sims.multirotor import Multirotor
from sims.scans.mesh_file import Material, MeshError, MeshFile
from sims.scans.preparing import prepare
from sims.scans.settings import MeshSpec
from sims.scans.world import build, mesh_world, prepared_mesh
from sims.vehicle import STANDING_HEIGHT, attach_vehicle
from sims.vehicle.autopilot import Clearance, trouble_at_start
from sims.worlds import WorldError, load_scene
from tests.sims.scans.test_preparing import NORMALS, PLACES, file_of, quad, sheet

CAMERA = CameraSpec(name="camera", width=64, height=48, position=(0.0, 0.0, 0.0))
OUTWARDS = ("1243", "5786", "1562", "3487", "1375", "2684")
FACES = {"table": OUTWARDS, "room": tuple(face[::-1] for face in OUTWARDS)}


def write_room(path: Path) -> Path:
    """Write a room of 8 × 6 × 3 m, seen from inside, with a table; y up, as OBJ."""
    lines, number = [], 0
    boxes = {"room": ((-4, -3, 0), (4, 3, 3)), "table": ((1.0, 1.0, 0.0), (2.0, 2.0, 0.8))}
    for name, (low, high) in boxes.items():
        lines.append(f"o {name}")
        for x in (low[0], high[0]):
            for y in (low[1], high[1]):
                lines += [f"v {x} {z} {-y}" for z in (low[2], high[2])]  # y up
        lines += [" ".join(["f", *(str(number + int(at)) for at in face)]) for face in FACES[name]]
        number += 8
    path.write_text("\n".join(lines))
    return path


def test_parts_of_an_object_are_drawn_and_have_one_number() -> None:
    model = build(prepare(file_of(sheet(60), quad("table", z=1.0)), MeshSpec()), "x").compile()
    drawn = np.flatnonzero(model.geom_group < 3)
    assert [model.geom(g).name for g in drawn] == ["sheet.chunk0", "sheet.chunk1", "table.chunk0"]
    numbers = object_numbers(model)[drawn]
    assert numbers[0] == numbers[1] != numbers[2]
    assert not model.geom_contype[drawn].any()
    assert not model.geom_conaffinity[drawn].any()


def test_points_stay_where_the_file_has_them() -> None:
    prepared = prepare(file_of(sheet(30)), MeshSpec())
    model = build(prepared, "x").compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turn = data.geom_xmat[0].reshape(3, 3)
    np.testing.assert_allclose(
        model.mesh_vert @ turn.T + data.geom_xpos[0], prepared.parts[0].points, atol=1e-5
    )


def test_a_part_of_one_triangle_is_drawn() -> None:
    piece = quad()._replace(corners=np.array([[0, 1, 2]], np.int32))
    model = build(prepare(file_of(piece), MeshSpec()), "x").compile()
    assert model.mesh_facenum.tolist() == [1]


def test_a_coloured_part_of_one_triangle_is_drawn_in_its_colours() -> None:
    """MuJoCo is given a vertex more, which needs a colour, too."""
    colours = np.tile(np.array([200, 40, 90, 255], np.uint8), (4, 1))
    piece = quad(colours=colours)._replace(corners=np.array([[0, 1, 2]], np.int32))
    for solid in ("voxels", "hulls"):
        spec = build(prepare(file_of(piece), MeshSpec(solid=solid)), "x", solid)
        add_free_camera(spec, "eye", (CAMERA,))
        raster = Raster(spec.compile())
        raster.look(0, pose_to_qpos((2.0, -1.0, -3.0), from_rpy(0.0, -np.pi / 2, 0.0)))
        image = raster.draw(View(camera_info(CAMERA)), True, False, False).colours
        raster.close()
        assert image is not None
        assert (image == (200, 40, 90)).all(axis=2).any()


def test_materials_have_colour_image_and_the_marks_of_the_rasteriser() -> None:
    image = np.full((4, 4, 4), 255, np.uint8)
    leaf = Material("leaf", (0.5, 0.25, 0.125, 0.5), image, 0.3, False, True)
    glass = Material("glass", (1.0, 1.0, 1.0, 0.25), blend=True)
    colours = np.full((4, 4), 7, np.uint8)
    pieces = quad("leaf", places=PLACES, colours=colours), quad("glass", z=1.0, material=1)
    model = build(prepare(MeshFile(pieces, (leaf, glass)), MeshSpec()), "x").compile()
    np.testing.assert_allclose(model.mat_rgba, [[0.5, 0.25, 0.125, 1.0], [1, 1, 1, 0.25]])
    np.testing.assert_allclose(model.geom_user[:2], [[1.0, 0.3], [0.0, 0.0]])
    assert bytes(model.text_data).rstrip(b"\0") == b"double_sided alpha_cutoff"
    names = [model.texture(k).name for k in range(model.ntex)]
    assert sorted(names) == ["leaf.chunk0.colours", "m0", "sky"]
    assert model.mat_texid[0, 1] == names.index("m0")
    assert model.tex_nchannel[names.index("m0")] == 4


@pytest.mark.parametrize("light", ["baked", "lit"])
def test_baked_images_are_not_lit(light: str) -> None:
    spec = MeshSpec(light=light)  # type: ignore[arg-type]
    model = build(prepare(file_of(quad(normals=NORMALS)), spec), "x").compile()
    assert (model.mat_emission[0] == 1.0) == (light == "baked")
    assert (model.vis.headlight.ambient == 0.0).all() == (light == "baked")
    assert model.nlight == (light == "lit")


def test_what_is_solid_is_a_setting() -> None:
    prepared = {
        s: prepare(file_of(sheet(4)), MeshSpec(solid=s)) for s in ("voxels", "hulls", "none")
    }
    models = {s: build(p, "x", s).compile() for s, p in prepared.items()}
    met = {s: int((m.geom_contype != 0).sum()) for s, m in models.items()}
    assert met == {"voxels": 1, "hulls": 2, "none": 1}  # with the ground's plane
    other = prepare(file_of(sheet(4)), MeshSpec(solid="a.obj"), file_of(quad("own")))
    model = build(other, "x", "a.obj").compile()
    assert model.geom("solid.own.chunk0").contype[0] == 1


def test_bare_worlds_have_only_what_is_solid() -> None:
    model = build(prepare(file_of(sheet(4)), MeshSpec()), "x", bare=True).compile()
    assert [model.geom(g).name for g in range(model.ngeom)] == ["floor"]
    hulls = build(prepare(file_of(sheet(4)), MeshSpec(solid="hulls")), "x", "hulls", bare=True)
    assert hulls.compile().nmesh == 1


def test_a_vehicle_meets_walls_and_things_of_a_mesh(tmp_path: Path) -> None:
    room = write_room(tmp_path / "room.obj")
    scene = load_scene(room, mesh=MeshSpec(up="y"), bare=True)
    start = (0.0, 0.0, -STANDING_HEIGHT)
    attach_vehicle(scene.spec, "drone", start, 0.0)
    clearance = Clearance(scene.spec.compile(), "drone")
    assert trouble_at_start(clearance, start) == ""
    assert "solid" in trouble_at_start(clearance, (1.5, -1.5, -0.75))  # in the table's top
    assert "solid" in clearance.between((0.0, 0.0, -1.5), (0.0, 9.0, -1.5))
    assert clearance.between((0.0, 0.0, -1.5), (3.5, -2.5, -1.5)) == ""  # above the table


def test_what_is_not_drawn_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    room = write_room(tmp_path / "room.obj")
    mesh_world(room, MeshSpec(up="y", unit=0.01))
    assert sum("unit: the mesh is 0.08 m long" in r.message for r in caplog.records) == 1


@pytest.mark.parametrize(
    ("name", "solid", "error"),
    [
        ("none.glb", "voxels", "expected a mesh file, found nothing"),
        ("", "voxels", "expected a mesh file, found a directory"),
        ("room.obj", "boxes", 'solid: expected "voxels", "hulls", "none" or a mesh file, found'),
        ("room.obj", "none.obj", "none.obj: expected"),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path: Path, name: str, solid: str, error: str) -> None:
    write_room(tmp_path / "room.obj")
    with pytest.raises(MeshError, match=error):
        prepared_mesh(tmp_path / name, MeshSpec(solid=solid))


def test_settings_of_a_mesh_beside_another_world_are_refused() -> None:
    with pytest.raises(WorldError, match='mesh: expected a mesh file as the world, found "hall"'):
        load_scene("hall", mesh=MeshSpec(voxel=0.2))


@pytest.mark.parametrize("second", [{"mesh": {"up": "y", "heading": 90}}, {}, {"world": ""}])
def test_nodes_of_one_world_agree_on_its_mesh(tmp_path: Path, second: dict[str, Any]) -> None:
    room = str(write_room(tmp_path / "room.obj"))
    first = {"world": room, "mesh": {"up": "y"}}
    other = {"world": room, "position": [1.0, 0.0], **second}
    nodes = (spec(Multirotor, "a", first), spec(Multirotor, "b", other))
    if second == {"world": ""}:
        assert not of_nodes(Config(run=RunConfig(), nodes=nodes)).errors
    else:
        with pytest.raises(NodeError, match="mesh: expected the settings of a, which names"):
            run_nodes(nodes, duration=0.01)


def test_a_world_by_suffix_is_a_mesh_and_its_error_a_world_error(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"world: .*none.glb: expected a mesh file, found nothing"):
        load_scene(str(tmp_path / "none.glb"))
    scene = load_scene(write_room(tmp_path / "room.obj"), mesh=MeshSpec(up="y"), bare=True)
    assert scene.spec.geom("floor") is not None
