"""Objects that scripts bring into the world, move, and take out."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import Odometry
from extensions.airsim.tests.scripts import Caller, drone, with_script
from runtime.testing import spec
from sims.computer_vision import FreeCamera
from sims.vehicle import Simulation, attach_vehicle
from sims.worlds import Scene, load_scene
from tests.sims.vehicle.flight import WORLD
from visnav_airsim.server.movables import (
    Holder,
    SpareObject,
    add_movables,
    enable_collisions,
    set_free,
    spare_objects,
)

ONE = {"x_val": 1.0, "y_val": 1.0, "z_val": 1.0}
CUBES: dict[str, Any] = {
    "objects": [{"asset": "Cube", "count": 3}, {"asset": "person"}],
    "movable": ["wal+"],
}


def at(x: float, y: float, z: float, yaw: float = 0.0) -> dict[str, Any]:
    turn = {"w_val": math.cos(yaw / 2), "x_val": 0.0, "y_val": 0.0, "z_val": math.sin(yaw / 2)}
    return {"position": {"x_val": x, "y_val": y, "z_val": z}, "orientation": turn}


def numbers(pose: dict[str, Any]) -> list[float]:
    return [*pose["position"].values(), *pose["orientation"].values()]


def test_objects_come_move_and_go(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        before = airsim("simListSceneObjects", ".*")
        assert before == ["ball", "drone", "floor", "wall"]
        assert airsim("simListAssets") == ["Cube", "person"]
        place = at(3.0, 1.0, -2.0, 0.5)
        assert airsim("simSpawnObject", "box", "Cube", place, ONE, False, False) == "box"
        assert airsim("simSpawnObject", "box", "Cube", at(0, 9, -1), ONE, True, False) == "box1"
        assert airsim("simListSceneObjects", "box.*") == ["box", "box1"]
        assert numbers(airsim("simGetObjectPose", "box")) == pytest.approx(numbers(place))
        assert airsim("simGetSegmentationObjectID", "box") > 0
        assert airsim("simGetObjectScale", "box") == ONE
        airsim("simContinueForTime", 2.0)
        assert numbers(airsim("simGetObjectPose", "box")) == pytest.approx(numbers(place))
        fallen = airsim("simGetObjectPose", "box1")["position"]
        assert fallen["z_val"] == pytest.approx(-0.5, abs=1e-3)
        assert airsim("simSetObjectPose", "wall", at(20.0, 0.0, -3.0), True)
        assert not airsim("simSetObjectPose", "floor", at(20.0, 0.0, -3.0), True)
        assert not airsim("simSetObjectPose", "nobody", at(20.0, 0.0, -3.0), True)
        assert airsim("simGetObjectPose", "wall")["position"]["x_val"] == 20.0
        assert airsim("simDestroyObject", "box")
        assert not airsim("simDestroyObject", "box")
        assert not airsim("simDestroyObject", "floor")
        assert airsim("simDestroyObject", "wall")
        assert math.isnan(airsim("simGetObjectPose", "wall")["position"]["x_val"])
        assert airsim("simListSceneObjects", ".*") == ["ball", "box1", "drone", "floor"]

    with_script(script, [drone(world=tiny_world)], **CUBES)


def test_what_cannot_be_brought_in_is_refused(tiny_world: str) -> None:
    wrong: list[tuple[str, tuple[Any, ...]]] = [
        ("expected one of ['Cube', 'person']", ("a", "Tree", at(0, 0, 0))),
        ("pose: expected", ("a", "Cube", at(math.nan, 0, 0))),
        ("pose: expected", ("a", "Cube", at(0, math.inf, 0))),
        ("up to 100 characters", ("a" * 101, "Cube", at(0, 0, 0))),
        ("pose: expected", ("a", "Cube", {"orientation": {"w_val": 0.0}})),
    ]
    cube = "a", "Cube", at(0, 0, -9), ONE, False, False

    def script(airsim: Caller) -> None:
        for error, arguments in wrong:
            airsim.refuses(error, "simSpawnObject", *arguments, ONE, False, False)
        for _ in range(3):
            airsim("simSpawnObject", *cube)
        airsim.refuses("all objects Cube are in the world", "simSpawnObject", *cube)
        airsim.refuses("pose: expected", "simSetObjectPose", "a", at(0, 0, math.nan), True)

    with_script(script, [drone(world=tiny_world)], **CUBES)


@pytest.mark.slow
@pytest.mark.parametrize("asset", ["Cube", "person"])
def test_a_vehicle_collides_with_what_is_brought_in(asset: str, tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simSpawnObject", "obstacle", asset, at(0.0, 0.0, -1.0), ONE, False, False)
        airsim("simContinueForTime", 1.5)
        collision = airsim("simGetCollisionInfo", "")
        assert collision["object_name"] == "obstacle"
        assert collision["object_id"] == airsim("simGetSegmentationObjectID", "obstacle") > 0

    with_script(script, [drone(world=tiny_world, height=4.0)], **CUBES)


_steps = st.lists(
    st.tuples(
        st.sampled_from(["spawn", "destroy", "move", "step"]),
        st.sampled_from(["a", "b", "wall"]),
        st.floats(-50, 50),
        st.floats(-3, 3),
    ),
    max_size=12,
)


@pytest.mark.slow
@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=_steps)
def test_names_stay_unique_and_poses_exact(steps: list[Any], tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        known = {"wall": numbers(airsim("simGetObjectPose", "wall"))}
        spawned: set[str] = set()
        for what, name, x, yaw in steps:
            place = at(x, 2.0, -20.0, yaw)
            if what == "step":
                airsim("simContinueForTime", 0.02)
            elif what == "move":
                assert airsim("simSetObjectPose", name, place, True) == (name in known)
                if name in known:
                    known[name] = numbers(place)
            elif what == "destroy":
                assert airsim("simDestroyObject", name) == (known.pop(name, None) is not None)
                spawned.discard(name)
            elif len(spawned) < 3:
                used = airsim("simSpawnObject", name, "Cube", place, ONE, False, False)
                assert used not in known
                known[used] = numbers(place)
                spawned.add(used)
            listed = airsim("simListSceneObjects", ".*")
            assert listed == sorted({*known, "ball", "drone", "floor"})
            for body, pose in known.items():
                assert numbers(airsim("simGetObjectPose", body)) == pytest.approx(pose, abs=1e-9)

    with_script(script, [drone(world=tiny_world)], **CUBES)


@pytest.mark.slow
def test_equal_scripts_with_objects_give_equal_runs(tiny_world: str) -> None:
    def script(airsim: Caller) -> None:
        airsim("simContinueForTime", 0.1)
        airsim("simSpawnObject", "box", "Cube", at(0.0, 0.3, -2.0), ONE, True, False)
        airsim("simContinueForTime", 1.0)

    def odometry() -> list[Odometry]:
        return with_script(script, [drone(world=tiny_world)], **CUBES).of(Odometry)

    assert odometry() == odometry()


def test_a_world_is_drawn_as_before_but_for_what_is_brought_in() -> None:
    scene = load_scene("hall", bare=True)
    before = scene.spec.copy().compile()
    assets: list[Any] = ["Cube", "Sphere", "Cylinder", "Cone", "person", "car", "door", "box"]
    spares = tuple(SpareObject(asset=asset, scale=(2.0, 2.0, 1.0)) for asset in assets)
    add_movables(scene, "airsim", spares, ("crate_.*", "duct_1_1"))
    after = scene.spec.compile()
    assert after.stat.extent == before.stat.extent
    states = [mujoco.MjData(model) for model in (before, after)]
    for model, data in zip((before, after), states, strict=True):
        mujoco.mj_kinematics(model, data)
    for old in range(before.ngeom):
        new = after.geom(before.geom(old).name).id
        for field in ("geom_xpos", "geom_xmat"):
            old_value, new_value = getattr(states[0], field)[old], getattr(states[1], field)[new]
            assert np.allclose(old_value, new_value, atol=1e-12)
        for field in ("geom_size", "geom_rgba", "geom_type", "geom_matid", "geom_aabb"):
            assert np.allclose(getattr(before, field)[old], getattr(after, field)[new])
    for name in spare_objects("airsim", spares):
        assert states[1].body(name).xpos[2] >= 1e5
    cone = after.geom(int(after.body("airsim/Cone_3").geomadr[0]))
    turn = states[1].geom_xmat[cone.id].reshape(3, 3)
    middle = states[1].geom_xpos[cone.id] + turn @ after.geom_aabb[cone.id][:3]
    assert middle[2] == pytest.approx(states[1].body("airsim/Cone_3").xpos[2], abs=1e-9)


def test_a_vehicle_rests_on_what_is_held_and_on_what_is_free() -> None:
    scene = Scene(mujoco.MjSpec.from_string(WORLD))
    add_movables(scene, "airsim", (SpareObject(asset="Cube"),), ())
    attach_vehicle(scene.spec, "drone", (0.0, 0.0, -2.7), 0.0)
    model = scene.spec.compile()
    enable_collisions(model)
    simulation = Simulation(model)
    holder = Holder.of(simulation)
    cube = model.body("airsim/Cube_0").id
    compiled = model.body_invweight0[cube].copy(), model.dof_M0.copy()
    set_free(model, cube, False)
    assert np.allclose(model.body_invweight0[cube], compiled[0])
    assert np.allclose(model.dof_M0, compiled[1])
    pose = np.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0])
    holder.hold(model, cube, pose)
    simulation.advance_to(2_000_000_000)
    assert simulation.data.body("drone/base_link").xpos[2] == pytest.approx(2.6, abs=0.01)
    assert (simulation.data.body("airsim/Cube_0").xpos == pose[:3]).all()
    set_free(model, cube, True)
    holder.hold(model, cube, None)
    simulation.advance_to(5_000_000_000)
    assert simulation.data.body("airsim/Cube_0").xpos[2] == pytest.approx(0.5, abs=0.01)
    assert simulation.data.body("drone/base_link").xpos[2] == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize("expression", ["nobody", "floor"])
def test_what_cannot_move_is_named(expression: str) -> None:
    scene = Scene(mujoco.MjSpec.from_string(WORLD))
    with pytest.raises(ValueError, match=f"movable: expected .* {expression}"):
        add_movables(scene, "airsim", (), (expression,))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["free camera", "drone"])
def test_images_show_what_is_moved(kind: str, tiny_world: str) -> None:
    camera = {"name": "eye", "width": 32, "height": 24, "rate": 1}
    request = {"camera_name": "eye", "image_type": 1, "pixels_as_float": True, "compress": False}

    def script(airsim: Caller) -> None:
        def ahead() -> float:
            (image,) = airsim("simGetImages", [request], "", False)
            return float(np.array(image["image_data_float"]).reshape(24, 32)[11, 16])

        wall = ahead()
        airsim("simSetObjectPose", "wall", at(7.0, 0.0, -3.0), True)
        assert ahead() == pytest.approx(wall + 2.0, abs=0.01)
        airsim("simSpawnObject", "box", "Cube", at(2.0, 0.0, -0.4), ONE, False, False)
        assert ahead() == pytest.approx(wall - 2.5, abs=0.01)
        airsim("simDestroyObject", "box")
        airsim("reset")
        assert ahead() == pytest.approx(wall, abs=0.01)

    if kind == "drone":
        nodes = [drone(world=tiny_world, cameras=[camera])]
    else:
        settings = {"world": tiny_world, "cameras": [camera], "rate": 1, "position": (0, 0, -0.5)}
        nodes = [spec(FreeCamera, "camera", settings)]
    with_script(script, nodes, **CUBES)
