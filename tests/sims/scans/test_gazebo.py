"""Gazebo's worlds: where models and their meshes stand, and what of them is refused or told."""

from pathlib import Path

import numpy as np
import pytest

from sims.scans.mesh_file import MeshError, MeshFile
from sims.scans.reading import read
from tests.sims.scans import kit

BOX = "<geometry><box><size>1 1 1</size></box></geometry>"

RELATIVE = "<pose relative_to='f'>0 1 0 0 0 0</pose>"
RELATIVE_TO_J = "<pose relative_to='j'>0 1 0 0 0 0</pose>"


def link(content: str = BOX, pose: str = "", name: str = "l") -> str:
    return f"<link name='{name}'>{pose}<visual name='v'>{content}</visual></link>"


def world(folder: Path, content: str) -> MeshFile:
    path = folder / "test.world"
    path.write_text(f"<sdf version='1.7'><world name='w'>{content}</world></sdf>")
    return read(path)


def middle(mesh: MeshFile) -> list[float]:
    points = np.concatenate([piece.points for piece in mesh.pieces])
    return [round(float(value), 6) for value in (points.min(axis=0) + points.max(axis=0)) / 2]


# Poses.


@pytest.mark.parametrize(
    ("model", "where"),
    [
        (link(pose="<pose>1 2 3 0 0 0</pose>"), [1, 2, 3]),
        (f"<pose>0 0 1 0 0 1.5707963267948966</pose>{link(pose='<pose>2 0 0 0 0 0</pose>')}",
         [0, 2, 1]),
        (f"<pose degrees='true'>0 0 0 0 90 0</pose>{link(pose='<pose>2 0 0 0 0 0</pose>')}",
         [0, 0, -2]),
        (f"<pose degrees='1'>0 0 0 90 0 90</pose>{link(pose='<pose>0 2 0 0 0 0</pose>')}",
         [0, 0, 2]),
        ("<pose rotation_format='quat_xyzw'>0 0 5 0 0 0.7071068 0.7071068</pose>"
         f"{link(pose='<pose>1 0 0 0 0 0</pose>')}", [0, 1, 5]),
        (f"<frame name='f'><pose>1 0 0 0 0 0</pose></frame>{link(pose=RELATIVE)}", [1, 1, 0]),
        # A joint of a link's name, as PX4's rover has it.
        (f"{link(pose=RELATIVE)}<link name='f'><pose>0 0 2 0 0 0</pose></link>"
         "<joint name='f'><child>f</child></joint>", [0, 1, 2]),
        # A prefix that is not bound, as PX4's optical flow has it.
        (f"{link()}<gz:system gz:a='1'><gz:b/></gz:system>", [0, 0, 0]),
        ("<frame name='f' attached_to='g'><pose>1 0 0 0 0 0</pose></frame>"
         "<frame name='g'><pose>0 0 7 0 0 0</pose></frame>"
         "<joint name='j'><child>f</child><pose>0 2 0 0 0 0</pose></joint>"
         f"{link(pose=RELATIVE_TO_J)}", [1, 3, 7]),
        (f"<model name='inner'><pose>1 0 0 0 0 0</pose>{link()}</model>", [1, 0, 0]),
        (link(f"<pose relative_to='__model__'>4 0 0 0 0 0</pose>{BOX}", "<pose>9 9 9 0 0 0</pose>"),
         [4, 0, 0]),
        (link(f"<pose>4 0 0 0 0 0</pose>{BOX}", "<pose frame=''>9 9 9 0 0 0</pose>"), [13, 9, 9]),
    ],
)  # fmt: skip
def test_poses_in_each_other(tmp_path: Path, model: str, where: list[float]) -> None:
    mesh = world(tmp_path, f"<model name='m'><static>true</static>{model}</model>")
    assert middle(mesh) == where
    assert {piece.object for piece in mesh.pieces} == {"m"}


def test_two_models_of_one_name_are_two_objects(tmp_path: Path) -> None:
    mesh = world(tmp_path, f"<model name='m'>{link()}</model>" * 2)
    assert [piece.object for piece in mesh.pieces] == ["m", "m_2"]
    assert mesh.left_out == ("models that are not static (2): they stand still",)


# Shapes.


