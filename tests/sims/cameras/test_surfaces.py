"""Surfaces beyond MJCF: two-sided, cut out, coloured by the vertex; and parts of one object."""

from __future__ import annotations

import logging
import math
from functools import cache
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from events.frames import from_rpy
from sims.cameras import CameraSpec, GraphicsError, opengl, pose_to_qpos
from sims.cameras.opengl import OpenGL
from sims.cameras.optics import pixel_rays
from sims.cameras.raster import Raster
from sims.cameras.spec import camera_info
from sims.cameras.stage import Drawn, View, object_numbers
from sims.cameras.surfaces import geom_numbers, vertex_colours
from sims.compiled import libraries
from tests.sims.cameras.test_raster import PINHOLE, SPECS, compiled, drawn

MESH, PLANE = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_PLANE
QUAD = np.array([[2, 1, -1], [2, -1, -1], [2, -1, 1], [2, 1, 1]], np.float64)  # seen from -x
AHEAD = ((0.0, 0.0, 0.0), from_rpy(0.0, 0.0, 0.0))
BEHIND = ((4.0, 0.0, 0.0), from_rpy(0.0, 0.0, math.pi))
CORNERS = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 255, 255]]


def world_of(names: str = "double_sided alpha_cutoff") -> Any:
    """Return a world without any light but what its things emit."""
    world = mujoco.MjSpec()
    world.visual.headlight.active = 0
    world.add_text(name="geom_user", data=names)
    return world


def add_texture(world: Any, name: str, texels: Any) -> None:
    """Add texels, shape (height, width, channels)."""
    height, width, channels = np.shape(texels)
    texture = world.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=width,
        height=height,
        nchannel=channels,
    )
    texture.data = np.asarray(texels, np.uint8).tobytes()


def add_material(world: Any, name: str, texture: str = "", **settings: Any) -> None:
    material = world.add_material(name=name, **{"emission": 1.0, "specular": 0.0, **settings})
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture
    material.textures = textures


