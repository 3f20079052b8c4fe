"""A world packed for other processes is drawn there with the same bytes, from one memory."""

from __future__ import annotations

import gc
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from events.frames import from_rpy
from sims.cameras import CameraRenderer, CameraSpec, add_free_camera, model_to_bytes, pose_to_qpos
from sims.cameras.packed import Packed, SharedFile, pack, prepare, without_looks
from sims.cameras.raster import Raster, library_for
from sims.cameras.renderer import Shot
from tests.sims.cameras.scenes import fresh
from tests.sims.cameras.test_raster import SHAPES, shaped

CAMERA = CameraSpec(
    name="eye", width=160, height=120, position=(0, 0, 0), images=("rgb", "depth", "segmentation")
)
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="has no name on Linux only")


def raster(model: Any) -> Any:
    return library_for(model)


def everything() -> Any:
    """Return a world of all shapes, with a texture, a moving body, lights and two meshes."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco>
  <statistic meansize=".3"/>
  <asset>
    <mesh name="block" vertex="-1 -.5 -.3 1 -.5 -.3 -1 .5 -.3 1 .5 -.3 -1 -.5 .3 1 -.5 .3 -1 .5 .3
      1 .5 .3" refpos=".1 .2 .3"/>
    <mesh name="wedge" vertex="0 0 0 1 0 0 0 2 0 0 0 3" texcoord="0 0 1 0 0 1 1 1"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2=".1 .1 .2" width="64"
      height="384"/>
    <texture name="squares" type="2d" builtin="checker" rgb1=".9 .5 .1" rgb2=".1 .2 .7" width="96"
      height="96"/>
    <material name="squares" texture="squares" texrepeat="3 2"/>
  </asset>
  <worldbody>
    <light type="spot" pos="-2 -1 3" dir=".6 .3 -1" cutoff="40"/>
    <geom type="plane" size="0 0 .1" pos="0 0 -1" material="squares"/>
    <geom type="mesh" mesh="block" pos="1 0 0" material="squares"/>
    <body pos="0 1 .2"><freejoint/><geom type="mesh" mesh="wedge" material="squares"/></body>
    <geom type="box" mesh="block" pos="1 -2 0" rgba=".2 .8 .3 1"/>
    <geom type="cylinder" size=".3 .5" pos="0 -1 0" rgba=".8 .2 .3 .6"/>
  </worldbody>
</mujoco>"""
    )
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (9, 3))
    faces = [[0, k, k + 1] for k in range(1, 8)]
    spec.add_mesh(
        name="own",
        uservert=points.ravel(),
        userface=np.ravel(faces),
        usertexcoord=points[:, :2].ravel(),
        usernormal=points.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    kind = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=kind, meshname="own", pos=[0, -0.5, 1], material="squares")
    add_free_camera(spec, "free", (CAMERA,))
    return spec


def images(world: Packed | bytes, model: Any) -> list[Any]:
    """Return the images of some views."""
    renderer = CameraRenderer(world, (CAMERA,), "free/", seed=0)
    seen: list[Any] = []
    for turn in (0.0, 0.8, 2.5):
        qpos = model.qpos0.copy()
        qpos[-7:] = pose_to_qpos((-2.2, 0.3, -0.8), from_rpy(0.0, -0.2, turn))
        (frame,) = renderer.expose((Shot("eye", 0, qpos),))
        seen += frame.rgb, frame.depth, frame.segmentation
    renderer.close()
    return seen


def test_what_is_drawn_from_the_shared_file_is_what_is_drawn_from_the_model() -> None:
    spec = everything()
    model = spec.compile()
    expected = images(model_to_bytes(model), model)
    lean = without_looks(spec, model)
    assert lean is not model
    assert lean.mesh_vert.size < model.mesh_vert.size
    assert lean.tex_data.size < 100
    packed = pack(lean, raster(model), model)
    there = pickle.loads(pickle.dumps(packed))
    for image, other in zip(images(there, model), expected, strict=True):
        np.testing.assert_array_equal(image, other)