@pytest.mark.parametrize(
    ("shape", "extent", "volume"),
    [
        ("<box><size>1 2 3</size></box>", (1, 2, 3), 6.0),
        ("<sphere><radius>2</radius></sphere>", (4, 4, 4), 4 / 3 * np.pi * 8),
        ("<ellipsoid><radii>1 2 3</radii></ellipsoid>", (2, 4, 6), 4 / 3 * np.pi * 6),
        ("<cylinder><radius>1</radius><length>3</length></cylinder>", (2, 2, 3), np.pi * 3),
        ("<capsule><radius>1</radius><length>3</length></capsule>", (2, 2, 5),
         np.pi * 3 + 4 / 3 * np.pi),
        ("<plane><normal>0 0 1</normal><size>4 6</size></plane>", (4, 6, 0), 0.0),
        ("<plane><normal>0 1 0</normal><size>4 6</size></plane>", (4, 0, 6), 0.0),
    ],
)  # fmt: skip
def test_shapes_have_their_size_and_face_outwards(
    tmp_path: Path, shape: str, extent: tuple[float, ...], volume: float
) -> None:
    (piece,) = world(tmp_path, f"<model>{link(f'<geometry>{shape}</geometry>')}</model>").pieces
    points, corners = piece.points, piece.corners
    size = points.max(axis=0) - points.min(axis=0)
    assert sorted(size) == pytest.approx(sorted(extent), abs=1e-9)
    a, b, c = (points[corners[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=0.03)
    assert piece.normals is not None
    assert (normal * piece.normals[corners].sum(axis=1)).sum(axis=1).min() > 0


# Meshes and looks.


def mesh_of(folder: Path, more: str = "", visual: str = "", name: str = "room.obj") -> MeshFile:
    if not (folder / name).exists():
        kit.write_obj(kit.room(), folder / name)
    geometry = f"<geometry><mesh><uri>{name}</uri>{more}</mesh></geometry>{visual}"
    return world(folder, f"<model><static>1</static>{link(geometry)}</model>")


def test_a_mesh_is_scaled_and_mirrored(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, "<scale>-2 1 1</scale>")
    walls = next(p for p in mesh.pieces if len(p.corners) == 8)
    assert walls.points.max(axis=0).tolist() == [4, 1.5, 2.5]
    a, b, c = (walls.points[walls.corners[:, i]] for i in range(3))
    towards = -(a + b + c) / 3 * (1, 1, 0)
    assert (np.cross(b - a, c - a) * towards).sum(axis=1).min() > 0  # seen from inside


def test_the_unit_of_collada_is_applied_and_its_axis_is_not(tmp_path: Path) -> None:
    kit.write_collada(kit.room(), tmp_path / "room.dae", "textures")
    mesh = mesh_of(tmp_path, name="room.dae")
    size = np.concatenate([piece.points for piece in mesh.pieces]).max(axis=0)
    assert size == pytest.approx((2, 2.5, 1.5))


def test_a_submesh_may_be_centred(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, "<submesh><name>box</name><center>1</center></submesh>")
    (piece,) = mesh.pieces
    assert np.abs(piece.points).max() == pytest.approx(0.25)
    with pytest.raises(MeshError, match=r"a submesh of room.obj \(box, floor, walls\), found 'x'"):
        mesh_of(tmp_path, "<submesh><name>x</name></submesh>")


def test_a_visuals_colour_replaces_that_of_a_mesh_but_no_image(tmp_path: Path) -> None:
    diffuse = "<material><diffuse>0 0 1 1</diffuse><double_sided>1</double_sided></material>"
    mesh = mesh_of(tmp_path, visual=diffuse)
    looks = [mesh.materials[piece.material] for piece in mesh.pieces]
    assert [(look.colour[:3], look.image is not None) for look in looks] == [
        ((1, 1, 1), True),
        ((1, 1, 1), True),
        ((0, 0, 1), False),
    ]
    assert all(look.double_sided for look in looks)


def test_a_visual_may_be_transparent(tmp_path: Path) -> None:
    content = f"{BOX}<transparency>0.75</transparency>"
    look = world(tmp_path, f"<model>{link(content)}</model>").materials[0]
    assert (look.colour[3], look.blend) == (0.25, True)


def test_an_albedo_map_is_an_image(tmp_path: Path) -> None:
    image = np.full((2, 2, 3), 7, np.uint8)
    (tmp_path / "a.png").write_bytes(kit.png(image))
    pbr = "<material><pbr><metal><albedo_map>a.png</albedo_map></metal></pbr></material>"
    look = world(tmp_path, f"<model>{link(BOX + pbr)}</model>").materials[0]
    assert look.image is not None
    assert np.array_equal(look.image, image)


SCRIPT = """
import * from "common.material"
material crate/other { technique { pass { diffuse 1 0 0 } } }
// material crate/wood { }
material crate/wood : parent
{
  technique { pass { ambient 0.1 0.1 0.1 1
      diffuse 0.25 0.5 2.0 1.0
      texture_unit { texture wood.png
        scale 1 1 } } }
}
material crate/last { technique { pass { diffuse 0 1 0 } } }
"""


@pytest.mark.parametrize(
    ("name", "colour", "image"),
    [
        ("crate/wood", (1, 1, 1, 1), True),
        ("crate/other", (1, 0, 0, 1), False),
        ("crate/last", (0, 1, 0, 1), False),
    ],
)
@pytest.mark.parametrize("folder", [True, False])
def test_material_scripts(
    tmp_path: Path, name: str, colour: tuple[float, ...], image: bool, folder: bool
) -> None:
    scripts, textures = (tmp_path / "crate" / "materials" / n for n in ("scripts", "textures"))
    scripts.mkdir(parents=True)
    textures.mkdir()
    (scripts / "crate.material").write_text(SCRIPT)
    (textures / "wood.png").write_bytes(kit.png(np.zeros((2, 2, 3), np.uint8)))
    uri = "model://crate/materials/scripts"
    uris = [uri, "model://crate/materials/textures"] if folder else [f"{uri}/crate.material"]
    tags = "".join(f"<uri>{uri}</uri>" for uri in uris)
    script = f"<material><script>{tags}<name>{name}</name></script></material>"
    mesh = world(tmp_path, f"<model><static>1</static>{link(BOX + script)}</model>")
    assert mesh.materials[0].colour == colour
    assert (mesh.materials[0].image is not None) == image
    assert mesh.left_out == ()


def test_gazebos_own_colours_need_no_script(tmp_path: Path) -> None:
    script = "<material><script><name>Gazebo/Orange</name></script></material>"
    mesh = world(tmp_path, f"<model><static>1</static>{link(BOX + script)}</model>")
    assert mesh.materials[0].colour == (1.0, 0.5088, 0.0468, 1.0)
    assert mesh.left_out == ()


def test_shapes_are_filled_by_their_image(tmp_path: Path) -> None:
    plane = "<geometry><plane><normal>0 0 1</normal><size>4 6</size></plane></geometry>"
    (piece,) = world(tmp_path, f"<model>{link(plane)}</model>").pieces
    assert piece.places is not None
    corners = {
        (*point[:2], *place)
        for point, place in zip(piece.points.tolist(), piece.places.tolist(), strict=True)
    }
    assert corners == {(-2, -3, 0, 1), (2, -3, 1, 1), (2, 3, 1, 0), (-2, 3, 0, 0)}


# Models of other files.


def save_model(folder: Path, name: str = "crate") -> None:
    (folder / name).mkdir(parents=True)
    text = f"<sdf><model name='{name}'><static>1</static>{link()}</model></sdf>"
    (folder / name / "model.sdf").write_text(text)


INCLUDE = "<include><uri>model://crate</uri><name>c</name><pose>1 2 3 0 0 0</pose></include>"


@pytest.mark.parametrize("place", [".", "models", "..", "../models"])
@pytest.mark.parametrize("scheme", ["model://", ""])
def test_models_are_found_around_the_world(tmp_path: Path, place: str, scheme: str) -> None:
    folder = tmp_path / "worlds"
    folder.mkdir()
    save_model(folder / place)
    mesh = world(folder, INCLUDE.replace("model://", scheme))
    assert middle(mesh) == [1, 2, 3]
    assert mesh.pieces[0].object == "c"


@pytest.mark.parametrize("variable", ["GAZEBO_MODEL_PATH", "GZ_SIM_RESOURCE_PATH"])
def test_models_are_found_in_gazebos_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    save_model(tmp_path / "elsewhere")
    (tmp_path / "worlds").mkdir()
    monkeypatch.setenv(variable, f"/nowhere:{tmp_path / 'elsewhere'}")
    assert middle(world(tmp_path / "worlds", INCLUDE)) == [1, 2, 3]


def test_models_of_gazebos_server_are_found_where_they_are_downloaded_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    address = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Oak Tree"
    include = f"<include><uri>{address}</uri></include>"
    with pytest.raises(MeshError, match=f"found none: gz fuel download -u '{address}'"):
        world(tmp_path, include)
    folder = tmp_path / ".gz" / "fuel" / "fuel.gazebosim.org" / "openrobotics" / "models"
    for version in ("2", "10"):
        save_model(folder / "oak tree", version)
    assert world(tmp_path, include).pieces[0].object == "10"
    mesh = f"<geometry><mesh><uri>{address}/1/files/a/room.obj</uri></mesh></geometry>"
    (folder / "oak tree" / "10" / "a").mkdir()
    kit.write_obj(kit.room(), folder / "oak tree" / "10" / "a" / "room.obj")
    assert len(world(tmp_path, f"<model>{link(mesh)}</model>").pieces) == 3


def test_a_models_file_is_a_world_too(tmp_path: Path) -> None:
    save_model(tmp_path)
    assert [piece.object for piece in read(tmp_path / "crate" / "model.sdf").pieces] == ["crate"]


def test_gazebos_own_models_need_no_folder(tmp_path: Path) -> None:
    includes = "".join(
        f"<include><uri>{uri}</uri></include>"
        for uri in (
            "model://sun",
            "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Ground Plane",
        )
    )
    mesh = world(tmp_path, includes)
    assert mesh.lit
    assert np.ptp(mesh.pieces[0].points, axis=0).tolist() == [100, 100, 0]
    assert len(mesh.solids) == 1


def test_all_that_is_missing_is_named(tmp_path: Path) -> None:
    geometry = "<geometry><mesh><uri>model://a/b.dae</uri></mesh></geometry>"
    with pytest.raises(MeshError, match=r"expected model://crate, model://a/b.dae beside it, in"):
        world(tmp_path, f"{INCLUDE}<model name='m'>{link(geometry)}</model>")


def test_what_is_not_read_is_told(tmp_path: Path) -> None:
    script = "<material><script><name>Gazebo/Wood</name></script></material>"
    heights = "<geometry><heightmap/></geometry>"
    collision = f"<link name='x'><collision name='c'>{heights}</collision><sensor/></link>"
    mesh = world(
        tmp_path,
        f"<actor/><plugin/><state/><model><static>1</static>{link(BOX + script)}"
        f"{link(heights, name='k')}{collision}</model>",
    )
    assert mesh.left_out == (
        "actors (1): not read",
        "drawn heightmaps (1): not read",
        "material script Gazebo/Wood (1): not found; drawn in its own colour",
        "plugins (1): not read",
        "saved states (1): not read",
        "sensors (1): not read",
        "solid heightmaps (1): not read",
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (f"<model>{link(pose=RELATIVE)}</model>", "is relative to 'f': expected one of l in the "),
        (f"<model><frame name='f' attached_to='f'/>{link(pose=RELATIVE)}</model>",
         "is relative to 'f': expected one of f, l in the same model, and no circle"),
        ("<model placement_frame='f'/>", "expected a model without placement_frame"),
        (f"<model>{link('<geometry><box><size>1 2</size></box></geometry>')}</model>",
         "<size>: expected 3 numbers, found '1 2'"),
        (f"<model>{link(pose='<pose>1 2 3</pose>')}</model>", "<pose>: expected 6 numbers, found"),
        ("", "expected triangles, found none"),
    ],
)  # fmt: skip
def test_a_refusal_is_a_sentence(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(MeshError, match=message) as refusal:
        world(tmp_path, content)
    assert str(refusal.value).startswith(str(tmp_path))


def test_models_that_include_each_other_are_refused(tmp_path: Path) -> None:
    save_model(tmp_path)
    text = f"<sdf><model name='crate'>{INCLUDE * 2}</model></sdf>"
    (tmp_path / "crate" / "model.sdf").write_text(text)
    with pytest.raises(MeshError, match="expected at most 20 models in each other"):
        world(tmp_path, INCLUDE)