def add_mesh(world: Any, name: str, points: Any, faces: Any, **settings: Any) -> Any:
    """Add a mesh of triangles, and a geom of the same name that looks like this."""
    world.add_mesh(
        name=name,
        uservert=np.ravel(points),
        userface=np.ravel(faces),
        usertexcoord=np.ravel(settings.pop("places", [])),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    settings = {"rgba": [1.0, 1.0, 1.0, 1.0], **settings}
    return world.worldbody.add_geom(
        name=name, type=MESH, meshname=name, contype=0, conaffinity=0, **settings
    )


def add_quad(world: Any, name: str = "quad", **settings: Any) -> Any:
    return add_mesh(world, name, QUAD, [[0, 1, 2], [0, 2, 3]], **settings)


def seen(world: Any, spec: CameraSpec = PINHOLE, view: Any = AHEAD, **of: Any) -> Drawn:
    raster = Raster(compiled(world.copy()), **of)
    images = drawn(raster, spec, *view)
    raster.close()
    return images


@cache
def rays_of(spec: CameraSpec) -> Any:
    return pixel_rays(camera_info(spec))


def on_quad(spec: CameraSpec) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return where each pixel's ray meets the quad's plane: from 0 to 1, right and down."""
    rays = rays_of(spec)
    with np.errstate(divide="ignore", invalid="ignore"):
        across, down = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    ahead = rays[..., 2] > 0.1
    return np.where(ahead, across + 0.5, np.nan), np.where(ahead, down + 0.5, np.nan)


def test_chunks_have_the_number_of_the_first() -> None:
    world = world_of()
    names = ("shelf.chunk1", "shelf.chunk0", "wall", "shelf.chunk12", "lost.chunk3", "shelf.chunk")
    for name in names:
        world.worldbody.add_geom(name=name, size=[1, 0, 0])
    assert object_numbers(world.compile()).tolist() == [1, 1, 2, 1, 4, 5]


def test_user_numbers_are_known_by_their_names() -> None:
    world = world_of("other alpha_cutoff double_sided and_more")
    world.worldbody.add_geom(size=[1, 0, 0], userdata=[7.0, 0.5, 1.0])
    world.worldbody.add_geom(size=[1, 0, 0])
    model = world.compile()
    assert geom_numbers(model, "alpha_cutoff").tolist() == [0.5, 0.0]
    assert geom_numbers(model, "double_sided").tolist() == [1.0, 0.0]
    nameless = mujoco.MjSpec()
    nameless.worldbody.add_geom(size=[1, 0, 0], userdata=[1.0, 0.5])
    assert geom_numbers(nameless.compile(), "double_sided").tolist() == [0.0]
    silent = world_of()
    silent.worldbody.add_geom(size=[1, 0, 0])
    assert geom_numbers(silent.compile(), "alpha_cutoff").tolist() == [0.0]


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
def test_colours_of_vertices_are_interpolated(spec: CameraSpec) -> None:
    """They are a factor on the geom's own colour."""
    world = world_of()
    add_material(world, "bright")
    add_quad(world, material="bright", rgba=[1.0, 0.5, 1.0, 1.0])
    add_texture(world, "quad.colours", [CORNERS])
    image = seen(world, spec).colours
    right, down = (part[..., None] for part in on_quad(spec))
    # Two triangles, whose common side leads from the lower left to the upper right.
    low_left, low_right, up_right, up_left = np.array(CORNERS, float)[:, :3]
    below = low_left * (1 - right) + low_right * (right + down - 1) + up_right * (1 - down)
    above = up_left * (1 - right - down) + low_left * down + up_right * right
    expected = np.where(right + down > 1, below, above) * (1.0, 0.5, 1.0)
    inside = (abs(right - 0.5) < 0.45) & (abs(down - 0.5) < 0.45)
    assert inside.sum() > 2000
    assert image is not None
    assert np.abs(image - expected)[inside[..., 0]].max() < 1.5


def test_colours_of_too_few_vertices_are_refused() -> None:
    world = world_of()
    add_quad(world)
    add_texture(world, "quad.colours", [CORNERS[:3]])
    with pytest.raises(ValueError, match=r"quad\.colours: expected .* of the 4 vertices, found 3"):
        seen(world)


def test_colours_are_those_of_vertices_in_the_order_of_the_file() -> None:
    """The compiler turns and moves a mesh about its middle, but keeps its vertices' order."""
    random = np.random.default_rng(3)
    points, faces = random.normal(size=(40, 3)), random.permutation(40)[:39].reshape(13, 3)
    points[7] = points[8]
    world = world_of()
    add_mesh(world, "heap", points, np.vstack([faces, [[0, 1, 2]]]))
    add_texture(world, "heap.colours", np.arange(40 * 3).reshape(4, 10, 3))
    model = world.compile()
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    back = model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0]
    np.testing.assert_allclose(back, points, atol=1e-5)
    colours = vertex_colours(model, 0)
    assert colours is not None
    np.testing.assert_allclose(colours[:, :3] * 255.0, np.arange(120).reshape(40, 3), atol=1e-4)


