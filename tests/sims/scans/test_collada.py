"""COLLADA: transforms, primitives and materials as programs write them, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from sims.scans.mesh_file import Material, MeshError, MeshFile
from sims.scans.reading import read
from tests.sims.scans import kit

INPUT = '<input semantic="VERTEX" source="#v" offset="0"/>'
TRIANGLES = f'<triangles material="m">{INPUT}<p>0 1 2 0 2 3</p></triangles>'
INSTANCE = (
    '<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="m" '
    'target="#red"/></technique_common></bind_material></instance_geometry>'
)
EFFECT = "<lambert><diffuse><color>1 0 0 1</color></diffuse></lambert>"
IMAGE = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)


def collada(
    primitive: str = TRIANGLES,
    node: str = INSTANCE,
    effect: str = EFFECT,
    params: str = "",
    more: str = "",
    asset: str = "",
    points: str = "0 0 0 1 0 0 1 1 0 0 1 0",
) -> str:
    """Return a square of four points."""
    return (
        f"<COLLADA><asset>{asset}</asset>{more}<library_effects><effect id='e'><profile_COMMON>"
        f"{params}<technique>{effect}</technique></profile_COMMON></effect></library_effects>"
        '<library_materials><material id="red"><instance_effect url="#e"/></material>'
        '</library_materials><library_geometries><geometry id="g"><mesh><source id="p">'
        f'<float_array id="a">{points}</float_array><technique_common><accessor source="#a" '
        'count="4" stride="3"/></technique_common></source><vertices id="v"><input '
        f'semantic="POSITION" source="#p"/></vertices>{primitive}</mesh></geometry>'
        '</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        f"{node}</node></visual_scene></library_visual_scenes><scene>"
        '<instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def square(folder: Path, text: str) -> MeshFile:
    (folder / "mesh.dae").write_text(text)
    return read(folder / "mesh.dae")


@pytest.mark.parametrize(
    "primitive",
    [
        TRIANGLES,
        f"<polylist>{INPUT}<vcount>4</vcount><p>0 1 2 3</p></polylist>",
        f"<polylist>{INPUT}<vcount>3 3</vcount><p>0 1 2 0 2 3</p></polylist>",
        f"<polygons>{INPUT}<p>0 1 2 3</p></polygons>",
        f"<trifans>{INPUT}<p>0 1 2 3</p></trifans>",
        f"<triangles>{INPUT}<p>0 1 2</p></triangles><triangles>{INPUT}<p>0 2 3</p></triangles>",
        f"<tristrips>{INPUT}<p>1 2 0 3</p></tristrips>",
    ],
)
def test_primitives_of_all_kinds_are_the_same_square(tmp_path: Path, primitive: str) -> None:
    mesh = square(tmp_path, collada(primitive))
    triangles = np.concatenate([piece.points[piece.corners] for piece in mesh.pieces])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert np.array_equal(normals, np.tile((0, 0, 1), (2, 1)))
    assert triangles.reshape(-1, 3).sum(axis=0).tolist() == [3, 3, 0]


@pytest.mark.parametrize(
    ("transforms", "corner"),  # where (1, 1, 0) stands
    [
        ("<translate>1 2 3</translate><scale>2 2 2</scale>", (3, 4, 3)),
        ("<scale>2 2 2</scale><translate>1 2 3</translate>", (4, 6, 6)),
        ("<rotate>0 0 2 90</rotate>", (-1, 1, 0)),
        ("<rotate>1 1 1 120</rotate>", (0, 1, 1)),
        ("<matrix>0 0 1 5 1 0 0 6 0 1 0 7 0 0 0 1</matrix>", (5, 7, 8)),
        ("<lookat>1 2 3  1 2 0  0 1 0</lookat>", (2, 3, 3)),
        ("<lookat>0 0 0  0 -1 0  0 0 1</lookat>", (-1, 0, 1)),
        ("<scale>-1 1 1</scale>", (-1, 1, 0)),
    ],
)
def test_transforms_in_their_order(
    tmp_path: Path, transforms: str, corner: tuple[float, float, float]
) -> None:
    (piece,) = square(tmp_path, collada(node=transforms + INSTANCE)).pieces
    assert np.allclose(piece.points[2], corner)


def test_a_mirrored_node_is_seen_from_the_same_side(tmp_path: Path) -> None:
    (piece,) = square(tmp_path, collada(node=f"<scale>-1 1 1</scale>{INSTANCE}")).pieces
    a, b, c = piece.points[piece.corners[0]]
    assert np.cross(b - a, c - a).tolist() == [0, 0, 1]


def test_nodes_and_instances_of_nodes(tmp_path: Path) -> None:
    library = (
        '<library_nodes><node id="lib"><translate>0 0 1</translate>'
        f"{INSTANCE}</node></library_nodes>"
    )
    node = '<translate>0 0 1</translate><node><instance_node url="#lib"/></node>'
    (piece,) = square(tmp_path, collada(node=node, more=library)).pieces
    assert piece.object == "lib"
    assert piece.points[0].tolist() == [0, 0, 2]


def test_a_skin_is_drawn_as_it_was_bound(tmp_path: Path) -> None:
    controller = (
        '<library_controllers><controller id="c"><skin source="#g"><bind_shape_matrix>1 0 0 0 '
        "0 1 0 0 0 0 1 5 0 0 0 1</bind_shape_matrix></skin></controller></library_controllers>"
    )
    node = '<instance_controller url="#c"/>'
    mesh = square(tmp_path, collada(node=node, more=controller))
    assert mesh.pieces[0].points[0].tolist() == [0, 0, 5]
    assert "skins (1): meshes stand in the pose in which they were bound" in mesh.left_out


@pytest.mark.parametrize(
    ("asset", "up", "unit"),
    [
        ("", "y", 1.0),
        ('<unit meter="0.0254"/><up_axis>Z_UP</up_axis>', "z", 0.0254),
        ("<up_axis> X_UP </up_axis>", "x", 1.0),
    ],
)
def test_the_axis_and_the_unit(tmp_path: Path, asset: str, up: str, unit: float) -> None:
    mesh = square(tmp_path, collada(asset=asset))
    assert (mesh.up, mesh.unit) == (up, unit)


# Looks.

PARAMS = (
    '<newparam sid="surface"><surface><init_from>i</init_from></surface></newparam>'
    '<newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>'
)
DIFFUSE = '<diffuse><texture texture="sampler" texcoord="UV"/></diffuse>'


def look(folder: Path, effect: str, params: str = PARAMS, init: str = "wall.png") -> Material:
    (folder / "wall.png").write_bytes(kit.png(IMAGE))
    images = f'<library_images><image id="i"><init_from>{init}</init_from></image></library_images>'
    mesh = square(folder, collada(effect=effect, params=params, more=images))
    return mesh.materials[mesh.pieces[0].material]


@pytest.mark.parametrize(
    ("params", "sampler", "init"),
    [
        (PARAMS, "sampler", "wall.png"),
        (PARAMS, "sampler", "<ref>wall.png</ref>"),
        ("", "i", "./wall.png"),
        (PARAMS, "sampler", r"file://C:\models\wall.png"),
        (
            '<newparam sid="sampler"><sampler2D><instance_image url="#i"/></sampler2D></newparam>',
            "sampler",
            "wall.png",
        ),
    ],
)
def test_images_of_effects(tmp_path: Path, params: str, sampler: str, init: str) -> None:
    effect = f"<phong>{DIFFUSE.replace('sampler', sampler)}</phong>"
    image = look(tmp_path, effect, params, init).image
    assert image is not None
    assert np.array_equal(image, IMAGE[..., :3])


@pytest.mark.parametrize(
    ("transparent", "alpha"),
    [
        ('<transparent opaque="A_ONE"><color>1 1 1 0.5</color></transparent>', 0.5),
        ('<transparent opaque="RGB_ZERO"><color>.25 .25 .25 1</color></transparent>', 0.75),
        ("<transparent><color>1 1 1 1</color></transparent><transparency><float>0.25</float>"
         "</transparency>", 0.25),
        # As programs write it that mean "opaque".
        ("<transparent><color>1 1 1 1</color></transparent><transparency><float>0</float>"
         "</transparency>", 1.0),
    ],
)  # fmt: skip
def test_opacity(tmp_path: Path, transparent: str, alpha: float) -> None:
    color = "<diffuse><color>0 0 1 1</color></diffuse>"
    material = look(tmp_path, f"<phong>{color}{transparent}</phong>")
    assert material.colour == pytest.approx((0, 0, 1, alpha))
    assert material.blend == (alpha < 1)


def test_an_alpha_of_the_image_cuts_where_the_effect_says_so(tmp_path: Path) -> None:
    transparent = '<transparent><texture texture="sampler" texcoord="UV"/></transparent>'
    material = look(tmp_path, f"<phong>{DIFFUSE}{transparent}</phong>")
    assert material.cutoff == 0.5
    assert material.image is not None
    assert np.array_equal(material.image, IMAGE)


def test_a_bake_that_is_all_emission_is_unlit(tmp_path: Path) -> None:
    emission = DIFFUSE.replace("diffuse", "emission")
    black = "<diffuse><color>0 0 0 1</color></diffuse>"
    material = look(tmp_path, f"<phong>{emission}{black}</phong>")
    assert material.unlit
    assert material.image is not None


def test_double_sided(tmp_path: Path) -> None:
    extra = "<extra><technique><double_sided>1</double_sided></technique></extra>"
    assert look(tmp_path, f"<phong>{DIFFUSE}</phong>{extra}").double_sided


def test_what_is_lost_is_told(tmp_path: Path) -> None:
    effect = f"<phong>{DIFFUSE}</phong><extra><technique><bump/></technique></extra>"
    images = '<library_images><image id="i"><init_from>a.tif</init_from></image></library_images>'
    lines = f"<lines>{INPUT}<p>0 1</p></lines>"
    node = f'{INSTANCE}<instance_camera url="#c"/><instance_node url="other.dae#x"/>'
    text = collada(
        TRIANGLES + lines, node, effect, PARAMS, f"{images}<library_animations><animation>"
        "<channel/></animation></library_animations>"
    )  # fmt: skip
    assert square(tmp_path, text).left_out == (
        "animations (1): the scene stands as it is stored",
        "cameras (1): not used",
        "image 'a.tif' (1): not found; drawn in the material's colour",
        "normal maps (1): not drawn",
        "primitives of lines (1): not drawn",
        "references to other files (1): not read",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<a", "expected XML, found: "),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "expected XML without entities"),
        ("<svg/>", "expected COLLADA, found <svg>"),
        ("<COLLADA/>", "expected a visual scene, found none"),
        (collada(points="0 0 0"), "source #p: expected 4 vectors of 3 numbers, found 3 numbers"),
        (collada(points="0 0 x"), "<float_array>: expected numbers, found b'x'"),
        (collada(TRIANGLES.replace("3<", "4<")), "n: expected numbers of POSITION from 0 to 3, "),
        (collada(TRIANGLES.replace("#v", "#w")), "<input>: expected a source, found '#w'"),
        (collada(node="<scale>1 1</scale>"), "<scale>: expected 3 finite numbers, found '1 1'"),
        (collada(node='<instance_node url="#n"/>'), "node n: expected at most 100 nodes in each"),
        (collada(asset='<unit meter="0"/>'), r"expected a unit above 0 metres, found 0\.0"),
        (collada(effect="<phong><diffuse><color>1</color></diffuse></phong>"), "<diffuse>: expect"),
    ],
)
def test_a_refusal_is_a_sentence(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MeshError, match=message) as refusal:
        square(tmp_path, text)
    assert str(refusal.value).startswith(str(tmp_path))


def test_nodes_that_double_each_other_are_no_bomb(tmp_path: Path) -> None:
    nodes = "".join(
        f'<node id="n{i}"><instance_node url="#n{i + 1}"/><instance_node url="#n{i + 1}"/></node>'
        for i in range(40)
    )
    library = f'<library_nodes>{nodes}<node id="n40"/></library_nodes>'
    with pytest.raises(MeshError, match="and 10000 in all, found more"):
        square(tmp_path, collada(node='<instance_node url="#n0"/>', more=library))