def test_a_model_without_looks_has_all_in_the_same_places() -> None:
    spec = everything()
    model = spec.compile()
    lean = without_looks(spec, model)
    assert lean is not model
    datas = []
    for of in (model, lean):
        data: Any = mujoco.MjData(of)
        data.qpos[:3] += 0.3
        mujoco.mj_kinematics(of, data)
        mujoco.mj_comPos(of, data)
        mujoco.mj_camlight(of, data)
        datas.append(data)
    for name in ("geom_xpos", "geom_xmat", "cam_xpos", "light_xpos", "subtree_com", "xipos"):
        np.testing.assert_array_equal(*(getattr(data, name) for data in datas))
    for name in ("geom_size", "geom_rbound", "geom_dataid", "body_inertia", "mat_texid"):
        np.testing.assert_array_equal(getattr(model, name), getattr(lean, name))
    assert lean.stat.extent == model.stat.extent


@pytest.mark.parametrize("name", ["hall", pytest.param("forest", marks=pytest.mark.slow)])
def test_a_built_in_world_is_drawn_the_same(name: str) -> None:
    spec = fresh(name)
    add_free_camera(spec, "free", (CAMERA,))
    model = spec.compile()
    expected = images(model_to_bytes(model), model)
    packed = pack(without_looks(spec, model), raster(model), model)
    there = pickle.loads(pickle.dumps(packed))
    for image, other in zip(images(there, model), expected, strict=True):
        np.testing.assert_array_equal(image, other)


def test_a_model_that_cannot_be_made_anew_is_taken_as_it_is() -> None:
    spec = everything()
    model = spec.compile()
    spec.delete(spec.textures[1])
    assert without_looks(spec, model) is model


def test_images_beside_a_model_are_drawn_in_place_of_its_texels() -> None:
    image = np.random.default_rng(1).integers(0, 256, (32, 48, 3), np.uint8)
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    whole, named = (
        shaped(SHAPES["box"], kind=kind, image=of) for of in (image, np.zeros((1, 1, 3), np.uint8))
    )
    one = pack(whole, raster(whole)).drawable
    other = pack(named, raster(named), images={"ramps": image}).drawable
    assert one is not None
    assert other is not None
    assert one.textures == other.textures
    np.testing.assert_array_equal(one.texels, other.texels)


def test_the_arrays_of_a_reader_are_those_of_the_file_and_cannot_be_changed() -> None:
    model = everything().compile()
    packed = pack(model, raster(model))
    there = pickle.loads(pickle.dumps(packed))
    assert not there.drawable.texels.flags.writeable
    again = Raster(model, drawable=there.drawable)
    again.close()


def test_arrays_of_any_size_lie_in_the_file() -> None:
    file = SharedFile()
    arrays = [file.empty(shape, np.int32) for shape in ((3,), (0, 4), (1 << 24,), (5, 2))]
    for number, array in enumerate(arrays):
        array[...] = number + 1
    buffers: list[pickle.PickleBuffer] = []
    pickle.dumps(arrays, 5, buffer_callback=buffers.append)
    spans = [file.span(buffer) for buffer in buffers]
    data = Path(file.path).read_bytes()
    for array, (offset, size) in zip(arrays, spans, strict=True):
        assert size == array.nbytes
        assert offset % 64 == 0
        assert data[offset : offset + size] == array.tobytes()


@LINUX
def test_the_file_is_gone_with_the_object_and_its_readers_go_on() -> None:
    model = everything().compile()
    packed = pack(model, raster(model))
    there = pickle.loads(pickle.dumps(packed))
    path = Path(packed._file.path)  # type: ignore[union-attr]
    before = there.drawable.texels.copy()
    assert path.exists()
    del packed
    gc.collect()
    assert not path.exists()
    np.testing.assert_array_equal(there.drawable.texels, before)


@pytest.mark.slow
def test_another_process_reads_it() -> None:
    """As a worker does: started anew, with the pickled world alone."""
    model = everything().compile()
    packed = pack(model, raster(model))
    code = (
        "import pickle, sys; packed = pickle.loads(sys.stdin.buffer.read());"
        "print(packed.model().ngeom, int(packed.drawable.texels.sum()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(packed), capture_output=True, check=True
    )
    assert packed.drawable is not None
    assert done.stdout.split() == [
        str(model.ngeom).encode(), str(int(packed.drawable.texels.sum())).encode()
    ]  # fmt: skip


def test_a_size_that_is_no_number_has_a_mesh_like_any_other() -> None:
    """It is not equal to itself, and so no key."""
    xml = '<mujoco><worldbody><geom type="ellipsoid" size="1 1 1"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    model.geom_size[0, 0] = np.nan
    drawable = prepare(model, library_for(model))
    assert (len(drawable.meshes), drawable.mesh_of_geom) == (1, [0])
    Raster(model, drawable=drawable)