def test_the_back_is_seen_of_double_sided_triangles_only() -> None:
    for double_sided in (0.0, 1.0):
        world = world_of()
        add_quad(world, userdata=[double_sided, 0.0])
        images = seen(world, view=BEHIND)
        assert images.depth is not None
        assert images.numbers is not None
        assert (np.unique(images.numbers).tolist() == [-1, 0]) == bool(double_sided)
        assert math.isfinite(images.depth[90, 120]) == bool(double_sided)
        if double_sided:
            ahead = seen(world)
            assert ahead.numbers is not None
            np.testing.assert_allclose(images.depth[90, 120], 2.0, rtol=1e-6)
            np.testing.assert_array_equal(images.numbers, ahead.numbers[:, ::-1])


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("lamp", [0.0, 4.0])
def test_each_side_has_the_light_that_falls_on_it(spec: CameraSpec, lamp: float) -> None:
    world = world_of()
    add_material(world, "dull", emission=0.0)
    add_quad(world, material="dull", userdata=[1.0, 0.0])
    world.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_POINT, pos=[lamp, 0, 0], castshadow=False
    )
    for view, place in ((AHEAD, 0.0), (BEHIND, 4.0)):
        image = seen(world, spec, view).colours
        assert image is not None
        middle = image[spec.height // 2, spec.width // 2]
        # At the corners, where light is computed, it falls at this slant; the rest is between.
        expected = 0.7 * 255.0 * 2.0 / math.sqrt(6.0) if lamp == place else 0.0
        np.testing.assert_allclose(middle, expected, atol=1.5)


def checkered(cells: int, texels: int, alpha: int = 0) -> npt.NDArray[np.uint8]:
    """Return a texture that is opaque in every other cell, the upper left one first."""
    at = np.arange(cells * texels) // texels
    image = np.full((len(at), len(at), 4), 200, np.uint8)
    image[..., 3] = np.where((at[:, None] + at) % 2 == 0, 255, alpha)
    return image


PLACES = [[0, 1], [1, 1], [1, 0], [0, 0]]


def add_checker(world: Any, cells: int = 4, cutoff: float = 0.5, **settings: Any) -> Any:
    add_texture(world, "checker", checkered(cells, 16))
    add_material(world, "checker", "checker", **settings)
    return add_quad(world, material="checker", places=PLACES, userdata=[1.0, cutoff])


def opaque_cells(spec: CameraSpec, cells: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return which pixels see an opaque cell, and which are well within a cell or beside all."""
    right, down = (part * cells for part in on_quad(spec))
    inside = (right > 0) & (right < cells) & (down > 0) & (down < cells)
    with np.errstate(invalid="ignore"):
        opaque = inside & ((np.floor(right) + np.floor(down)) % 2 == 0)
        clear = (np.abs(right - np.round(right)) > 0.1) & (np.abs(down - np.round(down)) > 0.1)
    return opaque, clear


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
def test_what_is_below_the_cutoff_is_in_no_image(spec: CameraSpec) -> None:
    """From either side; there is seen what is behind it."""
    world = world_of()
    add_checker(world)
    world.worldbody.add_geom(type=PLANE, size=[9, 9, 1], pos=[5, 0, 0], euler=[0, -90, 0])
    opaque, clear = opaque_cells(spec, 4)
    images = seen(world, spec)
    assert images.numbers is not None
    assert images.depth is not None
    assert images.colours is not None
    np.testing.assert_array_equal(images.numbers[clear] == 0, opaque[clear])
    ahead = clear & (np.abs(np.array(on_quad(spec)) - 0.5) < 1.5).all(axis=0)  # before the wall
    wanted = np.where(opaque, 2.0, 5.0)[ahead]
    np.testing.assert_allclose(images.depth[ahead], wanted, rtol=1e-5)
    np.testing.assert_array_equal(images.colours[clear & opaque], 200)
    assert (images.colours[clear & ~opaque] == 0).all()
    behind = seen(world, spec, BEHIND)
    assert behind.numbers is not None
    mirrored = opaque[:, ::-1]
    np.testing.assert_array_equal((behind.numbers == 0)[clear], mirrored[clear])


@pytest.mark.parametrize(
    ("cutoff", "geom", "vertex", "is_seen"),
    [
        (0.3, 1.0, 255, True),
        (0.3, 0.5, 255, False),
        (0.3, 1.0, 100, False),
        (0.1, 0.5, 150, True),
        (1.0, 1.0, 255, False),
    ],
)
def test_all_opacities_are_compared_with_the_cutoff(
    cutoff: float, geom: float, vertex: int, is_seen: bool
) -> None:
    """That of the texture, of the geom and of the vertices; what passes is wholly opaque."""
    world = world_of()
    add_texture(world, "half", np.full((16, 16, 4), 128))
    add_material(world, "half", "half")
    quad = add_quad(world, material="half", places=PLACES, userdata=[0.0, cutoff])
    quad.rgba = [1.0, 1.0, 1.0, geom]
    add_texture(world, "quad.colours", [[[255, 255, 255, vertex]] * 4])
    images = seen(world)
    assert images.depth is not None
    assert images.colours is not None
    assert math.isfinite(images.depth[90, 120]) == is_seen
    assert images.colours[90, 120].tolist() == [128 * is_seen] * 3


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("share", [0.15, 0.5])
def test_leaves_neither_vanish_nor_close_in_the_distance(spec: CameraSpec, share: float) -> None:
    """The share of pixels that see them stays, be texels larger or much smaller than pixels."""
    random = np.random.default_rng(5)
    leaves = np.full((256, 256, 4), 255, np.uint8)
    leaves[..., 3] = np.where(random.random((64, 64)) < share, 255, 0).repeat(4, 0).repeat(4, 1)
    world = world_of()
    add_texture(world, "leaves", leaves)
    add_material(world, "leaves", "leaves")
    add_quad(world, material="leaves", places=np.array(PLACES), userdata=[0.0, 0.5])
    raster = Raster(compiled(world))
    share = (leaves[..., 3] > 0).mean()
    for north in (0.0, -2.0, -6.0, -14.0):
        numbers = drawn(raster, spec, (north, 0.0, 0.0), AHEAD[1]).numbers
        rays = rays_of(spec)
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.abs(rays[..., :2] / rays[..., 2:]) * (2.0 - north)
        inside = (rays[..., 2] > 0) & (place < 1.0).all(axis=-1)
        assert numbers is not None
        assert abs((numbers[inside] == 0).mean() - share) < 0.07
    raster.close()


def test_what_is_cut_out_throws_no_shadow() -> None:
    """A sun behind a checker draws it on the wall behind."""
    world = world_of()
    add_checker(world, cells=2, emission=0.0)
    add_material(world, "wall", emission=0.0)
    wall = add_quad(world, "wall", material="wall")
    wall.pos = [3, 0, 0]
    world.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[1, 0, 0], castshadow=True
    )
    world.stat.extent, world.visual.quality.shadowsize = 4.0, 1024
    view = ((2.1, 0.0, 0.0), AHEAD[1])  # between the two
    images = seen(world, view=view)
    right, down = ((part - 0.5) * 2.9 / 2 * 2 + 1.0 for part in on_quad(PINHOLE))
    inside = (abs(right - 1) < 0.95) & (abs(down - 1) < 0.95)
    inside &= (abs(right - 1) > 0.05) & (abs(down - 1) > 0.05)
    lit = (right > 1) != (down > 1)
    assert images.colours is not None
    assert inside.sum() > 5000
    np.testing.assert_array_equal((images.colours[..., 0] > 100)[inside], lit[inside])


def test_a_cut_out_thing_that_moves_throws_the_shadow_of_one_that_stands() -> None:
    """Its shadow is laid over that of what stands still."""
    world = world_of()
    add_texture(world, "checker", checkered(3, 16))
    add_material(world, "checker", "checker", emission=0.0)
    add_quad(world, "wall").pos = [3, 0, 0]
    body = world.worldbody.add_body(name="gate")
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0.4])
    gate = add_quad(world, "gate", material="checker", places=PLACES, userdata=[1.0, 0.5])
    moves = body.add_geom(type=MESH, meshname="gate", material="checker", userdata=[1.0, 0.5])
    moves.contype = moves.conaffinity = 0
    world.delete(gate)
    world.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[1, 0.2, 0], castshadow=True
    )
    world.stat.extent, world.visual.quality.shadowsize = 4.0, 256
    model = compiled(world)
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{PINHOLE.name}")

    def image(stage: Raster, at: float) -> Any:
        qpos = np.append(at, pose_to_qpos((2.1, 0.0, 0.0), AHEAD[1]))
        stage.look(camera, qpos)
        return stage.draw(View(camera_info(PINHOLE)), True, False, False).colours

    moving, images = Raster(model), []
    for at in (0.0, 0.2, 0.5, 0.1):
        images.append(image(moving, at))
        alone = Raster(model)
        np.testing.assert_array_equal(images[-1], image(alone, at))
        alone.close()
    moving.close()
    assert (images[0] != images[1]).mean() > 0.05
    assert 0.2 < (images[0] == 0).mean() < 0.95


def hostile_world() -> Any:
    """Return a world of all of it at once: bent, two-sided, cut, coloured, lit, shaded, glassy."""
    random = np.random.default_rng(1)
    at = np.linspace(-1.0, 1.0, 9)
    y, z = (part.ravel() for part in np.meshgrid(at, at))
    points = np.stack([2.0 + 0.8 * np.sin(4.0 * y), y, z], -1)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + 10], -1),
            np.stack([corner, corner + 10, corner + 9], -1),
        ]
    )
    world = world_of()
    add_texture(world, "checker", checkered(5, 7, 90))
    add_material(world, "checker", "checker", emission=0.2, specular=0.4, texrepeat=[2, 3])
    places = np.stack([0.5 + 0.5 * y, 0.5 - 0.5 * z], -1)
    for k, (cutoff, opacity) in enumerate(((0.5, 1.0), (0.0, 0.4), (0.0, 1.0), (0.7, 0.9))):
        add_mesh(
            world,
            f"cloth{k}",
            points,
            faces,
            places=places,
            material="checker",
            userdata=[1, cutoff],
            rgba=[0.9, 0.8, 0.7, opacity],
            pos=[0.4 * k, 0.1 * k, 0.0],
            euler=[10.0 * k, 0.0, 20.0 * k],
        )
        add_texture(world, f"cloth{k}.colours", random.integers(100, 256, (9, 9, 4)))
    kinds = mujoco.mjtLightType
    for kind in (kinds.mjLIGHT_DIRECTIONAL, kinds.mjLIGHT_SPOT):
        world.worldbody.add_light(type=kind, pos=[-1, 0.5, 2], dir=[1, 0.1, -0.5], castshadow=True)
    world.stat.extent, world.visual.quality.shadowsize = 4.0, 128
    return world


@pytest.mark.parametrize("spec", SPECS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("rolling", [False, True])
def test_the_bytes_are_those_of_every_build_and_number_of_threads(
    spec: CameraSpec, rolling: bool
) -> None:
    model = compiled(hostile_world())
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{spec.name}")
    images = []
    for instructions, threads in [*((name, 1) for name in libraries()), ("", 4)]:
        raster = Raster(model, threads=threads, instructions=instructions)
        qpos = np.zeros(model.nq)
        qpos[-4] = 1.0
        if rolling:
            for turn in (0.0, 0.05, 0.1):
                qpos[-4:] = math.cos(turn), 0.0, 0.0, math.sin(turn)
                raster.keep(camera, qpos, 0.0)
        images.append(
            [image.tobytes() for image in drawn(raster, spec, *AHEAD) if image is not None]
        )
        raster.close()
    assert all(other == images[0] for other in images[1:])


def test_a_row_that_moves_sees_the_same_as_one_that_stands() -> None:
    """Rolling, at rest: back sides, gaps and colours are those of the image at once."""
    model = compiled(hostile_world())
    for spec in SPECS:
        raster = Raster(model)
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, f"free/{spec.name}")
        still = drawn(raster, spec, *AHEAD)
        qpos = raster._data.qpos.copy()
        for _ in range(3):
            raster.keep(camera, qpos, 0.0)
        moving = drawn(raster, spec, *AHEAD)
        assert still.colours is not None
        assert moving.colours is not None
        assert np.mean(still.numbers == moving.numbers) > 0.999
        assert np.mean(still.colours != moving.colours) < 0.02
        raster.close()


def test_what_mujocos_renderer_leaves_out_is_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = compiled(hostile_world())
    monkeypatch.setattr(opengl, "open_context", Mock(side_effect=GraphicsError("no GL")))
    with caplog.at_level(logging.WARNING), pytest.raises(GraphicsError, match="no GL"):
        OpenGL(model, (camera_info(PINHOLE),), 1)
    (record,) = (record for record in caplog.records if record.name == "visnav.cameras")
    assert record.message == (
        'renderer = "mujoco" does not draw the back of double-sided geoms: 4, the gaps of cut-out '
        'geoms: 2, vertex colours of meshes: 4; "raster" does'
    )


def cells_of(across: int, down: int) -> Any:
    """Return the triangles of a grid of cells, of vertices row by row, shape (m, 3)."""
    corner = (np.arange(down)[:, None] * (across + 1) + np.arange(across)).ravel()
    above = corner + across + 1
    return np.stack([corner, corner + 1, above + 1, corner, above + 1, above], -1).reshape(-1, 3)


def wall_and_balls() -> list[tuple[Any, Any]]:
    """Return the points and triangles of a bumpy wall, and of balls behind it and through it."""
    line = np.linspace(-4.0, 4.0, 68)
    y, z = (part.ravel() for part in np.meshgrid(line, line))
    things = [(np.stack([3.0 + 0.1 * np.sin(3 * y) * np.cos(4 * z), -y, z], -1), cells_of(67, 67))]
    around, up = np.meshgrid(np.linspace(0, 2 * np.pi, 31), np.linspace(-1.5, 1.5, 31))
    ball = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], -1)
    for k, radius in enumerate((0.4, 0.7, 0.9, 1.7, 2.2)):
        place = (4.5 + 0.1 * k, 1.3 * k - 3.0, (-1.0) ** k)
        things.append((radius * ball.reshape(-1, 3) + np.array(place), cells_of(30, 30)))
    return things


@pytest.mark.parametrize("threads", [1, 4])
def test_what_is_left_out_unseen_changes_no_pixel(threads: int) -> None:
    """Of large meshes parts are left out; the same in small pieces, few at a time, has none."""
    whole, pieces = world_of(), world_of()
    for k, (points, faces) in enumerate(wall_and_balls()):
        add_mesh(whole, f"thing{k}", points, faces)
        for n, part in enumerate(np.array_split(faces, len(faces) // 100)):
            used, corners = np.unique(part, return_inverse=True)
            add_mesh(pieces, f"thing{k}.chunk{n}", points[used], corners)
    images = seen(whole, threads=threads)
    model = compiled(pieces)
    owner = np.array([int(model.geom(geom).name[5]) for geom in object_numbers(model)])
    alone, nearest, number = Raster(model), np.full((180, 240), np.inf), np.full((180, 240), -1)
    for some in np.array_split(np.arange(model.ngeom), 5):  # each fewer than one batch
        model.geom_rgba[:, 3] = np.isin(np.arange(model.ngeom), some)
        _, depth, numbers = drawn(alone, PINHOLE, *AHEAD)
        assert depth is not None
        assert numbers is not None
        nearer = depth < nearest
        number[nearer] = owner[numbers[nearer]]
        nearest[nearer] = depth[nearer]
    alone.close()
    assert np.unique(number).tolist() == [0, 5]  # the others are behind the wall
    assert images.numbers is not None
    assert images.depth is not None
    np.testing.assert_allclose(images.depth, nearest, rtol=1e-4)  # meshes are turned otherwise
    assert np.mean(images.numbers != number) < 1e-3
